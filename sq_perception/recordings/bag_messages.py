"""Messages for recordings, without a ROS installation: classes, bytes (CDR) and definitions of rosbags.

:func:`types` is what sq_msgs_py makes messages of (:mod:`sq_msgs_py.message_types`).  rosbags' classes want every field
and take arrays of numbers as NumPy has them; ROS has defaults and takes lists.  Both differences are met here.  The
bytes are those of rclpy, which alone leaves the gaps between aligned fields as memory happens to be.

Reference: rosbags, https://ternaris.gitlab.io/rosbags
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

_DECLARED = {"geometry_msgs/msg/Quaternion": {"w": 1.0}}
"""Defaults that a message definition declares; rosbags does not keep them."""


@cache
def _store() -> Any:
    """One table of types, which keeps the code that it makes for each."""
    return get_typestore(Stores.ROS2_JAZZY)


@cache
def types(name: str) -> Callable[..., Any]:
    """What makes messages of ``package/msg/Name`` from keywords; fields left out have ROS's defaults.

    Raises
    ------
    KeyError
        For a type that ROS 2 Jazzy's common interfaces do not have.
    """
    kind, defaults = _store().types[name], _defaults(name)

    def make(**given: Any) -> Any:
        return kind(**{**defaults, **given})

    return make


def definition(name: str) -> str:
    """The text of ``package/msg/Name`` and of all that it contains, as rosbag2 stores it beside messages."""
    text, _ = _store().generate_msgdef(name, ros_version=2)
    return str(text)


def as_cdr(message: Any) -> bytes:
    """A message's bytes, little endian, with their encapsulation header."""
    name = message.__msgtype__
    for field, default in _defaults(name).items():
        if isinstance(default, np.ndarray):
            setattr(message, field, np.asarray(getattr(message, field), default.dtype))
    return bytes(_store().serialize_cdr(message, name))


@cache
def _defaults(name: str) -> dict[str, Any]:
    """Fields of an empty message, shared between messages: they are written and never changed."""
    fields = _store().fielddefs[name][1]
    return {field: _default(description) for field, description in fields} | _DECLARED.get(name, {})


def _default(description: Any) -> Any:
    node, detail = description
    if node == Nodetype.NAME:
        return types(detail)()
    if node == Nodetype.BASE:
        return "" if detail[0] == "string" else _dtype(detail[0]).type(0).item()
    inner, length = detail
    if inner[0] == Nodetype.BASE and inner[1][0] != "string":
        return np.zeros(length if node == Nodetype.ARRAY else 0, _dtype(inner[1][0]))
    return [_default(inner) for _ in range(length)] if node == Nodetype.ARRAY else []


def _dtype(base: str) -> np.dtype[Any]:
    return np.dtype("uint8" if base in ("byte", "char") else base)
