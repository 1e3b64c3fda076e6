"""Stand-ins for messages of packages that are not on PyPI: the fields of their definitions, and no others.

Definitions: tf2_msgs of geometry2 (jazzy), vision_msgs 4.1.1, moveit_msgs (ros2) and object_recognition_msgs.  As in
the classes that rosidl makes, an unknown field or a wrong type raises, and a ``byte`` is bytes of length 1.  Fields of
the planning scene that nobody here touches (joints, colours, octomaps) are left out.  Services need what only a build
has: a test that calls one skips where the package is not installed.
"""

import sys
import types
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import pytest
from geometry_msgs.msg import Pose, PoseStamped, PoseWithCovariance, Vector3, Vector3Stamped
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory


def definition(name: str, constants: dict[str, Any] | None = None, /, **fields: Callable[[], Any]) -> type[Any]:
    """A message class with these fields: the type of each, or another that makes its default."""

    def fill(self: Any, **values: Any) -> None:
        unknown = set(values) - set(fields)
        assert not unknown, f"{name} has no {unknown}"
        for field, make in fields.items():
            setattr(self, field, values.get(field, make()))

    def put(self: Any, field: str, value: Any) -> None:
        assert field in fields, f"{name} has no {field}"
        wanted = type(fields[field]())
        assert isinstance(value, wanted), f"{name}.{field}: expected {wanted.__name__}, got {type(value).__name__}"
        object.__setattr__(self, field, value)

    content = {"__slots__": tuple(fields), "__init__": fill, "__setattr__": put, **(constants or {})}
    return type(name, (), content)


TFMessage = definition("TFMessage", transforms=list)

ObjectHypothesis = definition("ObjectHypothesis", class_id=str, score=float)
ObjectHypothesisWithPose = definition("ObjectHypothesisWithPose", hypothesis=ObjectHypothesis, pose=PoseWithCovariance)
BoundingBox3D = definition("BoundingBox3D", center=Pose, size=Vector3)
Detection3D = definition("Detection3D", header=Header, results=list, bbox=BoundingBox3D, id=str)
Detection3DArray = definition("Detection3DArray", header=Header, detections=list)

ObjectType = definition("ObjectType", key=str, db=str)
CollisionObject = definition(
    "CollisionObject", {"ADD": b"\x00", "REMOVE": b"\x01", "APPEND": b"\x02", "MOVE": b"\x03"}, header=Header,
    pose=Pose, id=str, type=ObjectType, primitives=list, primitive_poses=list, meshes=list, mesh_poses=list,
    planes=list, plane_poses=list, subframe_names=list, subframe_poses=list, operation=lambda: b"\x00",
)
RobotState = definition("RobotState", attached_collision_objects=list, is_diff=bool)
PlanningSceneWorld = definition("PlanningSceneWorld", collision_objects=list)
PlanningScene = definition("PlanningScene", name=str, robot_state=RobotState, world=PlanningSceneWorld, is_diff=bool)

GripperTranslation = definition(
    "GripperTranslation", direction=Vector3Stamped, desired_distance=float, min_distance=float
)
Grasp = definition(
    "Grasp", id=str, pre_grasp_posture=JointTrajectory, grasp_posture=JointTrajectory, grasp_pose=PoseStamped,
    grasp_quality=float, pre_grasp_approach=GripperTranslation, post_grasp_retreat=GripperTranslation,
    post_place_retreat=GripperTranslation, max_contact_force=float, allowed_touch_objects=list,
)
MoveItErrorCodes = definition(
    "MoveItErrorCodes", {"SUCCESS": 1, "FAILURE": 99999, "PLANNING_FAILED": -1, "INVALID_OBJECT_NAME": -19}, val=int,
    message=str, source=str,
)

PACKAGES = {
    "tf2_msgs": (TFMessage,),
    "vision_msgs": (ObjectHypothesis, ObjectHypothesisWithPose, BoundingBox3D, Detection3D, Detection3DArray),
    "moveit_msgs": (
        CollisionObject, RobotState, PlanningSceneWorld, PlanningScene, GripperTranslation, Grasp, MoveItErrorCodes,
    ),
}


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the packages importable, each for what it is where it is installed, else with stand-ins."""
    for package, classes in PACKAGES.items():
        if find_spec(package) is None:
            module: Any = types.ModuleType(f"{package}.msg")
            for one in classes:
                setattr(module, one.__name__, one)
            outer: Any = types.ModuleType(package)
            outer.msg = module
            monkeypatch.setitem(sys.modules, package, outer)
            monkeypatch.setitem(sys.modules, f"{package}.msg", module)


def remove(monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    """Make a package one that cannot be imported."""
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setitem(sys.modules, f"{package}.msg", None)
