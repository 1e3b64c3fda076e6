"""Messages made without ROS are those that a node makes: same fields, same bytes, same text of the definition."""

import array

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

from random_bodies import random_bodies
from rosbags.typesys import Stores, get_typestore

from sq_msgs_py import columns, depth_image, superquadrics
from sq_msgs_py.depth_image import Intrinsics
from sq_msgs_py.markers import markers
from sq_msgs_py.message_types import find_type
from sq_msgs_py.superquadrics import FIELDS, SuperquadricArray
from sq_perception.geometry.mesh import mesh, outline
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.recordings import result_bag

TYPES = get_typestore(Stores.ROS2_JAZZY)


RNG = np.random.default_rng(7)
DEPTH = np.where(RNG.random((47, 65)) < 0.2, np.nan, RNG.uniform(0.3, 5, (47, 65))).astype(np.float32)
GREY, BODIES = RNG.integers(0, 256, (5, 7)).astype(np.uint8), random_bodies(3, RNG)
SHAPES = Superquadric(
    [[0.1, 0.2, 0.3]] * 2, [[0.3, 0.8], [1.0, 1.0]], RNG.normal(size=(2, 3)), [[0, 0, 0, 1.0]] * 2
)
MESHES = [(mesh(one, 16).vertices, mesh(one, 16).faces, outline(one)) for one in SHAPES]
MADE = {
    "CameraInfo": lambda at, types: depth_image.intrinsics_to_message(
        Intrinsics(65, 47, 51.5, 52.25, 32.0, 23.5), at, types
    ),
    "DepthImage": lambda at, types: depth_image.depth_to_message(DEPTH, at, "32FC1", types),
    "GreyImage": lambda at, types: depth_image.grey_to_message(GREY, at, types),
    "LabelImage": lambda at, types: depth_image.labels_to_message(GREY % 9, at, "16UC1", types),
    "PointCloud2": lambda at, types: superquadrics.to_message(BODIES, at, types),
    "EmptyCloud": lambda at, types: superquadrics.to_message(SuperquadricArray.empty(), at, types),
    "MarkerArray": lambda at, types: markers(MESHES, [3, 8], at, types=types),
}
"""A message of every kind that is written, of random content that is the same for all types."""


def make(kind, types):
    time = types("builtin_interfaces/msg/Time")(sec=1_700_000_000, nanosec=123_456_789)
    return MADE[kind](types("std_msgs/msg/Header")(stamp=time, frame_id="camera_ä"), types)


@pytest.mark.parametrize("kind", MADE)
def test_the_bytes_are_those_that_rclpy_makes(kind):
    """rclpy leaves the gaps between aligned fields as they are; one pass through rosbags empties them."""
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    from rclpy.serialization import deserialize_message, serialize_message

    live, recorded = make(kind, find_type), make(kind, result_bag.types)
    data, reference = result_bag.as_cdr(recorded), serialize_message(live)
    assert len(data) == len(reference)
    assert data == TYPES.serialize_cdr(TYPES.deserialize_cdr(reference, recorded.__msgtype__), recorded.__msgtype__)
    assert deserialize_message(data, type(live)) == deserialize_message(reference, type(live))


def test_constants_are_those_of_ros():
    """Written out where they are needed, so that reading superquadrics takes NumPy alone."""
    field, marker = (TYPES.types[name] for name in ("sensor_msgs/msg/PointField", "visualization_msgs/msg/Marker"))
    names = {"i1": "INT8", "u1": "UINT8", "i2": "INT16", "u2": "UINT16", "i4": "INT32", "u4": "UINT32"}
    names |= {"f4": "FLOAT32", "f8": "FLOAT64"}
    assert {getattr(field, names[kind]): kind for kind in names} == columns._NUMPY_TYPES
    assert {kind for _, kind in FIELDS} == {field.FLOAT32, field.UINT32}
    first, surface, lines = make("MarkerArray", result_bag.types).markers[:3]
    assert (first.action, surface.action, lines.action) == (marker.DELETEALL, marker.ADD, marker.ADD)
    assert (surface.type, lines.type) == (marker.TRIANGLE_LIST, marker.LINE_LIST)


def test_fields_left_out_have_the_defaults_of_ros():
    marker = result_bag.types("visualization_msgs/msg/Marker")(id=3)
    assert (marker.id, marker.ns, marker.pose.orientation.w, marker.pose.position.z) == (3, "", 1.0, 0.0)
    assert marker.points == []
    camera = result_bag.types("sensor_msgs/msg/CameraInfo")()
    assert [len(one) for one in (camera.d, camera.k, camera.r, camera.p)] == [0, 9, 9, 12]
    with pytest.raises(TypeError):
        result_bag.types("visualization_msgs/msg/Marker")(identity=3)
    with pytest.raises(KeyError):
        result_bag.types("nobody_msgs/msg/Nothing")


def test_numbers_are_taken_as_lists_and_arrays():
    info = result_bag.types("sensor_msgs/msg/CameraInfo")
    numbers = [float(k) for k in range(9)]
    made = [result_bag.as_cdr(info(k=one)) for one in (numbers, array.array("d", numbers), np.array(numbers))]
    assert made[0] == made[1] == made[2]
    np.testing.assert_array_equal(TYPES.deserialize_cdr(made[0], "sensor_msgs/msg/CameraInfo").k, numbers)


def test_definitions_name_all_that_a_message_contains():
    text = result_bag.definition("visualization_msgs/msg/MarkerArray")
    parts = {line.removeprefix("MSG: ") for line in text.splitlines() if line.startswith("MSG: ")}
    assert {"visualization_msgs/Marker", "std_msgs/Header", "geometry_msgs/Point", "builtin_interfaces/Time"} <= parts
