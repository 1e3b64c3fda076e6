"""Where the classes of messages come from.

What makes a message asks for its class by the full name ``package/msg/Name`` and gives every field by keyword; fields
left out take ROS's defaults.  Any classes with the names and fields of ROS will do: those of an installation, which is
the default, or those of a library that writes recordings without one.  Both then hold the same numbers, as the same
code computed them.

Sequences of numbers are given as lists or array.array, whatever the class at hand would rather have.
"""

from __future__ import annotations

from collections.abc import Callable
from pkgutil import resolve_name
from typing import Any

MessageTypes = Callable[[str], Callable[..., Any]]


def find_type(name: str) -> Callable[..., Any]:
    """Return the class of ``package/msg/Name`` from the message packages of a ROS installation.

    Raises ImportError where that package is not installed.
    """
    package, folder, short = name.split("/")
    try:
        return resolve_name(f"{package}.{folder}:{short}")
    except AttributeError as error:  # a folder of that name, such as a package's source, imports as an empty package
        raise ModuleNotFoundError(f"{package}/{folder} has no {short}: it is not built", name=package) from error
