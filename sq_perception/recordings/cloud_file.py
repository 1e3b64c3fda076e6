"""Point clouds, of PCD and PLY files or messages, as depth images: metres of the optical frame, seen from its origin.

An ORGANISED cloud (a PCD of several rows) of a pinhole camera IS a depth image: z, and the camera from the points
themselves, as u = fx x / z + cx.  Any other cloud is looked at from the origin: each pixel takes its nearest point.
Nothing is then known of the space beside an object (``RecordedFrame.has_free_space``), as points of several views, or
thinned ones, leave gaps through which one sees what is behind.  Points far off the axis are left out.  A field
``instance`` or ``label`` of the points holds the objects that they belong to, 0 for none: the masks of the image.
:class:`CloudFrame` is the camera of a cloud in another frame: z up, as of a robot or a table, or y up, as of graphics.

References: PCD, https://pointclouds.org/documentation/tutorials/pcd_file_format.html; LZF, which packs it, is
http://oldhome.schmorp.de/marc/liblzf.html; trimesh reads PLY.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sq_perception.files.unpacking import MOST_BYTES, MOST_PIXELS, UnpackingError, npy_array, npz_arrays
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.kernels import kernel
from sq_perception.imaging.camera import GREATEST_DEPTH, LEAST_DEPTH, Camera
from sq_perception.tracking.state import parse_pose

SUFFIXES = (".pcd", ".ply")
LABEL_FIELDS = ("instance", "label")  # fields with the object of each point; the first of them that is there counts
LABELLED = "the labels of the points are the masks of objects (ignore masks: segment instead)"
MESH_SUFFIXES = (".ply", ".obj", ".stl", ".off")  # files that may hold a mesh; a PLY or OBJ may be a cloud as well
UNORGANISED = (
    "a cloud that is no image, seen from its origin, without points more than 60 degrees off its axis: nothing is "
    "known of the space beside an object, so that the side that is not seen is less sure; a depth image or an "
    "organised cloud shows more"
)


class Cloud(NamedTuple):
    """Points (height, width, 3), one row where they are not organised, NaN for none; and labels (height, width)."""

    points: np.ndarray
    labels: np.ndarray | None


class CloudImage(NamedTuple):
    """A cloud as a depth image (height, width), its camera, labels, and whether the points were an image before."""

    depth: np.ndarray
    camera: Camera
    labels: np.ndarray | None
    is_image: bool


def read_cloud(path: Path) -> Cloud:
    """Read a PCD, a PLY, or an NPZ of ``points`` and ``labels``."""
    _check_size(path)
    reader = {".pcd": _pcd, ".npz": _npz}.get(path.suffix.lower(), _ply)
    try:
        points, labels = reader(path)
    except UnpackingError:
        raise
    except Exception as error:  # whatever damaged files lead to
        raise UnpackingError(f"not a readable cloud: {type(error).__name__}: {error}") from error
    return Cloud(points.astype(float), None if labels is None else labels_of(labels))


def labels_of(numbers: np.ndarray) -> np.ndarray:
    """Return labels as int32, 0 for what is none: negative, or NaN."""
    found = np.nan_to_num(numbers.astype(float), nan=0.0, posinf=np.inf, neginf=0.0).clip(0)
    if found.size and (found.max() > np.iinfo(np.int32).max or (found != np.rint(found)).any()):
        raise UnpackingError(f"labels: expected whole numbers below 2^31, got {found.max():g}")
    return found.astype(np.int32)


def read_surface(path: Path) -> Any:
    """Return points (n, 3) of a cloud, or the mesh of a file that has faces: ``vertices`` and ``faces``."""
    suffix = path.suffix.lower()
    if suffix == ".npy":
        array = npy_array(path)
        if array.ndim != 2 or array.shape[1] != 3:
            raise UnpackingError(f"expected an array of shape (n, 3), got {array.shape}")
        return array
    if suffix == ".pcd":
        return read_cloud(path).points.reshape(-1, 3)
    if suffix not in MESH_SUFFIXES:
        raise UnpackingError(f"expected a name that ends in .pcd, .npy, {', '.join(MESH_SUFFIXES)}")
    import trimesh

    _check_size(path)
    try:
        found: Any = trimesh.load(path, file_type=suffix[1:], process=False, skip_materials=True)
        found = found.to_geometry() if isinstance(found, trimesh.Scene) else found
        if len(getattr(found, "faces", ())):
            return found
        return np.array(found.vertices, dtype=float).reshape(-1, 3)
    except Exception as error:  # whatever damaged files lead to
        raise UnpackingError(f"not a readable cloud or mesh: {type(error).__name__}: {error}") from error


def _check_size(path: Path) -> None:
    if path.stat().st_size > MOST_BYTES:
        raise UnpackingError(f"expected at most {MOST_BYTES} bytes, got {path.stat().st_size}")


def as_image(points: np.ndarray, labels: np.ndarray | None = None) -> CloudImage:
    """Return the image of points (height, width, 3) and their labels (height, width).  Raises UnpackingError if they do
    not lie before a camera in the origin that looks along z."""
    least = 100
    with np.errstate(all="ignore"):
        there = np.isfinite(points).all(axis=2) & (points[..., 2] != 0)
        before = there & (points[..., 2] > LEAST_DEPTH) & (points[..., 2] < GREATEST_DEPTH)
        # 60 degrees off the axis, the edge of the widest images: one point beside the camera, as in clouds of several
        # views, would leave no pixels for all others.
        near = before & (np.abs(points[..., :2]).max(axis=2) < 1.75 * points[..., 2])
    count = int(np.count_nonzero(there))
    behind, off = (float(np.count_nonzero(some)) / max(count, 1) for some in (there & ~before, before & ~near))
    expected = (
        f"expected {least} points or more, most of them before the camera: x right, y down, z forward from it; "
        f"of {count} points {behind:.0%} are behind it and {off:.0%} more than 60 degrees off its axis. A cloud in the "
        "frame of a robot, a table or a map (z up) needs --frame (of a node: camera_frame); "
        "clouds of whole objects are for sq-perception fit"
    )
    if behind > 0.5:
        expected += " (of clouds with z backward, as graphics has it, negate z, and y where it is up)"
    if np.count_nonzero(before) < least or behind > 0.5:
        raise UnpackingError(expected)
    if points.shape[0] > 1:
        v, u = (index[:: 1 + np.count_nonzero(before) // 20000] for index in np.nonzero(before))
        x, y, z = points[v, u].astype(float).T
        tangents = np.stack([x / z, y / z], axis=1)
        (fx, cx), (fy, cy) = _line(tangents[:, 0], u), _line(tangents[:, 1], v)
        error = np.abs(tangents * [fx, fy] + [cx, cy] - np.stack([u, v], axis=1))
        if min(fx, fy) > 0 and np.count_nonzero(error < 0.1) > 0.99 * error.size:
            depth = np.where(before, points[..., 2], np.nan).astype(np.float32)
            return CloudImage(depth, Camera(points.shape[1], points.shape[0], fx, fy, cx, cy), labels, True)
    if np.count_nonzero(near) < max(least, 2 / 3 * count):
        raise UnpackingError(expected)
    x, y, z = points[near].astype(float).T
    tangents = np.stack([x / z, y / z], axis=1)
    if (layered := _layered_share(tangents, z)) > 0.5:
        raise UnpackingError(
            f"{layered:.0%} of the points lie before or behind others, as in the cloud of a whole object and not in "
            "that of one camera: sq-perception fit takes clouds of whole objects"
        )
    return _seen(tangents, z, None if labels is None else labels[near])


def _layered_share(tangents: np.ndarray, z: np.ndarray) -> float:
    """Return the share of points whose neighbours in the image lie on no common plane: those of a front and a back.
    Seven to nine in ten of an object's from all sides, one in five of a sparse one of a crowded table from one."""
    from scipy.spatial import cKDTree

    some = np.linspace(0, len(z) - 1, min(500, len(z))).astype(int)
    near = cKDTree(tangents).query(tangents[some], k=16)[1]
    offset = tangents[near] - tangents[some][:, None]
    offset /= np.maximum(np.abs(offset).max(axis=(1, 2), keepdims=True), 1e-12)
    rows = np.concatenate([offset, np.ones((*offset.shape[:2], 1))], axis=2)
    depth = z[near] / z[some][:, None]
    transposed = np.swapaxes(rows, 1, 2)
    plane = np.linalg.solve(transposed @ rows + 1e-9 * np.eye(3), transposed @ depth[..., None])
    off = np.abs(depth - (rows @ plane)[..., 0])
    return float(np.mean(np.median(off, axis=1) > 0.01))


