"""Clouds of superquadrics and of points, and markers: the layout as published, read by hand, and what is refused."""

import array
import struct
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("sensor_msgs", reason="message packages missing: install the extra 'ros' or source ROS 2")

from builtin_interfaces.msg import Time
from random_bodies import random_bodies
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from sq_msgs_py import superquadrics
from sq_msgs_py.columns import points_from_message
from sq_msgs_py.markers import PALETTE, markers
from sq_msgs_py.superquadrics import FIELDS, MessageError, Reason, SuperquadricArray

HEADER = Header(stamp=Time(sec=7, nanosec=8), frame_id="optical")
BEFORE = ("size", "shape", "translation", "rotation", "score", "residual", "sigma_size", "id", "status")
COUNTS = ("label", "seen", "fused", "reason", "part")
DEVIATIONS = ("sigma_shape", "sigma_centre", "sigma_turn")
COLUMNS = (*BEFORE, *COUNTS, *DEVIATIONS, "taper", "objectness")
LAYOUT_MORE = "label seen fused reason sigma_e1 sigma_e2 sigma_c1 sigma_c2 sigma_c3 sigma_r1 sigma_r2 sigma_r3"
LAYOUT_LAST = "kx ky objectness part"
LAYOUT_1 = "x y z qx qy qz qw a1 a2 a3 e1 e2 score residual sigma_a1 sigma_a2 sigma_a3 id status"


def test_the_published_layout_does_not_change() -> None:
    """Other programs read these names and types: whoever changes them raises VERSION and this test; more may follow."""
    assert superquadrics.VERSION == 1
    names = [name for name, _ in FIELDS]
    assert " ".join(names[:19]) == LAYOUT_1
    assert " ".join(names[19:]) == f"{LAYOUT_MORE} {LAYOUT_LAST}"
    types = dict(FIELDS)
    assert {types.pop(name) for name in ("id", "status", *COUNTS)} == {PointField.UINT32}
    assert set(types.values()) == {PointField.FLOAT32}


def test_one_body_reads_by_hand() -> None:
    body = SuperquadricArray(
        size=np.array([[1.0, 2.0, 3.0]]), shape=np.array([[0.25, 0.5]]), translation=np.array([[4.0, 5.0, 6.0]]),
        rotation=np.array([[0.0, 0.0, 0.0, 1.0]]), score=np.array([0.75]), residual=np.array([0.125]),
        sigma_size=np.array([[7.0, 8.0, 9.0]]), id=np.array([4_000_000_000]), status=np.array([1]),
        label=np.array([12]), seen=np.array([3]), fused=np.array([1]), reason=np.array([Reason.OPEN_Z | Reason.HULL]),
        sigma_shape=np.array([[0.25, 0.5]]), sigma_centre=np.array([[1.5, 2.5, 3.5]]),
        sigma_turn=np.array([[0.5, 0.25, 0.125]]), taper=np.array([[0.5, -0.25]]), objectness=np.array([0.875]),
        part=np.array([2]),
    )
    message = superquadrics.to_message(body, HEADER)
    assert (message.header, message.height, message.width) == (HEADER, 1, 1)
    assert (message.point_step, message.row_step) == (140, 140)
    numbers = struct.unpack("<17f6I11fI", message.data.tobytes())
    before = (4, 5, 6, 0, 0, 0, 1, 1, 2, 3, 0.25, 0.5, 0.75, 0.125, 7, 8, 9, 4_000_000_000, 1)
    assert numbers == (*before, 12, 3, 1, 4 + 8, 0.25, 0.5, 1.5, 2.5, 3.5, 0.5, 0.25, 0.125, 0.5, -0.25, 0.875, 2)
    assert [field.offset for field in message.fields] == list(range(0, 140, 4))
    assert message.is_dense


def test_a_cloud_of_release_0_2_0_is_read(rng: np.random.Generator) -> None:
    """As its writer laid it out: 76 bytes a point, no field behind the status."""
    before = random_bodies(3, rng)
    columns = (before.translation, before.rotation, before.size, before.shape, before.score, before.residual)
    flat = np.column_stack([*columns, before.sigma_size])
    points = [struct.pack("<17f2I", *flat[k], before.id[k], before.status[k]) for k in range(3)]
    message = PointCloud2(header=HEADER, height=1, width=3, point_step=76, row_step=228)
    for k, name in enumerate(LAYOUT_1.split()):
        kind = PointField.UINT32 if name in ("id", "status") else PointField.FLOAT32
        message.fields.append(PointField(name=name, offset=4 * k, datatype=kind, count=1))
    message.data = array.array("B", b"".join(points))
    after = superquadrics.from_message(message)
    for column in BEFORE:
        np.testing.assert_array_equal(getattr(after, column), getattr(before, column))
    for column in COUNTS:
        np.testing.assert_array_equal(getattr(after, column), np.zeros(3, np.uint32))
    np.testing.assert_array_equal(after.taper, np.zeros((3, 2)))
    for column in DEVIATIONS:
        assert getattr(after, column).shape == getattr(before, column).shape
        assert np.isnan(getattr(after, column)).all()


