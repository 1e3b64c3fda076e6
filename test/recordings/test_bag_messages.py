"""Messages made without ROS are those that a node makes: same fields, same bytes, same text of the definition."""

from __future__ import annotations

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
KINDS = ("CameraInfo", "DepthImage", "GreyImage", "LabelImage", "PointCloud2", "EmptyCloud", "MarkerArray")


def header(types):
    time = types("builtin_interfaces/msg/Time")(sec=1_700_000_000, nanosec=123_456_789)
    return types("std_msgs/msg/Header")(stamp=time, frame_id="camera_ä")


def make(kind, types):
    """A message of every kind that is written, of random content that is the same for all types."""
    rng, at = np.random.default_rng(7), header(types)
    if kind == "CameraInfo":
        return depth_image.intrinsics_to_message(Intrinsics(65, 47, 51.5, 52.25, 32.0, 23.5), at, types)
    if kind == "DepthImage":
        depth = np.where(rng.random((47, 65)) < 0.2, np.nan, rng.uniform(0.3, 5, (47, 65))).astype(np.float32)
        return depth_image.depth_to_message(depth, at, "32FC1", types)
    if kind == "GreyImage":
        return depth_image.grey_to_message(rng.integers(0, 256, (5, 7)).astype(np.uint8), at, types)
    if kind == "LabelImage":
        return depth_image.labels_to_message(rng.integers(0, 9, (5, 7)), at, "16UC1", types)
    if kind == "PointCloud2":
        return superquadrics.to_message(random_bodies(3, rng), at, types)
    if kind == "EmptyCloud":
        return superquadrics.to_message(SuperquadricArray.empty(), at, types)
    shapes = Superquadric(
        [[0.1, 0.2, 0.3]] * 2, [[0.3, 0.8], [1.0, 1.0]], rng.normal(size=(2, 3)), [[0, 0, 0, 1.0]] * 2
    )
    meshes = [(mesh(one, 16).vertices, mesh(one, 16).faces, outline(one)) for one in (shapes[0], shapes[1])]
    return markers(meshes, [3, 8], at, types=types)


@pytest.mark.parametrize("kind", KINDS)
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
    field, marker = (TYPES.types[f"{name}"] for name in ("sensor_msgs/msg/PointField", "visualization_msgs/msg/Marker"))
    from sq_msgs_py.markers import markers

    names = {"i1": "INT8", "u1": "UINT8", "i2": "INT16", "u2": "UINT16", "i4": "INT32", "u4": "UINT32"}
    names |= {"f4": "FLOAT32", "f8": "FLOAT64"}
    assert {getattr(field, names[kind]): kind for kind in names} == columns._NUMPY_TYPES
    assert {kind for _, kind in FIELDS} == {field.FLOAT32, field.UINT32}
    mesh = np.eye(3), np.array([[0, 1, 2]]), np.zeros((1, 2, 3))
    first, surface, lines = markers([mesh], [1], header(result_bag.types), types=result_bag.types).markers
    assert (first.action, surface.action, lines.action) == (marker.DELETEALL, marker.ADD, marker.ADD)
    assert (surface.type, lines.type) == (marker.TRIANGLE_LIST, marker.LINE_LIST)


def test_a_recorded_cloud_is_read_by_the_code_that_reads_a_live_one(rng):
    before = random_bodies(4, rng)
    data = result_bag.as_cdr(superquadrics.to_message(before, header(result_bag.types), result_bag.types))
    after = superquadrics.from_message(TYPES.deserialize_cdr(data, "sensor_msgs/msg/PointCloud2"))
    for column in vars(before):
        np.testing.assert_array_equal(getattr(after, column), getattr(before, column))


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
