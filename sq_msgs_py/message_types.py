"""Where the classes of messages come from: a ROS installation, or a library that writes recordings without one.

A class is asked for by its full name ``package/msg/Name`` and gets its fields by keyword, sequences of numbers as lists
or array.array; fields left out take ROS's defaults.
"""

from __future__ import annotations

from collections.abc import Callable
from pkgutil import resolve_name
from typing import Any

MessageTypes = Callable[[str], Callable[..., Any]]


def find_type(name: str) -> Callable[..., Any]:
    """Return the class of ``package/msg/Name`` from the message packages of a ROS installation.  Raises ImportError
    where that package is not installed."""
    package, folder, short = name.split("/")
    try:
        return resolve_name(f"{package}.{folder}:{short}")
    except AttributeError as error:  # a folder of that name, such as a package's source, imports as an empty package
        raise ModuleNotFoundError(f"{package}/{folder} has no {short}: it is not built", name=package) from error