@pytest.mark.parametrize("count", [0, 1, 10])
def test_the_round_trip_keeps_every_number(count: int, rng: np.random.Generator) -> None:
    before = random_bodies(count, rng)
    message = superquadrics.to_message(before, HEADER)
    assert message.is_dense != np.isnan(before.sigma_size).any(), "what is unknown is declared"
    after = superquadrics.from_message(message)
    assert len(after) == count
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(after, column), getattr(before, column))
        assert getattr(after, column).dtype == getattr(before, column).dtype


def test_readers_go_by_name_offset_type_and_byte_order(rng: np.random.Generator) -> None:
    """A message as another writer might lay it out: big endian, doubles, other order, a field more, two padded rows."""
    bodies = random_bodies(4, rng)
    names = [name for name, _ in FIELDS][::-1]
    formats = [">f4"] + [">u4" if name in ("id", "status", *COUNTS) else ">f8" for name in names]
    offsets = [0] + [4 + 9 * k for k in range(len(names))]
    layout = np.dtype({"names": ["extra", *names], "formats": formats, "offsets": offsets, "itemsize": 400})
    points = np.zeros(4, layout)
    order = ("translation", "rotation", "size", "shape", "score", "residual", "sigma_size")
    for columns, part in ((order, FIELDS[:17]), ((*DEVIATIONS, "taper", "objectness"), FIELDS[-12:-1])):
        numbers = np.column_stack([getattr(bodies, name) for name in columns])
        for k, (name, _) in enumerate(part):
            points[name] = numbers[:, k]
    for name in ("id", "status", *COUNTS):
        points[name] = getattr(bodies, name)
    message = PointCloud2(header=HEADER, height=2, width=2, is_bigendian=True, point_step=400, row_step=805)
    for name in layout.names:
        kind = {"f4": PointField.FLOAT32, "f8": PointField.FLOAT64, "u4": PointField.UINT32}[layout[name].str[1:]]
        message.fields.append(PointField(name=name, offset=layout.fields[name][1], datatype=kind, count=1))
    message.data = array.array("B", b"".join(points[2 * k : 2 * k + 2].tobytes() + b"\xff" * 5 for k in range(2)))
    after = superquadrics.from_message(message)
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(after, column), getattr(bodies, column))


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (lambda cloud: {"fields": [field for field in cloud.fields if field.name != "e1"]}, "missing: e1"),
        (lambda cloud: {"fields": []}, "missing: x y z"),
        (lambda cloud: setattr(cloud.fields[3], "count", 2), "field qx: expected one number"),
        (lambda cloud: setattr(cloud.fields[3], "datatype", 77), "field qx: expected one number, got datatype 77"),
        (lambda cloud: setattr(cloud.fields[5], "offset", 138), "qz: offset 138 lies outside a point of 140 bytes"),
        (lambda cloud: {"data": cloud.data[:-1]}, "420 bytes, got 419"),
        (lambda cloud: {"row_step": 100}, "at least 420 bytes, got 100"),
        (lambda cloud: {"data": struct.pack("<f", np.nan) + cloud.data[4:].tobytes()}, "translation: expected finite"),
    ],
)
def test_other_clouds_are_refused_with_the_reason(broken, words, rng) -> None:
    message = superquadrics.to_message(random_bodies(3, rng), HEADER)
    for name, value in (broken(message) or {}).items():
        setattr(message, name, value)
    with pytest.raises(MessageError, match=words):
        superquadrics.from_message(message)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("shape", np.ones((3, 2))),
        ("shape", np.ones((2, 3))),
        ("score", np.ones((2, 1))),
        ("size", np.full((2, 3), np.inf)),
        ("id", np.array([0.5, 1.0])),
        ("id", np.array([-1, 1])),
        ("status", np.array([0, 2**32])),
    ],
)
def test_columns_that_do_not_fit_are_refused(column: str, value: Any, rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match=f"{column}: expected"):
        SuperquadricArray(**{**vars(random_bodies(2, rng)), column: value})


