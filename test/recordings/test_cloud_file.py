"""Clouds: an organised one is the image that it came from, any other one is seen again, and nothing hostile is read."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from sq_perception import Camera, Recoverer, RecoveryOptions, Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.imaging import raycast
from sq_perception.recordings import cloud_file
from sq_perception.recordings.cloud_file import UNORGANISED, CloudFrame, move
from sq_perception.recordings.frame_file import FrameError, Reading, read
from sq_perception.segmentation import support_plane

CAMERA = Camera(160, 120, 210.0, 200.0, 80.5, 58.25)
BODY = Superquadric([0.06, 0.04, 0.05], [0.2, 0.2], [0.01, 0.02, 0.7], [0.4, 0.2, 0.1, 0.8])


def points():
    depth, _ = raycast.render(BODY, CAMERA)
    depth = np.where(np.isfinite(depth), depth, 1.2)
    depth[:10, :10] = np.nan
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    return depth, CAMERA.unproject(u, v, depth)


def pcd(path, cloud, kind="binary"):
    """As PCL writes it, with a padding and a colour behind the coordinates."""
    height, width, _ = cloud.shape
    head = f"""# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z _ rgb
SIZE 4 4 4 1 4
TYPE F F F U F
COUNT 1 1 1 4 1
WIDTH {width}
HEIGHT {height}
VIEWPOINT 0 0 0 1 0 0 0
POINTS {width * height}
DATA {kind}
"""
    flat = cloud.reshape(-1, 3).astype("<f4")
    if kind == "binary_compressed":
        count = len(flat)
        columns = b"".join(column.tobytes() for column in flat.T) + bytes(4 * count) + bytes(4 * count)
        literals = (columns[k : k + 32] for k in range(0, len(columns), 32))
        packed = b"".join(bytes([len(part) - 1]) + part for part in literals)
        body = np.array([len(packed), len(columns)], "<u4").tobytes() + packed
    elif kind == "ascii":
        body = "\n".join(f"{x} {y} {z} 0 0 0 0 0.5" for x, y, z in flat).encode()
    else:
        rows = np.zeros(len(flat), np.dtype([("p", "<f4", 3), ("_", "u1", 4), ("rgb", "<f4")]))
        rows["p"] = flat
        body = rows.tobytes()
    path.write_bytes(head.encode() + body)
    return path


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_an_organised_cloud_is_its_depth_image(tmp_path, kind):
    depth, cloud = points()
    frame = read(pcd(tmp_path / "a.pcd", cloud, kind))
    np.testing.assert_allclose(frame.depth, depth, rtol=1e-6)
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(frame.camera, name) == pytest.approx(getattr(CAMERA, name), abs=1e-2)
    assert frame.has_free_space
    assert not frame.warning
    path = pcd(tmp_path / "a.pcd", 1e3 * cloud)
    path.write_bytes("# a comment may have any letters: mesuré\n".encode() + path.read_bytes())
    assert read(path, reading=Reading(scale=1000.0)).depth[50, 50] == frame.depth[50, 50]
    with pytest.raises(FrameError, match="z forward"):
        read(pcd(tmp_path / "behind.pcd", -cloud, kind))


def test_lzf_copies_what_came_before_and_stays_within_its_buffers():
    def unpacked(packed: bytes, size: int) -> bytes | None:
        out = np.zeros(size, np.uint8)
        return out.tobytes() if cloud_file._unpack(np.frombuffer(packed, np.uint8), out) else None

    assert unpacked(b"\x02abc" + bytes([4 << 5, 2]), 9) == b"abcabcabc"
    assert unpacked(b"\x00a" + bytes([7 << 5, 11, 0]), 21) == b"a" * 21
    short, long, cut = (b"\x02abc", 4), (b"\x02abc", 2), (b"\x05abc", 6)
    for packed, size in (short, long, cut, (b"\x00a\x80\x05", 7), (b"\x00a\xe0", 9)):
        assert unpacked(packed, size) is None


def test_a_cloud_in_any_order_is_seen_again(tmp_path):
    """A PLY of shuffled points: its pixels hold points of the cloud, most of them, and the body keeps its seen size."""
    _, cloud = points()
    flat = cloud[np.isfinite(cloud).all(axis=2)]
    np.random.default_rng(0).shuffle(flat)
    trimesh.PointCloud(flat).export(tmp_path / "a.ply")
    frame = read(tmp_path / "a.ply")
    assert frame.warning == UNORGANISED
    assert not frame.has_free_space
    with pytest.raises(FrameError, match="no pixels that a mask could be of"):
        read(tmp_path / "a.ply", reading=Reading(masks=tmp_path))
    rows, columns = np.nonzero(np.isfinite(frame.depth))
    assert np.isfinite(frame.depth).mean() > 0.8
    seen = frame.camera.unproject(columns, rows, frame.depth[rows, columns])
    width = np.median(seen[:, 2]) / frame.camera.fx
    assert np.quantile(np.abs(flat[:, None] - seen[None, ::97]).sum(axis=2).min(axis=0), 0.9) < 2 * width
    mask = (frame.depth < 1.0).astype(np.int32)
    options = RecoveryOptions(method="symmetry", free_space=frame.has_free_space)
    (found,) = Recoverer(method="symmetry").recover(frame.depth, frame.camera, mask, options).bodies
    error = np.abs(np.sort(found.superquadric.size) - np.sort(BODY.size))
    assert (error < np.maximum(0.006, 3 * np.sort(found.sigma_size))).all()


def test_points_far_off_the_axis_take_no_pixels_from_others(tmp_path):
    """One near the plane of the origin, as clouds of several views have."""
    _, cloud = points()
    flat = cloud[np.isfinite(cloud).all(axis=2)]
    trimesh.PointCloud(flat).export(tmp_path / "a.ply")
    trimesh.PointCloud(np.concatenate([flat, [[0.3, 0.1, 0.0005], [1.0, 0.1, 0.02]]])).export(tmp_path / "b.ply")
    clean, strayed = read(tmp_path / "a.ply"), read(tmp_path / "b.ply")
    assert strayed.camera == clean.camera
    np.testing.assert_array_equal(strayed.depth, clean.depth)
    assert "60 degrees off its axis" in strayed.warning
    trimesh.PointCloud(flat[:, [2, 1, 0]] * [1, 1, 0.01]).export(tmp_path / "c.ply")
    with pytest.raises(FrameError, match="expected 100 points or more, most of them before the camera"):
        read(tmp_path / "c.ply")


def table_cloud(rng):
    """Shuffled points of a box (1) and a can (2) on a table (0) before the camera, and the labels of all."""
    depth, _ = raycast.render(BODY, CAMERA)
    other = Superquadric([0.03, 0.03, 0.05], [0.2, 1.0], [0.14, 0.05, 0.75], [0.5, 0.5, 0.5, 0.5])
    beside, _ = raycast.render(other, CAMERA)
    labels = np.where(np.isfinite(depth), 1, np.where(np.isfinite(beside), 2, 0))
    depth = np.where(np.isfinite(depth), depth, np.where(np.isfinite(beside), beside, 0.9))
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    order = rng.permutation(depth.size)
    return CAMERA.unproject(u, v, depth).reshape(-1, 3)[order], labels.ravel()[order]


def write_labelled(path, points, labels, field="label"):
    """A PCD, PLY or NPZ with labels, of the types that their usual writers give them."""
    if path.suffix == ".npz":
        np.savez(path, points=points, labels=labels)
        return path
    rows = np.zeros(len(points), [(axis, "<f4") for axis in "xyz"] + [(field, "<i4")])
    for k, axis in enumerate("xyz"):
        rows[axis] = points[:, k]
    rows[field] = labels
    if path.suffix == ".ply":
        properties = "\n".join(f"property float {axis}" for axis in "xyz") + f"\nproperty int {field}"
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}\nend_header\n"
    else:
        head = f"FIELDS x y z {field}\nSIZE 4 4 4 4\nTYPE F F F U\nWIDTH {len(rows)}\nHEIGHT 1\nDATA binary\n"
    path.write_bytes(head.encode() + rows.tobytes())
    return path


@pytest.mark.parametrize(("name", "field"), [("a.pcd", "label"), ("a.ply", "instance"), ("a.npz", "")])
def test_labels_of_points_are_the_masks_of_the_image(tmp_path, rng, name, field):
    points, labels = table_cloud(rng)
    frame = read(write_labelled(tmp_path / name, points, labels, field))
    assert cloud_file.LABELLED in frame.notes
    there = np.isfinite(frame.depth)
    assert set(np.unique(frame.labels)) == {0, 1, 2}
    assert not frame.labels[~there].any()
    rows, columns = np.nonzero(there)
    nearest = cKDTree(points).query(frame.camera.unproject(columns, rows, frame.depth[there]))[1]
    assert np.mean(labels[nearest] == frame.labels[there]) > 0.98, "all but those along edges"
    (box, can) = Recoverer(method="symmetry").recover(frame.depth, frame.camera, frame.labels).bodies
    assert {box.label, can.label} == {1, 2}
    assert read(tmp_path / name, reading=Reading(ignore_masks=True)).labels is None


def test_labels_of_an_organised_cloud_keep_their_pixels_and_odd_ones_are_refused(tmp_path):
    depth, cloud = points()
    labels = np.where(depth < 1.0, 3.0, -1.0)
    labels[20, :5] = np.nan
    np.savez(tmp_path / "a.npz", points=cloud, labels=labels)
    np.testing.assert_array_equal(read(tmp_path / "a.npz").labels, np.where(depth < 1.0, 3, 0))
    for wrong, said in ((labels + 0.5, "whole numbers"), (labels[:-1], r"labels: expected numbers \(120, 160\)")):
        np.savez(tmp_path / "a.npz", points=cloud, labels=wrong)
        with pytest.raises(FrameError, match=said):
            read(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", points=cloud[..., :2])
    with pytest.raises(FrameError, match=r"points: expected \(n, 3\)"):
        read(tmp_path / "a.npz")


def test_a_cloud_in_another_frame_is_seen_from_its_camera(tmp_path):
    """By the camera's pose an organised cloud is the same image; by its place alone the same points are seen."""
    depth, cloud = points()
    cloud[0, 0] = 0.0  # nothing measured, in any frame
    turn, place = quaternions.normalize(np.array([0.6, -0.5, 0.4, -0.5])), np.array([0.3, -0.4, 1.2])
    there = move(cloud, quaternions.to_matrix(turn), place)
    there[0, 0] = 0.0
    np.savez(tmp_path / "a.npz", points=there)
    pose = ",".join(str(number) for number in (*place, *turn))
    frame = read(tmp_path / "a.npz", reading=Reading(frame=CloudFrame.parse(pose)))
    np.testing.assert_allclose(frame.depth, np.where(depth > 0, depth, np.nan), rtol=1e-5)
    assert "camera at 0.3 -0.4 1.2, turned" in frame.notes
    np.savez(tmp_path / "b.npz", depth=depth, K=CAMERA.matrix)
    with pytest.raises(FrameError, match="frame: expected a cloud"):
        read(tmp_path / "b.npz", reading=Reading(frame=CloudFrame.parse("link")))
    looking = read(tmp_path / "a.npz", reading=Reading(frame=CloudFrame.parse("0.3,-0.4,1.2")))
    rows, columns = np.nonzero(np.isfinite(looking.depth))
    distances = np.linalg.norm(looking.camera.unproject(columns, rows, looking.depth[rows, columns]), axis=1)
    assert np.median(distances) == pytest.approx(np.nanmedian(np.linalg.norm(cloud, axis=2)), rel=0.02)


