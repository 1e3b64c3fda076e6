"""ROS parameters from a frozen dataclass: declared with descriptors, checked as a whole, updated at run time.

Each field of such a dataclass is one parameter of the same name; :func:`setting` carries its descriptor:
meaning, unit, range or choices, and whether it may change while the node runs.  :class:`LiveParameters` declares them
and holds the current values; a worker that takes ``current`` once per frame sees a consistent set, and a change takes
effect with the next frame.

``ros2 param set /node s 3`` sends an INTEGER: where a float is declared, integers become doubles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter


class ParameterError(ValueError):
    """Error that names an invalid parameter, what was expected and what arrived."""


def setting(
    default: Any,
    description: str,
    *,
    unit: str = "",
    within: tuple[float, float] | None = None,
    choices: tuple[str, ...] = (),
    live: bool = True,
) -> Any:
    """Return a dataclass field that becomes a ROS parameter; ``live``: it may change at any time."""
    about = {"description": description, "unit": unit, "within": within, "choices": choices, "live": live}
    return field(default=default, metadata=about)


@dataclass(frozen=True)
class Parameters:
    """The parameters of a node.  rclpy checks types and ranges by the descriptors; here, how they fit together.

    Raises ParameterError for a value that is none of the choices, or does not fit the others.
    """

    def __post_init__(self) -> None:
        for parameter in fields(self):
            choices, value = parameter.metadata["choices"], getattr(self, parameter.name)
            if choices and value not in choices:
                raise ParameterError(f"{parameter.name}: expected one of {', '.join(choices)}, got {value!r}")


P = TypeVar("P", bound=Parameters)


class LiveParameters(Generic[P]):
    """Parameters of a node, declared from the fields of a dataclass ``kind``, with their changes.

    Parameters
    ----------
    locked
        Returns why parameters that are not live cannot change now; empty if they can.  None: they never can.
    check
        Raises ValueError for an invalid set of values; also gets the names of those that change.
    changed
        Called with the new values and the names of those that were set.
    defaults
        Of this node, in place of the dataclass'.

    Raises
    ------
    InvalidParameterValueException, ParameterError
        If a value given at the start has a wrong type, is out of range, or does not fit the others.
    """

    def __init__(
        self,
        node: Node,
        kind: type[P],
        *,
        locked: Callable[[], str] | None = None,
        check: Callable[[Any, frozenset[str]], None] = lambda _, __: None,
        changed: Callable[[Any, frozenset[str]], None] = lambda _, __: None,
        defaults: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self._kinds: dict[str, Any] = {parameter.name: type(parameter.default) for parameter in fields(kind)}
        self._fixed = {parameter.name for parameter in fields(kind) if not parameter.metadata["live"]}
        self._locked, self._check, self._changed, self._defaults = locked, check, changed, defaults
        self.current: P = kind(**self._values([self._declare(node, parameter) for parameter in fields(kind)]))
        """The current values: an immutable set, replaced as a whole."""
        node.add_pre_set_parameters_callback(lambda changes: [self._cast(change) for change in changes])
        node.add_on_set_parameters_callback(self._on_set)
        node.add_post_set_parameters_callback(self._accept)

    def _declare(self, node: Node, parameter: Field[Any]) -> Parameter:
        # Of any type at first: declared as a double it would refuse an integer given at the start.
        default = self._defaults.get(parameter.name, parameter.default)
        node.declare_parameter(parameter.name, default, ParameterDescriptor(dynamic_typing=True))
        given = self._cast(node.get_parameter(parameter.name))
        node.set_descriptor(parameter.name, describe(parameter, self._locked is None), given.get_parameter_value())
        return given

    def _cast(self, given: Parameter) -> Parameter:
        """Return a parameter with integers as doubles where doubles, or a list of them, are declared."""
        kind = self._kinds.get(given.name)
        if kind is float and given.type_ == Parameter.Type.INTEGER:
            return Parameter(given.name, value=float(given.value))
        if kind is tuple and given.type_ == Parameter.Type.INTEGER_ARRAY:
            return Parameter(given.name, value=[float(number) for number in given.value])
        return given

    def _values(self, changes: list[Parameter]) -> dict[str, Any]:
        """Return the values by name, without rclpy's own parameters, which another thread may declare."""
        return {change.name: self._kinds[change.name](change.value) for change in changes if change.name in self._kinds}

    def _on_set(self, changes: list[Parameter]) -> SetParametersResult:
        values = self._values(changes)
        try:
            candidate = replace(self.current, **values)
            # A value that stays as it is may always be set: `ros2 param load` sets all of a file.
            fixed = sorted(self._fixed.intersection(values))
            frozen = [name for name in fixed if getattr(candidate, name) != getattr(self.current, name)]
            if frozen and self._locked is not None and (reason := self._locked()):
                raise ParameterError(f"{', '.join(frozen)}: {reason}")
            if values:
                self._check(candidate, frozenset(values))
        except (ValueError, OSError) as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _accept(self, changes: list[Parameter]) -> None:
        if values := self._values(changes):
            self.current = replace(self.current, **values)
            self._changed(self.current, frozenset(values))


def describe(parameter: Field[Any], is_fixed: bool = True) -> ParameterDescriptor:
    """Return the descriptor of a field: type, text with unit, range or choices.

    It is read-only where the field is not live and ``is_fixed``, as in nodes without a lifecycle.
    """
    about = parameter.metadata
    unit = about["unit"]
    descriptor = ParameterDescriptor(
        name=parameter.name,
        type=Parameter.Type.from_parameter_value(parameter.default).value,
        description=about["description"] + (f" [{unit}]" if unit else ""),
        read_only=is_fixed and not about["live"],
    )
    if about["choices"]:
        descriptor.additional_constraints = "one of: " + ", ".join(about["choices"])
    elif about["within"] is not None:
        low, high = about["within"]
        descriptor.additional_constraints = f"{low:g} to {high:g} {unit}".rstrip()
        if isinstance(parameter.default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    return descriptor
