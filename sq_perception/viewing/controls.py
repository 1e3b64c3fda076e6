"""How a parameter is shown: the control that fits its descriptor, and the value as the node wants it.

A control is made from the fields of a rcl_interfaces/ParameterDescriptor and the value that the node holds, None where
it is not set; nothing is imported for that.  The rules:

    bool                                          a check box
    string with "one of: a, b" as constraint      a list to choose from
    other string                                  a line of text
    number                                        a field for numbers, within its range
    read-only, arrays, names with a dot           shown, not to be changed

A number with a floating point range is a float even where its value has come as an integer, as `ros2 param set` sends
it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

Kind = Literal["bool", "choice", "text", "number", "fixed"]
Group = Literal["live", "start", "other"]
GROUPS: dict[Group, str] = {
    "live": "Settings",
    "start": "Fixed at the start",
    "other": "Of ROS",
}
_CHOICES = "one of:"
_OF_EVERY_NODE = ("use_sim_time", "start_type_description_service")


@dataclass(frozen=True)
class Control:
    """What the page shows for a parameter.

    Attributes
    ----------
    type : type
        Of the parameter's values, where they may be changed.
    """

    name: str
    kind: Kind
    value: Any
    hint: str
    group: Group
    type: type[bool] | type[int] | type[float] | type[str] = str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()

    @property
    def can_change(self) -> bool:
        return self.kind != "fixed"

    @property
    def is_typed(self) -> bool:
        return self.kind in ("text", "number")

    def wanted(self, value: Any) -> Any:
        """A value of the page in the type of the parameter; None for what is no value, such as half a number."""
        if self.kind != "number":
            return self.type(value)
        number = float(value)
        if not math.isfinite(number):
            return None
        return round(number) if self.type is int else number


def control(about: Any, value: Any) -> Control:
    """The control of a parameter, ``about`` its descriptor; see the module for the rules."""
    constraints: str = about.additional_constraints
    hint = " ".join(part for part in (about.description, f"({constraints})" if constraints else "") if part)
    group: Group = "start" if about.read_only else "live"
    if "." in about.name or about.name in _OF_EVERY_NODE:
        group = "other"
    made = Control(about.name, "fixed", plain(value), hint, group)
    if about.read_only or group == "other":
        return made
    if isinstance(value, bool):
        return replace(made, kind="bool", type=bool, value=value)
    if isinstance(value, str):
        choices = _choices(constraints)
        if choices:
            choices = choices if value in choices else (*choices, value)
            return replace(made, kind="choice", value=value, choices=choices)
        return replace(made, kind="text", value=value)
    if isinstance(value, (int, float)) and math.isfinite(value):
        return _number(about, value, made)
    return made


def _number(about: Any, value: float, made: Control) -> Control:
    kind = float if about.floating_point_range or isinstance(value, float) else int
    made = replace(made, kind="number", type=kind, value=kind(value))
    for ends in (*about.floating_point_range, *about.integer_range):  # one at most
        # What the node holds is shown, even where its descriptor rules it out.
        low, high = min(ends.from_value, value), max(ends.to_value, value)
        made = replace(made, low=None if math.isinf(low) else kind(low), high=None if math.isinf(high) else kind(high))
    return made


def _choices(constraints: str) -> tuple[str, ...]:
    if not constraints.startswith(_CHOICES):
        return ()
    return tuple(name.strip() for name in constraints[len(_CHOICES) :].split(",") if name.strip())


def plain(value: Any) -> str:
    """A value of a parameter as text."""
    if value is None:
        return "(not set)"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, (str, int)):
        return str(value)
    try:
        return ", ".join(plain(item) for item in value)
    except TypeError:
        return str(value)