@pytest.mark.parametrize(("name", "point"), [("link", [1.0, -0.2, -0.1]), ("graphics", [0.2, -0.1, -1.0])])
def test_axes_around_the_camera_have_names(name, point):
    """A point a metre before the camera, 0.2 m to its right and 0.1 m below."""
    seen, _ = CloudFrame.parse(name).to_optical(np.array([point]))
    np.testing.assert_allclose(seen, [[0.2, 0.1, 1.0]], atol=1e-12)
    down, _ = CloudFrame.parse("0,0,1").to_optical(np.array([[x, y, 1e-9] for x in (-0.2, 0.2) for y in (-0.2, 0.2)]))
    np.testing.assert_allclose(down[:, 2], 1.0, atol=0.02)


@pytest.mark.parametrize("text", ["", "up", "1,2", "1,2,3,4", "1,2,nan", "0,0,0,0,0,0,0"])
def test_what_is_no_place_of_a_camera_is_refused(text):
    with pytest.raises(ValueError, match="expected where the camera stood"):
        CloudFrame.parse(text)


def test_no_free_space_means_that_what_is_beside_says_nothing(monkeypatch):
    """The same body before a near wall and a far one: without free space both give the same fit."""
    depth, index = raycast.render(BODY, CAMERA)
    mask = (index >= 0).astype(np.int32)
    recoverer = Recoverer(method="symmetry")
    sizes = []
    monkeypatch.setattr(support_plane, "around", lambda *_: None)  # a wall is no support
    for behind in (0.9, 3.0):
        image = np.where(np.isfinite(depth), depth, behind).astype(np.float32)
        options = RecoveryOptions(method="symmetry", free_space=False)
        sizes.append(recoverer.recover(image, CAMERA, mask, options).bodies[0].superquadric.size)
    np.testing.assert_array_equal(*sizes)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "not a readable cloud"),
        (b"DATA binary\n", "not a readable cloud"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 100000\nHEIGHT 100000\nDATA binary\n", "points, got"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 10\nHEIGHT 1\nDATA binary\n1234", "not a readable cloud"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 10\nHEIGHT 1\nDATA zipped\n", "got zipped"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 9\nHEIGHT 1\nDATA binary_compressed\n1234", "not a readable"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nHEIGHT 1\nDATA ascii\n1 2 3\n", "or more"),
    ],
)
def test_what_is_no_cloud_is_refused(tmp_path, content, said):
    path = tmp_path / "a.pcd"
    path.write_bytes(content)
    with pytest.raises(FrameError, match=said):
        read(path)
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(FrameError, match="not a readable cloud"):
        read(tmp_path / "a.ply")


@pytest.mark.parametrize("origin", [(0, 0, 0), (0.5, 0, 0), (0.5, 0, -0.05)])
def test_a_cloud_in_the_frame_of_a_table_or_robot_is_refused_with_what_is_not_seen(tmp_path, rng, origin):
    """z up, the origin on the table, beside it or a little below: most points are beside the axis of a camera there."""
    table = np.concatenate([rng.uniform(-0.5, 0.5, (4000, 2)), 0.002 * rng.standard_normal((4000, 1))], axis=1)
    box = rng.uniform([-0.05, -0.03, 0.0], [0.05, 0.03, 0.16], (800, 3))
    trimesh.PointCloud(np.concatenate([table, box]) - origin).export(tmp_path / "a.ply")
    with pytest.raises(FrameError, match=r"of 4800 points \d+% are behind it and \d+% more than 60 .* needs --frame"):
        read(tmp_path / "a.ply")