TETRAHEDRON = (
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
    np.array([[[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 1, 0.0]]]),
)


def test_a_mesh_becomes_its_triangles_and_its_outline() -> None:
    before, surface, outline = markers([TETRAHEDRON], [5], HEADER, namespace="body", alpha=0.5).markers
    assert before.action == Marker.DELETEALL
    assert (surface.ns, surface.id, surface.type) == ("body/surface", 5, Marker.TRIANGLE_LIST)
    assert surface.action == Marker.ADD
    points = np.array([[point.x, point.y, point.z] for point in surface.points])
    np.testing.assert_array_equal(points, TETRAHEDRON[0][TETRAHEDRON[1].reshape(-1)])
    assert (outline.ns, outline.id, outline.type) == ("body/outline", 5, Marker.LINE_LIST)
    ends = np.array([[point.x, point.y, point.z] for point in outline.points])
    np.testing.assert_array_equal(ends, TETRAHEDRON[2].reshape(-1, 3))
    assert outline.scale.x == 0.002
    assert surface.color.a == 0.5
    assert np.float32([surface.color.r, surface.color.g, surface.color.b]) == pytest.approx(np.float32(PALETTE[5]))
    for marker in (surface, outline):
        assert (marker.header, marker.pose.orientation.w) == (HEADER, 1.0)
        assert marker.color.a > 0


@pytest.mark.parametrize(
    ("meshes", "ids", "options"),
    [
        ([TETRAHEDRON], [], {}),
        ([TETRAHEDRON, TETRAHEDRON], [1, 1], {}),
        ([TETRAHEDRON], [-1], {}),
        ([TETRAHEDRON], [2**31], {}),
        ([(TETRAHEDRON[0], TETRAHEDRON[1] + 1, TETRAHEDRON[2])], [1], {}),
        ([(TETRAHEDRON[0][:, :2], TETRAHEDRON[1], TETRAHEDRON[2])], [1], {}),
        ([(TETRAHEDRON[0], TETRAHEDRON[1], np.zeros((2, 3)))], [1], {}),
        ([TETRAHEDRON], [1], {"colours": np.ones((2, 3))}),
    ],
)
def test_meshes_that_do_not_fit_are_refused(meshes: list, ids: list[int], options: dict) -> None:
    with pytest.raises(ValueError, match="expected"):
        markers(meshes, ids, HEADER, **options)


POINTS = np.arange(24, dtype=float).reshape(2, 4, 3)
KINDS = {"f4": 7, "f8": 8, "i2": 3}


def message(kind: str = "f4", order: str = "<", names: str = "zyx", padding: int = 0) -> Any:
    size = np.dtype(kind).itemsize
    step, offsets = 3 * size + padding, {name: k * size for k, name in enumerate(names)}
    layout = {"names": [*names], "formats": [order + kind] * 3, "offsets": [*offsets.values()], "itemsize": step}
    rows = np.zeros((2, 4 + padding), np.dtype(layout))
    for name in names:
        rows[name][:, :4] = POINTS[..., "xyz".index(name)]
    fields = [SimpleNamespace(name=name, offset=at, datatype=KINDS[kind], count=1) for name, at in offsets.items()]
    steps = {"point_step": step, "row_step": step * (4 + padding)}
    return SimpleNamespace(height=2, width=4, fields=fields, is_bigendian=order == ">", data=rows.tobytes(), **steps)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("names", "padding"), [("xyz", 0), ("zyx", 5)])
def test_points_are_read_whatever_their_layout(kind, order, names, padding):
    np.testing.assert_array_equal(points_from_message(message(kind, order, names, padding)), POINTS)


def test_clouds_without_points_and_points_that_no_camera_measures() -> None:
    empty = message()
    vars(empty).update(height=0, data=b"")
    assert points_from_message(empty).shape == (0, 4, 3)
    vars(empty).update(width=0, point_step=2**32 - 1, row_step=0)
    assert points_from_message(empty).shape == (0, 0, 3), "the step of no point may be any number"
    with pytest.raises(MessageError, match="row_step"):
        points_from_message(SimpleNamespace(**{**vars(message()), "row_step": 3}))
    far = message("f8")
    far.data = np.full(len(far.data) // 8, 1e300).tobytes()
    assert np.isinf(points_from_message(far)).all()
