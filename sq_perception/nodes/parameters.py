"""The parameters of the nodes, one frozen dataclass per node, by :mod:`sq_perception.nodes.live_parameters`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, cast, get_args

from sq_msgs_py.depth_image import DEPTH_ENCODINGS, GREY_ENCODINGS
from sq_msgs_py.markers import ALPHA
from sq_msgs_py.transforms import PREFIX
from sq_perception.grasping.gripper import GRIPPERS
from sq_perception.grasping.planner import FRICTION, PLACEMENT
from sq_perception.imaging import compressed_depth
from sq_perception.imaging.calibration import Treatment
from sq_perception.imaging.camera import Projection
from sq_perception.imaging.depth_units import DepthKind
from sq_perception.nodes.live_parameters import ParameterError, Parameters, setting
from sq_perception.recovery.options import Method, RecoveryOptions
from sq_perception.segmentation.options import Box, Pose
from sq_perception.simulation.sensor_noise import IDEAL, PRESETS

RAW, POINTS = "raw", "points"
"""Plain images, and clouds of points, as image_transport names them."""
EVERYWHERE = (-100.0, -100.0, -100.0, 100.0, 100.0, 100.0)
_KEEPS_ALL = 100.0
"""Metres: the value of depth_max that keeps all readings."""


def _check_box(name: str, box: tuple[float, ...]) -> None:
    if len(box) != 6 or not all(a < b for a, b in zip(box[:3], box[3:], strict=True)):
        raise ParameterError(f"{name}: expected least x, y, z and greater x, y, z in metres, got {list(box)}")


def _check_frame(name: str, frame: str) -> None:
    if frame.startswith("/") or "//" in frame or any(letter.isspace() for letter in frame):
        raise ParameterError(
            f"{name}: expected the name of a tf2 frame, without / at the beginning, // or spaces, got {frame!r}"
        )


def _check_prefix(prefix: str) -> None:
    """Check that the prefix makes valid names: 7 alone is none for a tf2 frame or a collision object."""
    _check_frame("tf_prefix", prefix)
    if not prefix:
        raise ParameterError(f"tf_prefix: expected something before the ids, such as {PREFIX}, got nothing")


@dataclass(frozen=True)
class RecoverParameters(Parameters):
    """Parameters of recover_node, and of each node of recover_cameras."""

    autostart: bool = setting(True, "Configure and activate at start; false: wait for a lifecycle manager.", live=False)
    projection: Projection = setting(
        "pinhole",
        "pinhole: 16UC1 and 32FC1 with camera_info; orthographic: mono8 and mono16 images of the unit cube.",
        choices=get_args(Projection),
        live=False,
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
        choices=(RAW, compressed_depth.TRANSPORT, POINTS),
        live=False,
    )
    distortion: Treatment = setting(
        "auto",
        "apply the coefficients of camera_info, ignore them, or auto: apply them unless one of the last two parts of "
        "the topic name contains the word rect or rectified.",
        choices=get_args(Treatment),
        live=False,
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
        RecoveryOptions.sharpness,
        "Sharpness of the soft occupancy sigmoid(s (1 - F^e1)) in the score.",
        within=(0.1, 1000.0),
    )
    tau: float = setting(
        RecoveryOptions.tau, "Sharpness of the soft depth projection in the score.", within=(0.1, 100.0)
    )
    depth_min: float = setting(0.0, "Ignore nearer readings.", unit="m", within=(0.0, 100.0))
    depth_max: float = setting(
        _KEEPS_ALL,
        f"Ignore farther readings; {_KEEPS_ALL:g} keeps all.",
        unit="m",
        within=(0.001, _KEEPS_ALL),
    )
    max_objects: int = setting(
        RecoveryOptions.max_objects, "Maximum number of bodies per frame; the largest are kept.", within=(1, 100)
    )
    max_size: float = setting(
        RecoveryOptions.max_size,
        "Largest full edge of objects that the node segments itself.",
        unit="m",
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
        unit="s",
        within=(0.0, 60.0),
    )
    tracking: bool = setting(
        True,
        "Track bodies from frame to frame and fuse their numbers; false: ids are mask labels, frames are independent.",
    )
    fixed_frame: str = setting(
        "",
        "Static tf2 frame, for a moving camera. Empty: the camera is static. A change ends the tracks.",
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
        0.1,
        "How long an image waits for transforms (camera_frame, fixed_frame, target_frame).",
        unit="s",
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
        "auto",
        "auto: network and fit; symmetry: fit only; network: network only; classic: Solina and Bajcsy's fit.",
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
            method=self.method,
            sharpness=self.s,
            tau=self.tau,
            depth_range=(self.depth_min, math.inf if self.depth_max >= _KEEPS_ALL else self.depth_max),
            max_objects=self.max_objects,
            max_size=self.max_size,
            workspace=self.box,
            workspace_pose=pose,
            free_space=has_free_space,
            time_budget=self.time_budget or math.inf,
            repair=self.repair,
            parts=self.parts,
        )

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_box("workspace", self.workspace)
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
        _check_prefix(self.tf_prefix)


@dataclass(frozen=True)
class FitterParameters(RecoverParameters):
    """Parameters of fitter_node: those of recover_node with another method."""

    method: Method = field(default="classic", metadata=RecoverParameters.__dataclass_fields__["method"].metadata)


@dataclass(frozen=True)
class SyntheticParameters(Parameters):
    """Parameters of synthetic_depth_node."""

    scene: Literal["thesis", "table", "replay"] = setting(
        "table",
        "thesis: orthographic grey images of one random body; table: a pinhole camera over bodies on a table; replay: "
        "recorded frames from path.",
        choices=("thesis", "table", "replay"),
        live=False,
    )
    rate: float = setting(10.0, "Frames per second.", unit="Hz", within=(0.1, 200.0))
    seed: int = setting(
        0, "Seed of scenes and noise: equal seeds give equal images.", within=(0, 2**31 - 1), live=False
    )
    noise: float = setting(
        0.0,
        "Standard deviation of the ideal sensor's depth noise: metres, for orthographic frames grey levels of 255.",
        unit="m or grey levels",
        within=(0.0, 50.0),
    )
    sensor: str = setting(
        IDEAL,
        "Simulated sensor: ideal adds only noise; the others have their own noise, steps, edges and holes "
        "(docs/sensors.md).",
        choices=(IDEAL, *PRESETS),
    )
    hold: int = setting(30, "Frames per scene or recording; the noise changes.", within=(1, 10**6), live=False)
    scenes: int = setting(0, "Number of scenes before it stops or repeats; 0: endless.", within=(0, 10**6), live=False)
    loop: bool = setting(True, "Start again after the last scene or recording; false: stop publishing.", live=False)
    objects: int = setting(3, "Bodies on the table.", within=(1, 10), live=False)
    encoding: str = setting(
        "auto",
        "auto: mono8 for orthographic frames, 32FC1 for others.",
        choices=("auto", *GREY_ENCODINGS, *DEPTH_ENCODINGS),
        live=False,
    )
    masks: str = setting(
        "auto",
        "Label images on mask/image: auto publishes those of recordings, always also those of generated scenes.",
        choices=("auto", "always", "never"),
        live=False,
    )
    frame_id: str = setting(
        "", "Frame of the images; empty: camera_depth_optical_frame, or unit_cube for orthographic frames.", live=False
    )
    path: str = setting("", "A recorded frame or a folder of them, for scene = replay.", live=False)
    camera_info_file: str = setting(
        "",
        "camera_info YAML of recorded PNG depth images; also the camera of table scenes, without distortion.",
        live=False,
    )
    projection: Projection = setting(
        "pinhole",
        "Camera model of recorded images, since 8 bit orthographic images look like depth images.",
        choices=get_args(Projection),
        live=False,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scene != "replay":
            self.check(self.scene == "thesis", f"scene = {self.scene}")
        elif not self.path:
            raise ParameterError("path: expected a recorded frame or a folder of them for scene = replay, got nothing")
        if self.sensor != IDEAL and self.noise != 0:
            raise ParameterError(f"noise: expected 0 for sensor = {self.sensor}, which has its own, got {self.noise:g}")

    def check(self, is_cube: bool, what: str) -> None:
        """Raise ParameterError if ``what`` has images of the unit cube and these parameters do not, or the reverse."""
        if self.encoding != "auto" and is_cube != (self.encoding in GREY_ENCODINGS):
            expected = " or ".join(GREY_ENCODINGS if is_cube else DEPTH_ENCODINGS)
            raise ParameterError(f"encoding: expected {expected} for {what}, got {self.encoding}")
        if is_cube and self.sensor != IDEAL:
            raise ParameterError(f"sensor: expected {IDEAL} for {what}, got {self.sensor}")


@dataclass(frozen=True)
class GraspParameters(Parameters):
    """Parameters of grasp_node."""

    autostart: bool = setting(True, "Configure and activate at start; false: wait for a lifecycle manager.", live=False)
    max_age: float = setting(
        10.0,
        "~/plan and ~/plan_grasps refuse bodies older than this; 0: never.",
        unit="s",
        within=(0.0, 3600.0),
    )
    no_cloud_warning: float = setting(
        5.0, "Warn after this time without bodies; 0 never warns.", unit="s", within=(0.0, 3600.0)
    )
    tf_prefix: str = setting(PREFIX, "The tf_prefix of recover_node, for the names that ~/plan_grasps uses.")
    gripper: str = setting("panda", "Gripper to plan for.", choices=tuple(GRIPPERS))
    friction: float = setting(FRICTION, "Smallest friction coefficient between pads and objects.", within=(0.05, 2.0))
    placement: float = setting(
        PLACEMENT, "Standard deviation of the hand's position along each axis, metres.", within=(0.0, 0.05)
    )
    min_score: float = setting(0.3, "Publish only grasps that hold with at least this probability.", within=(0.0, 1.0))
    only_id: int = setting(-1, "Plan only for the body with this id; -1: for all.", within=(-1, 2**31 - 1))
    region: tuple[float, ...] = setting(
        EVERYWHERE,
        "Plan for bodies with their centre in this box, min x, y, z, max x, y, z, in the cloud's frame; the default "
        "keeps all.",
        unit="m",
    )

    @property
    def box(self) -> Box | None:
        """``region``; None for the default, which keeps all, however far away the origin of a map is."""
        return None if self.region == GraspParameters.region else cast(Box, self.region)

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_box("region", self.region)
        _check_prefix(self.tf_prefix)


KINDS: dict[str, type[Parameters]] = {
    "recover_node": RecoverParameters,
    "fitter_node": FitterParameters,
    "grasp_node": GraspParameters,
    "synthetic_depth_node": SyntheticParameters,
}
"""The parameters of each node."""
