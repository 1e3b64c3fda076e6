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
"""Metres: the value of depth_max that leaves nothing out."""


def _check_box(name: str, box: tuple[float, ...]) -> None:
    if len(box) != 6 or not all(a < b for a, b in zip(box[:3], box[3:], strict=True)):
        raise ParameterError(f"{name}: expected least x, y, z and greater x, y, z in metres, got {list(box)}")


def _check_frame(name: str, frame: str) -> None:
    if frame.startswith("/") or "//" in frame or any(letter.isspace() for letter in frame):
        raise ParameterError(
            f"{name}: expected the name of a tf2 frame, without / at the beginning, // or spaces, got {frame!r}"
        )


def _check_prefix(prefix: str) -> None:
    """Without one a body would be called 7, which no tf2 frame and no collision object should be."""
    _check_frame("tf_prefix", prefix)
    if not prefix:
        raise ParameterError(f"tf_prefix: expected something before the ids, such as {PREFIX}, got nothing")


@dataclass(frozen=True)
class RecoverParameters(Parameters):
    """recover_node, and each node of recover_cameras."""

    autostart: bool = setting(True, "Configure and activate at start; false: wait for a lifecycle manager.", live=False)
    free_shared_memory: bool = setting(
        False, "Delete the shared memory that killed processes of this user have left behind.", live=False
    )
    projection: Projection = setting(
        "pinhole",
        "pinhole: 16UC1 and 32FC1 with camera_info; orthographic: mono8 and mono16 images of the unit cube.",
        choices=get_args(Projection),
        live=False,
    )
    use_masks: str = setting(
        "auto",
        "Label images on mask/image: auto segments images without one, always refuses them, never ignores masks.",
        choices=("auto", "always", "never"),
    )
    patience: float = setting(0.25, "How long an image waits for camera_info or mask.", unit="s", within=(0.0, 10.0))
    image_transport: str = setting(
        RAW,
        "How depth images come: raw on depth/image, compressedDepth (16 bit PNG or RVL) on "
        "depth/image/compressedDepth, points (sensor_msgs/PointCloud2, see docs/nodes.md) on depth/points.",
        choices=(RAW, compressed_depth.TRANSPORT, POINTS),
        live=False,
    )
    distortion: Treatment = setting(
        "auto",
        "apply the coefficients of camera_info, ignore them, or auto: apply unless one of the last two parts of the "
        "images' topic has the word rect or rectified.",
        choices=get_args(Treatment),
        live=False,
    )
    depth_scale: float = setting(
        0.0,
        "Units a metre of depth images and points; 0: 1000 of 16UC1, 1 of 32FC1 and points. 32FC1 in millimetres: "
        "1000; a D405's 16UC1: 10000.",
        within=(0.0, 1e5),
    )
    depth_kind: DepthKind = setting(
        "z",
        "What depth images hold: z along the optical axis, or range, the distance to the camera's centre (Isaac's "
        "distance_to_camera).",
        choices=get_args(DepthKind),
    )
    s: float = setting(
        RecoveryOptions.sharpness,
        "Sharpness of the soft occupancy sigma(s (1 - F^e1)) of the score.",
        within=(0.1, 1000.0),
    )
    tau: float = setting(RecoveryOptions.tau, "Sharpness of the soft depth projection, likewise.", within=(0.1, 100.0))
    depth_min: float = setting(0.0, "Nearer readings are left out.", unit="m", within=(0.0, 100.0))
    depth_max: float = setting(
        _KEEPS_ALL,
        f"Farther readings are left out; {_KEEPS_ALL:g} keeps all.",
        unit="m",
        within=(0.001, _KEEPS_ALL),
    )
    max_objects: int = setting(RecoveryOptions.max_objects, "Most bodies a frame, the largest ones.", within=(1, 100))
    max_size: float = setting(
        RecoveryOptions.max_size, "Largest full edge of objects that the node segments.", unit="m", within=(0.01, 100.0)
    )
    workspace: tuple[float, ...] = setting(
        EVERYWHERE,
        "Least x, y, z, then greatest x, y, z of the middle of what is seen of an object, in target_frame or, without "
        "one, the image's; objects outside are left out.",
        unit="m",
    )
    time_budget: float = setting(
        0.0,
        "Time per frame after which no further start is tried, the largest and nearest objects first; 0: none.",
        unit="s",
        within=(0.0, 60.0),
    )
    tracking: bool = setting(
        True,
        "Follow bodies from frame to frame and fuse their numbers; false: ids are mask labels, each frame stands for "
        "itself.",
    )
    fixed_frame: str = setting(
        "",
        "tf2 frame that the bodies rest in, for a camera that moves. Empty: the camera stands still. A change ends the "
        "tracks.",
    )
    marker_alpha: float = setting(ALPHA, "Opacity of the markers' surfaces.", within=(0.0, 1.0))
    no_frame_warning: float = setting(
        5.0, "Warn when no depth image came for so long; 0 never warns.", unit="s", within=(0.0, 3600.0)
    )
    target_frame: str = setting(
        "",
        "tf2 frame of the results, by the transform at the image's stamp; an image without it is refused. Empty: the "
        "image's.",
    )
    camera_frame: str = setting(
        "",
        "tf2 frame, optical, of the camera that took the points (image_transport: points), where they come in another "
        "one. Empty: that of the points.",
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
        "Names of tf2 frames, detections and collision objects before the id. Two nodes need different ones: those of "
        "recover_cameras have front_superquadric_ and so on.",
    )
    publish_detections: bool = setting(False, "Publish ~/detections; needs vision_msgs.")
    publish_collision_objects: bool = setting(False, "Publish ~/planning_scene; needs moveit_msgs.")
    collision_shapes: str = setting(
        "primitive",
        "Around each body: the smallest box, cylinder or sphere, quick to plan with, or a mesh that fits closely.",
        choices=("primitive", "mesh"),
    )

    model: str = setting(
        "", "Weights: a .safetensors file or the name of shipped ones; empty: the default. Set again, it is read again."
    )
    device: str = setting("cpu", "Where the network of bodies or hulls runs: cpu, cuda or cuda:N.")
    threads: int = setting(0, "Objects worked on at the same time; 0: as many as there are cores.", within=(0, 256))
    method: Method = setting(
        "auto",
        "auto: a network and a fit; symmetry: a fit alone; network: no fit; classic: Solina and Bajcsy's fit.",
        choices=get_args(Method),
    )
    repair: bool = setting(True, "Part, join and drop own segments; leave readings of neighbours out of fits.")

    @property
    def box(self) -> Box | None:
        """``workspace``; None for the default, which keeps all."""
        return None if self.workspace == RecoverParameters.workspace else cast(Box, self.workspace)

    def recovery_options(self, pose: Pose | None = None, has_free_space: bool = True) -> RecoveryOptions:
        """The options for a frame, whose pose in ``target_frame`` is given."""
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
    """fitter_node: recover_node with another method."""

    method: Method = field(default="classic", metadata=RecoverParameters.__dataclass_fields__["method"].metadata)