def _line(tangents: np.ndarray, pixels: np.ndarray) -> tuple[float, float]:
    """Return f and c of the line pixel = f tangent + c with the least squares; (0, 0) where all tangents are one."""
    middle = tangents.mean()
    spread = tangents - middle
    square = spread @ spread
    focal = float(spread @ pixels / square) if square > 0 else 0.0
    return focal, float(pixels.mean() - focal * middle) if focal else 0.0


def _seen(tangents: np.ndarray, z: np.ndarray, labels: np.ndarray | None) -> CloudImage:
    """Return the nearest point in each pixel of a camera that is as fine as the points."""
    from scipy.spatial import cKDTree

    some = tangents[:: max(1, len(tangents) // 2000)]
    spacing = float(np.median(cKDTree(tangents).query(some, k=2)[0][:, 1]))
    low, high = tangents.min(axis=0), tangents.max(axis=0)
    finest = float((high - low).max()) / 1022
    pixel = max(spacing * np.sqrt(2.0), finest, 1e-9)  # two points a pixel: few of a surface stay empty
    width, height = (int(side) + 2 for side in np.ceil((high - low) / pixel))
    column, row = np.rint((tangents - low) / pixel).astype(int).T
    order = np.argsort(-z, kind="stable")  # of what is assigned to one pixel the last counts
    depth = np.full((height, width), np.nan, np.float32)
    depth[row[order], column[order]] = z[order]
    shown = None if labels is None else np.zeros((height, width), np.int32)
    if shown is not None and labels is not None:
        shown[row[order], column[order]] = labels[order]
    camera = Camera(width, height, 1 / pixel, 1 / pixel, float(-low[0] / pixel), float(-low[1] / pixel))
    return CloudImage(depth, camera, shown, False)


def _npz(path: Path) -> Cloud:
    fields = npz_arrays(path, ("points", "labels"))
    points, labels = fields["points"], fields.get("labels")
    if points.dtype.kind not in "fiu" or points.ndim not in (2, 3) or points.shape[-1] != 3:
        raise UnpackingError(f"points: expected (n, 3) or (height, width, 3), got {points.dtype} {points.shape}")
    if labels is not None and (labels.dtype.kind not in "fiub" or labels.shape != points.shape[:-1]):
        raise UnpackingError(f"labels: expected numbers {points.shape[:-1]}, got {labels.dtype} {labels.shape}")
    points = points[None] if points.ndim == 2 else points
    return Cloud(points, None if labels is None else labels.reshape(points.shape[:2]))


def _ply(path: Path) -> Cloud:
    import trimesh

    found: Any = trimesh.load(path, file_type="ply", process=False)
    points: np.ndarray = np.array(found.vertices, dtype=np.float64)
    data = found.metadata.get("_ply_raw", {}).get("vertex", {}).get("data", {})
    names = data.dtype.names if isinstance(data, np.ndarray) else data
    name = next((name for name in LABEL_FIELDS if name in names), None)
    return Cloud(points[None], None if name is None else np.asarray(data[name]).reshape(1, len(points)))


def _pcd(path: Path) -> Cloud:
    data = path.read_bytes()
    head: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in head:
        end = data.index(b"\n", at)
        name, *values = data[at:end].decode("ascii", errors="replace").split() or [""]
        head[name], at = values, end + 1
    width, height = int(head["WIDTH"][0]), int(head["HEIGHT"][0])
    count = width * height
    if not (0 < count <= MOST_PIXELS and width > 0):
        raise UnpackingError(f"expected 1 to {MOST_PIXELS} points, got {width} x {height}")
    counts = [int(part) for part in head.get("COUNT", ["1"] * len(head["FIELDS"]))]
    kinds = [f"<{kind.lower()}{size}" for kind, size in zip(head["TYPE"], head["SIZE"], strict=True)]
    field = next((name for name in LABEL_FIELDS if name in head["FIELDS"]), None)
    where = [head["FIELDS"].index(name) for name in ("x", "y", "z", *([field] if field else []))]

    def cloud(columns: list[np.ndarray]) -> Cloud:
        labels = columns[3].reshape(height, width) if field else None
        return Cloud(np.stack(columns[:3], axis=1).reshape(height, width, 3), labels)

    if head["DATA"] == ["ascii"]:
        columns = np.cumsum([0, *counts])
        table = np.array(data[at:].split(), dtype=float).reshape(count, columns[-1])
        return cloud([table[:, columns[k]] for k in where])
    layout = np.dtype([(f"{k}", kind, (number,)) for k, (kind, number) in enumerate(zip(kinds, counts, strict=True))])
    if head["DATA"] == ["binary_compressed"]:
        # Packed column by column: all x, then all y.
        packed, size = (int(number) for number in np.frombuffer(data, "<u4", 2, at))
        if size != count * layout.itemsize or size > MOST_BYTES or packed > len(data) - at - 8:
            raise UnpackingError(f"expected {count * layout.itemsize} bytes of points, got {size} in {packed}")
        unpacked = np.zeros(size, np.uint8)
        if not _unpack(np.frombuffer(data, np.uint8, packed, at + 8), unpacked):
            raise UnpackingError("expected bytes that LZF packed")
        ends = count * np.cumsum([0, *(layout[k].itemsize for k in range(len(kinds)))])
        return cloud([unpacked[ends[k] : ends[k + 1]].view(kinds[k]).reshape(count, counts[k])[:, 0] for k in where])
    if head["DATA"] != ["binary"]:
        raise UnpackingError(f"DATA: expected ascii, binary or binary_compressed, got {' '.join(head['DATA'])}")
    rows = np.frombuffer(data, layout, count, at)
    return cloud([rows[f"{k}"][:, 0] for k in where])


@kernel
def _unpack(packed: np.ndarray, out: np.ndarray) -> bool:
    """Unpack LZF: runs of literals, and copies of what came before; False if it is not just what ``out`` holds."""
    i, n, to = 0, len(packed), 0
    while i < n:
        control = int(packed[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > n or to + length > len(out):
                return False
            for k in range(length):
                out[to + k] = packed[i + k]
            i += length
        else:
            length = control >> 5
            if length == 7:
                if i >= n:
                    return False
                length += int(packed[i])
                i += 1
            length += 2
            if i >= n:
                return False
            start = to - ((control & 31) << 8) - int(packed[i]) - 1
            i += 1
            if start < 0 or to + length > len(out):
                return False
            for k in range(length):
                out[to + k] = out[start + k]
        to += length
    return to == len(out)


@dataclass(frozen=True)
class CloudFrame:
    """Where the camera is in the frame of a cloud: its place, and its rotation where that is known.  With R, t the pose
    of its optical frame in the cloud's frame, p_optical = R^T (p - t), metres."""

    place: tuple[float, ...]
    quaternion: tuple[float, ...] | None

    @classmethod
    def parse(cls, text: str) -> CloudFrame:
        """Return the frame that a user names; ValueError for anything else."""
        # Of the optical frame in frames with the same origin: x forward, z up; and y up, z backward.
        axes = {"link": (0.5, -0.5, 0.5, -0.5), "graphics": (1.0, 0.0, 0.0, 0.0)}
        if text in axes:
            return cls((0.0, 0.0, 0.0), axes[text])
        try:
            numbers = [float(part) for part in text.split(",")]
            if len(numbers) not in (3, 7):
                raise ValueError
            turn, place = parse_pose((numbers[3:] or [0.0, 0.0, 0.0, 1.0], numbers[:3]))
        except ValueError:
            raise ValueError(
                "expected where the camera stood in the frame of the cloud, X,Y,Z (it looks at the middle of the "
                "points) or X,Y,Z,QX,QY,QZ,QW (its optical frame), or the axes of a cloud around the camera: link "
                f"(x forward, z up) or graphics (y up, z backward); got {text!r}"
            ) from None
        return cls(tuple(place.tolist()), tuple(turn.tolist()) if len(numbers) == 7 else None)

    def pose(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return R (3, 3) and t (3,) of the camera before these points (..., 3)."""
        place = np.array(self.place)
        if self.quaternion is not None:
            return quaternions.to_matrix(np.array(self.quaternion)), place
        forward = np.median(points[np.isfinite(points).all(axis=-1)], axis=0) - place
        right = np.cross(forward, [0.0, 0.0, 1.0])
        if np.linalg.norm(right) < 1e-6 * np.linalg.norm(forward):  # straight down or up: any direction is right
            right = np.array([1.0, 0.0, 0.0])
        columns = np.stack([right, np.cross(forward, right), forward], axis=1)
        lengths = np.linalg.norm(columns, axis=0)
        if not lengths.min() > 0:
            raise ValueError("expected points somewhere else than in the camera")
        return columns / lengths, place

    def to_optical(self, points: np.ndarray) -> tuple[np.ndarray, str]:
        """Return points (..., 3) in the camera's optical frame, and a note about that."""
        rotation, place = self.pose(points)
        at, turn = (
            " ".join(f"{value:.6g}" for value in values) for values in (place, quaternions.from_matrix(rotation))
        )
        note = f"results are in the frame of a camera at {at}, turned {turn} (x y z w)"
        return move(points, rotation.T, -rotation.T @ place), note


def move(points: np.ndarray, rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return R p + t of points (..., 3); NaN where nothing was measured, which is NaN or (0, 0, 0) before."""
    there = points.any(axis=-1, keepdims=True)
    return np.where(there, points @ rotation.T + shift, np.nan).astype(points.dtype)
