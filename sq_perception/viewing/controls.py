"""How a parameter is changed in the page: the control that fits its descriptor, and the value as the node wants it.

A control is made from the fields of a rcl_interfaces/ParameterDescriptor and the value that the node holds; nothing is
imported for that.  The rules:

    bool                                          a check box
    string with "one of: a, b" as constraint      a list to choose from
    other string                                  a line of text
    number                                        a field for numbers, within its range

Others have none: what is read-only, not set, an array or no number, and ROS' own (names with a dot among them).

A number with a floating point range is a float even where its value has come as an integer, as `ros2 param set` sends
it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

Kind = Literal["bool", "choice", "text", "number"]
_CHOICES = "one of:"
_OF_EVERY_NODE = ("use_sim_time", "start_type_description_service")


@dataclass(frozen=True)
class Control:
    """What the page shows for a parameter, whose values are of a ``type``."""

    name: str
    kind: Kind
    value: Any
    hint: str
    type: type[bool] | type[int] | type[float] | type[str]
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()

    def wanted(self, value: Any) -> Any:
        """A value of the page in the type of the parameter; None for what is no value, such as half a number."""
        if self.kind != "number":
            return self.type(value)
        number = float(value)
        if not math.isfinite(number):
            return None
        return round(number) if self.type is int else number


def control(about: Any, value: Any) -> Control | None:
    """The control of a parameter, ``about`` its descriptor, or None; see the module for the rules."""
    if about.read_only or "." in about.name or about.name in _OF_EVERY_NODE:
        return None
    constraints: str = about.additional_constraints
    hint = " ".join(part for part in (about.description, f"({constraints})" if constraints else "") if part)
    if isinstance(value, bool):
        return Control(about.name, "bool", value, hint, bool)
    if isinstance(value, str):
        if not constraints.startswith(_CHOICES):
            return Control(about.name, "text", value, hint, str)
        choices = tuple(name.strip() for name in constraints.removeprefix(_CHOICES).split(","))
        choices = choices if value in choices else (*choices, value)
        return Control(about.name, "choice", value, hint, str, choices=choices)
    if not (isinstance(value, (int, float)) and math.isfinite(value)):
        return None
    kind = float if about.floating_point_range or isinstance(value, float) else int
    made = Control(about.name, "number", kind(value), hint, kind)
    for ends in (*about.floating_point_range, *about.integer_range):  # one at most
        # What the node holds is shown, even where its descriptor rules it out.
        low, high = min(ends.from_value, value), max(ends.to_value, value)
        made = replace(made, low=None if math.isinf(low) else kind(low), high=None if math.isinf(high) else kind(high))
    return made