@dataclass(frozen=True)
class SyntheticParameters(Parameters):
    """synthetic_depth_node."""

    scene: Literal["thesis", "table", "replay"] = setting(
        "table",
        "thesis: orthographic grey images of one random body; table: a pinhole camera over bodies on a table; replay: "
        "recorded frames from path.",
        choices=("thesis", "table", "replay"),
        live=False,
    )
    rate: float = setting(10.0, "Frames per second.", unit="Hz", within=(0.1, 200.0))
    seed: int = setting(0, "Seed of scenes and noise: equal seeds, equal images.", within=(0, 2**31 - 1), live=False)
    noise: float = setting(
        0.0,
        "Standard deviation of the ideal sensor's depth noise: metres, for orthographic frames grey levels of 255.",
        unit="m or grey levels",
        within=(0.0, 50.0),
    )
    sensor: str = setting(
        IDEAL,
        "Depth sensor to imitate: ideal adds noise alone; the others have noise, steps, edges and holes of their own "
        "(docs/sensors.md).",
        choices=(IDEAL, *PRESETS),
    )
    hold: int = setting(30, "Frames that a scene or recording stays; noise is fresh.", within=(1, 10**6), live=False)
    scenes: int = setting(0, "Scenes before the end or the next round; 0: endless.", within=(0, 10**6), live=False)
    loop: bool = setting(True, "Begin again after the last scene or recording; otherwise publish no more.", live=False)
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
        "camera_info YAML of recorded PNG depth images; also the camera of table scenes, which show no distortion.",
        live=False,
    )
    projection: Projection = setting(
        "pinhole",
        "Camera model of recorded images: 8 bit orthographic images look like depth images.",
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
        """Raise ParameterError where ``what`` has images of the unit cube, or has none, and these expect the other."""
        if self.encoding != "auto" and is_cube != (self.encoding in GREY_ENCODINGS):
            expected = " or ".join(GREY_ENCODINGS if is_cube else DEPTH_ENCODINGS)
            raise ParameterError(f"encoding: expected {expected} for {what}, got {self.encoding}")
        if is_cube and self.sensor != IDEAL:
            raise ParameterError(f"sensor: expected {IDEAL} for {what}, got {self.sensor}")


@dataclass(frozen=True)
class GraspParameters(Parameters):
    """grasp_node."""

    autostart: bool = setting(True, "Configure and activate at the start, as recover_node does.", live=False)
    max_age: float = setting(
        10.0,
        "~/plan and ~/plan_grasps refuse when the last bodies are older; 0: never.",
        unit="s",
        within=(0.0, 3600.0),
    )
    no_cloud_warning: float = setting(
        5.0, "Warn when no bodies came for so long; 0 never warns.", unit="s", within=(0.0, 3600.0)
    )
    tf_prefix: str = setting(PREFIX, "That of the recover_node: what ~/plan_grasps calls the bodies, before their ids.")
    gripper: str = setting("panda", "The gripper that grasps are for.", choices=tuple(GRIPPERS))
    friction: float = setting(FRICTION, "Least coefficient of friction between pads and things.", within=(0.05, 2.0))
    placement: float = setting(
        PLACEMENT, "Metres, one sigma, by which the hand is beside where it is sent to.", within=(0.0, 0.05)
    )
    min_score: float = setting(0.3, "Grasps that hold with less probability are not published.", within=(0.0, 1.0))
    only_id: int = setting(-1, "Plan for the body of this id alone; -1: for all.", within=(-1, 2**31 - 1))
    region: tuple[float, ...] = setting(
        EVERYWHERE,
        "Plan for bodies whose centre is within least x, y, z and greatest x, y, z, in the frame of the cloud; the "
        "default keeps all.",
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
