"""ROS parameters from a frozen dataclass: declared with descriptors, checked as a whole, updated at run time; and those
of recover_node.

Each field of such a dataclass is one parameter of the same name; :func:`setting` carries its descriptor:
meaning, unit, range or choices, and whether it may change while the node runs.  :class:`LiveParameters` declares them
and holds the current values; a worker that takes ``current`` once per frame sees a consistent set, and a change takes
effect with the next frame.

``ros2 param set /node s 3`` sends an INTEGER: where a float is declared, integers become doubles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any, Generic, TypeVar, cast, get_args

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from sq_msgs_py.markers import ALPHA
from sq_msgs_py.poses import PREFIX
from sq_perception.imaging import compressed_depth
from sq_perception.imaging.calibration import Treatment
from sq_perception.imaging.camera import Projection
from sq_perception.imaging.depth_units import DepthKind
from sq_perception.recovery.options import Method, RecoveryOptions
from sq_perception.segmentation.options import Box, Pose


class ParameterError(ValueError):
    """Error that names an invalid parameter, what was expected and what arrived."""


def setting(
    default: Any, description: str, *, unit: str = "", within: tuple[float, float] | None = None,
    choices: tuple[str, ...] = (), live: bool = True,
) -> Any:
    """Return a dataclass field that becomes a ROS parameter; ``live``: it may change at any time."""
    about = {"description": description, "unit": unit, "within": within, "choices": choices, "live": live}
    return field(default=default, metadata=about)


@dataclass(frozen=True)
class Parameters:
    """The parameters of a node.  rclpy checks types and ranges by the descriptors; here, how they fit together.  Raises
    ParameterError for a value that is none of the choices, or does not fit the others."""

    def __post_init__(self) -> None:
        for parameter in fields(self):
            choices, value = parameter.metadata["choices"], getattr(self, parameter.name)
            if choices and value not in choices:
                raise ParameterError(f"{parameter.name}: expected one of {', '.join(choices)}, got {value!r}")


P = TypeVar("P", bound=Parameters)


class LiveParameters(Generic[P]):
    """Parameters of a node, declared from the fields of a dataclass ``kind``, with their changes.

    ``locked``: returns why parameters that are not live cannot change now; empty if they can.  None: they never can.
    ``check``: Raises ValueError for an invalid set of values; also gets the names of those that change.  ``changed``:
    called with the new values and the names of those that were set.  ``defaults``: of this node, in place of the
    dataclass'.  Raises InvalidParameterValueException or ParameterError if a value given at the start has a wrong type,
    is out of range, or does not fit the others.
    """

    def __init__(
        self, node: Node, kind: type[P], *, locked: Callable[[], str] | None = None,
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
        name=parameter.name, type=Parameter.Type.from_parameter_value(parameter.default).value,
        description=about["description"] + (f" [{unit}]" if unit else ""), read_only=is_fixed and not about["live"],
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


RAW, POINTS = "raw", "points"  # plain images, and clouds of points, as image_transport names them
EVERYWHERE = (-100.0, -100.0, -100.0, 100.0, 100.0, 100.0)
_KEEPS_ALL = 100.0  # metres: the value of depth_max that keeps all readings


def check_box(name: str, box: tuple[float, ...]) -> None:
    """Raise ParameterError for numbers that are no box."""
    if len(box) != 6 or not all(a < b for a, b in zip(box[:3], box[3:], strict=True)):
        raise ParameterError(f"{name}: expected least x, y, z and greater x, y, z in metres, got {list(box)}")


def _check_frame(name: str, frame: str) -> None:
    if frame.startswith("/") or "//" in frame or any(letter.isspace() for letter in frame):
        raise ParameterError(
            f"{name}: expected the name of a tf2 frame, without / at the beginning, // or spaces, got {frame!r}"
        )


def check_prefix(prefix: str) -> None:
    """Raise ParameterError if the prefix makes no valid names: 7 alone is none for a frame or a collision object."""
    _check_frame("tf_prefix", prefix)
    if not prefix:
        raise ParameterError(f"tf_prefix: expected something before the ids, such as {PREFIX}, got nothing")


@dataclass(frozen=True)
class RecoverParameters(Parameters):
    """Parameters of recover_node, and of each node of recover_cameras."""

    autostart: bool = setting(True, "Configure and activate at start; false: wait for a lifecycle manager.", live=False)
    projection: Projection = setting(
        "pinhole", "pinhole: 16UC1 and 32FC1 with camera_info; orthographic: mono8 and mono16 images of the unit cube.",
        choices=get_args(Projection), live=False,
    )
    use_masks: str = setting(
        "auto",
        "Label images on mask/image: auto segments images without a mask, always refuses them, never ignores masks.",
        choices=("auto", "always", "never"),
    )
    patience: float = setting(0.25, "How long an image waits for camera_info or mask.", unit="s", within=(0.0, 10.0))
    image_transport: str = setting(
        RAW,
        "Input topic: raw on depth/image, compressedDepth (16 bit PNG or RVL) on "
        "depth/image/compressedDepth, points (sensor_msgs/PointCloud2, see docs/nodes.md) on depth/points.",
        choices=(RAW, compressed_depth.TRANSPORT, POINTS), live=False,
    )
    distortion: Treatment = setting(
        "auto",
        "apply the coefficients of camera_info, ignore them, or auto: apply them unless one of the last two parts of "
        "the topic name contains the word rect or rectified.",
        choices=get_args(Treatment), live=False,
    )
    depth_scale: float = setting(
        0.0,
        "Units per metre of depth images and points; 0: 1000 for 16UC1, 1 for 32FC1 and points. 32FC1 in millimetres: "
        "1000; 16UC1 of a D405: 10000.",
        within=(0.0, 1e5),
    )
    depth_kind: DepthKind = setting(
        "z",
        "Meaning of depth values: z along the optical axis, or range, the distance to the camera's centre (Isaac's "
        "distance_to_camera).",
        choices=get_args(DepthKind),
    )
    s: float = setting(
        RecoveryOptions.sharpness, "Sharpness of the soft occupancy sigmoid(s (1 - F^e1)) in the score.",
        within=(0.1, 1000.0),
    )
    tau: float = setting(
        RecoveryOptions.tau, "Sharpness of the soft depth projection in the score.", within=(0.1, 100.0)
    )
    depth_min: float = setting(0.0, "Ignore nearer readings.", unit="m", within=(0.0, 100.0))
    depth_max: float = setting(
        _KEEPS_ALL, f"Ignore farther readings; {_KEEPS_ALL:g} keeps all.", unit="m", within=(0.001, _KEEPS_ALL)
    )
    max_objects: int = setting(
        RecoveryOptions.max_objects, "Maximum number of bodies per frame; the largest are kept.", within=(1, 100)
    )
    max_size: float = setting(
        RecoveryOptions.max_size, "Largest full edge of objects that the node segments itself.", unit="m",
        within=(0.01, 100.0),
    )
    workspace: tuple[float, ...] = setting(
        EVERYWHERE,
        "Box, min x, y, z, max x, y, z, in target_frame or else the image's frame; objects whose visible part is "
        "centred outside are ignored.",
        unit="m",
    )
    time_budget: float = setting(
        0.0,
        "Time per frame after which fits try no further starts, the largest and nearest objects first; 0: no limit.",
        unit="s", within=(0.0, 60.0),
    )
    tracking: bool = setting(
        True,
        "Track bodies from frame to frame and fuse their numbers; false: ids are mask labels, frames are independent.",
    )
    fixed_frame: str = setting(
        "", "Static tf2 frame, for a moving camera. Empty: the camera is static. A change ends the tracks."
    )
    marker_alpha: float = setting(ALPHA, "Opacity of the markers' surfaces.", within=(0.0, 1.0))
    no_frame_warning: float = setting(
        5.0, "Warn after this time without a depth image; 0 never warns.", unit="s", within=(0.0, 3600.0)
    )
    target_frame: str = setting(
        "",
        "tf2 frame of the results, by the transform at the image's stamp; an image without it is refused. Empty: the "
        "image's frame.",
    )
    camera_frame: str = setting(
        "",
        "Optical tf2 frame of the camera that took the points (image_transport: points), if they are in another frame. "
        "Empty: the points' frame.",
    )
    tf_tolerance: float = setting(
        0.1, "How long an image waits for transforms (camera_frame, fixed_frame, target_frame).", unit="s",
        within=(0.0, 5.0),
    )
    publish_tf: bool = setting(False, "Publish a frame for each body on /tf.")
    tf_prefix: str = setting(
        PREFIX,
        "Prefix of the id in names of tf2 frames, detections and collision objects. Two nodes need different ones; "
        "recover_cameras uses front_superquadric_ and so on.",
    )
    publish_detections: bool = setting(False, "Publish ~/detections; needs vision_msgs.")
    publish_collision_objects: bool = setting(False, "Publish ~/planning_scene; needs moveit_msgs.")
    collision_shapes: str = setting(
        "primitive",
        "Shape around each body: the smallest box, cylinder or sphere, fast to plan with, or a close mesh.",
        choices=("primitive", "mesh"),
    )

    model: str = setting(
        "", "Weights: a .safetensors file or a shipped name; empty: the default. Setting it again reloads the file."
    )
    device: str = setting("cpu", "Device of the network for bodies or hulls: cpu, cuda or cuda:N.")
    threads: int = setting(0, "Objects processed in parallel; 0: one per core.", within=(0, 256))
    method: Method = setting(
        "auto", "auto: network and fit; symmetry: fit only; network: network only; classic: Solina and Bajcsy's fit.",
        choices=get_args(Method),
    )
    repair: bool = setting(
        True, "Split, join and drop own segments with a network; exclude readings of neighbours from fits."
    )
    parts: bool = setting(
        False, "Also recover the parts of objects that one body does not explain (see docs/points.md)."
    )

    @property
    def box(self) -> Box | None:
        """``workspace``; None for the default, which keeps all."""
        return None if self.workspace == RecoverParameters.workspace else cast(Box, self.workspace)

    def recovery_options(self, pose: Pose | None = None, has_free_space: bool = True) -> RecoveryOptions:
        """Return the options for a frame with this pose in ``target_frame``."""
        return RecoveryOptions(
            method=self.method, sharpness=self.s, tau=self.tau,
            depth_range=(self.depth_min, math.inf if self.depth_max >= _KEEPS_ALL else self.depth_max),
            max_objects=self.max_objects, max_size=self.max_size, workspace=self.box, workspace_pose=pose,
            free_space=has_free_space, time_budget=self.time_budget or math.inf, repair=self.repair, parts=self.parts,
        )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_box("workspace", self.workspace)
        if not self.depth_min < self.depth_max:
            raise ParameterError(
                f"depth_min, depth_max: expected depth_min < depth_max, got {self.depth_min:g} and {self.depth_max:g}"
            )
        for name in ("image_transport", "fixed_frame", "target_frame", "depth_scale", "depth_kind"):
            expected = RecoverParameters.__dataclass_fields__[name].default
            given = getattr(self, name)
            if self.projection == "orthographic" and given != expected:
                raise ParameterError(
                    f"{name}: expected {expected or 'none'} for projection = orthographic, got {given}"
                )
        for name in ("camera_frame", "fixed_frame", "target_frame"):
            _check_frame(name, getattr(self, name))
        if self.camera_frame and self.image_transport != POINTS:
            raise ParameterError(f"camera_frame: expected image_transport = {POINTS}, got {self.image_transport}")
        check_prefix(self.tf_prefix)


@dataclass(frozen=True)
class FitterParameters(RecoverParameters):
    """Parameters of fitter_node: those of recover_node with another method."""

    method: Method = field(default="classic", metadata=RecoverParameters.__dataclass_fields__["method"].metadata)
