"""What is published of a recovered frame: bodies, ids, meshes, images.  By a node, and into a recording, alike.

With tracking ids are those of the tracks, and bodies the tracks' own numbers; without, ids are mask labels and bodies
those of the frame.  Residual, score and status are always the frame's.

Metres in the optical frame; for frames of the unit cube (``is_cube``) the cube frame of
:mod:`sq_perception.imaging.unit_cube`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from sq_msgs_py import depth_image, poses
from sq_msgs_py.markers import ALPHA, markers
from sq_msgs_py.markers import Mesh as MarkerMesh
from sq_msgs_py.message_types import MessageTypes, find_type
from sq_msgs_py.superquadrics import CONVERGED, Reason, SuperquadricArray
from sq_perception.fitting.fit import Status
from sq_perception.fitting.quality import undetermined
from sq_perception.geometry.mesh import MARKER_RESOLUTION, outline, triangles
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import compressed_depth, depth_units, unit_cube
from sq_perception.imaging.depth_units import Metres, Stated
from sq_perception.recovery.recovery import FrameRecovery, Recovery, edges_as_text
from sq_perception.tracking.session import FIRST_FAILED_ID, Followed

CAMERA_FRAME, CUBE_FRAME = "camera_depth_optical_frame", "unit_cube"  # frame ids of images that bring none

_GREY_TYPES: dict[str, type[np.unsignedinteger]] = {"mono8": np.uint8, "mono16": np.uint16}
_CENTRE = slice(5, 8)
"""Of a body's covariance, beside its exponents at 3 and 4 and its rotation vector, in its own frame, from 8 to 10."""
_OF_A_BODY = ("size", "shape", "translation", "rotation")
"""Columns of a message that are attributes of superquadrics of the same name."""
_OF_EACH_BODY = ("score", "residual", "sigma_size", "status", "label", "objectness")
"""Columns of a message that are attributes of a recovery of the same name."""

Mesh = tuple[np.ndarray, np.ndarray]  # vertices (k, 3) and faces (m, 3) of vertex indices


@dataclass(frozen=True, eq=False)
class Identified:
    """The objects of a frame as they are published.

    ``ids``: the id of each object.  ``hidden``: ids of tracks that the frame does not show.  ``columns``: what a
    message says of each object besides, by its column: ``seen``, frames that showed it so far; ``fused``, whether its
    numbers are those of its track; ``reason``, :class:`~sq_msgs_py.superquadrics.Reason` by the frame's fit and the
    axes that are published.
    """

    recovery: FrameRecovery
    ids: tuple[int, ...]
    hidden: tuple[int, ...] = ()
    columns: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def summary(self, is_cube: bool) -> str:
        """Return the results in a line: ids, status words and full edges, of the unit cube or in millimetres."""
        recovery = self.recovery
        remark = f": {recovery.message}" if recovery.message else ""
        took = f"in {recovery.milliseconds.get('total', 0.0):.0f} ms{remark}"
        if not recovery.bodies:
            return f"no bodies {took}"
        parts = []
        for body, number in zip(recovery.bodies, self.ids, strict=True):
            if body.status == Status.FAILED:
                parts.append(f"{number} failed: {body.message}")
                continue
            edges = edges_as_text(body.superquadric.size, body.sigma_size, is_cube)
            parts.append(f"{number} {body.status.name.lower()} {edges}, score {body.score:.2f}")
        count = len(recovery.bodies)
        return f"{count} {'body' if count == 1 else 'bodies'} {took}; " + "; ".join(parts)


def identify(
    recovery: FrameRecovery, tracks: Sequence[Followed] | None = None, hidden: tuple[int, ...] = ()
) -> Identified:
    """Return bodies and ids of their tracks, of which there is one for each body that did not fail, in their order.
    Without tracks bodies are the frame's, and ids their labels."""
    if tracks is None:
        reasons = tuple(_reason(body, body.superquadric) for body in recovery.bodies)
        return Identified(recovery, tuple(body.label for body in recovery.bodies), columns={"reason": reasons})
    left = iter(tracks)
    bodies, known = [], []
    for body in recovery.bodies:
        if body.status == Status.FAILED:
            bodies.append(body)
            known.append((FIRST_FAILED_ID + body.label, 0, False, 0))
            continue
        track = next(left)
        body = replace(body, cavity=track.cavity)
        bodies.append(
            replace(body, fit=replace(body.fit, superquadric=track.superquadric, covariance=track.covariance))
        )
        known.append((track.id, track.seen, track.is_fused, _reason(body, track.superquadric)))
    ids, *columns = zip(*known, strict=True) if known else ((), (), (), ())
    names = ("seen", "fused", "reason")
    return Identified(replace(recovery, bodies=tuple(bodies)), ids, hidden, dict(zip(names, columns, strict=True)))


def _reason(body: Recovery, shown: Superquadric) -> int:
    """Return the reason that a fit gives for its status, by the axes of the body that is shown in its place."""
    fit = body.fit
    reason = (Reason.HULL if fit.as_hull else Reason(0)) | (Reason(0) if body.cavity is None else Reason.CAVITY)
    if fit.status == Status.WEAK:
        partner = np.abs(shown.rotation_matrix.T @ fit.superquadric.rotation_matrix).argmax(axis=1)
        is_open = undetermined(fit.covariance, fit.superquadric.size)[partner]
        for axis in np.array([Reason.OPEN_X, Reason.OPEN_Y, Reason.OPEN_Z])[is_open]:
            reason |= axis
    return int(reason)


@dataclass(frozen=True, eq=False)
class Findings:
    """What one image showed, as every output but the rendered depth is made of it.

    ``array``: every object, failed ones included.  ``parts``: the parts of those that have some; ids are shared.
    ``covariances`` (n, 6, 6): of the objects' poses, as in :mod:`sq_msgs_py.poses`; NaN where unknown.  ``header``:
    std_msgs/Header: the stamp of the image, and the frame that all this is in.  ``plane`` (4,) or None: the support
    plane, height above it = n.p + d.
    """

    array: SuperquadricArray
    covariances: np.ndarray
    header: Any
    plane: np.ndarray | None = None
    parts: SuperquadricArray = field(default_factory=SuperquadricArray.empty)

    @property
    def cloud(self) -> SuperquadricArray:
        """All rows of the published cloud: the objects, then their parts."""
        return self.array.followed_by(self.parts)

    @property
    def shown_ids(self) -> list[int]:
        """Ids of the bodies that did not fail, those of the meshes."""
        return [int(number) for number in self.array.recovered.id]

    @cached_property
    def meshes(self) -> tuple[Mesh, ...]:
        """Surface of each body that did not fail, in the body's own frame; made when it is first asked for."""
        shown = self.array.recovered
        return tuple(triangles(body, MARKER_RESOLUTION) for body in _in_own_frames(shown))

    def move(self, frame_id: str, rotation: np.ndarray, translation: np.ndarray) -> Findings:
        """Return the same in another frame, p_new = R(rotation) p + translation; the stamp stays."""
        return Findings(
            array=poses.move(self.array, rotation, translation),
            covariances=poses.turn_covariances(self.covariances, rotation),
            header=poses.header_in(self.header, frame_id),
            plane=None if self.plane is None else poses.move_plane(self.plane, rotation, translation),
            parts=poses.move(self.parts, rotation, translation),
        )

    def markers(self, alpha: float = ALPHA, types: MessageTypes = find_type) -> Any:
        """Return a MarkerArray of the bodies that did not fail, or their parts, with colours of this opacity by id."""
        shown, surfaces = self.array.recovered, []
        for k, mesh in enumerate(self.meshes):
            parts = self.parts.parts_of(shown.id[k])
            meshes = [triangles(body, MARKER_RESOLUTION) for body in _in_own_frames(parts)] or [mesh]
            surfaces.append(_join(meshes, parts if len(parts) else shown.where(np.arange(len(shown)) == k)))
        return markers(surfaces, self.shown_ids, self.header, alpha=alpha, types=types)


def findings(found: Identified, header: Any, is_cube: bool) -> Findings:
    """Return what a frame showed, in the frame of its image, whose header it is."""
    recovery = found.recovery
    array = superquadric_array(found, is_cube)
    covariances = np.array([body.covariance[5:, 5:] for body in recovery.bodies])
    change = np.zeros((len(array), 6, 6))
    change[:, :3, :3] = np.diag([1.0, -1.0, -1.0]) if is_cube else np.eye(3)
    change[:, 3:, 3:] = poses.matrices(poses.unit_quaternions(array.rotation))
    moved = change @ covariances.reshape(-1, 6, 6) @ np.swapaxes(change, 1, 2)
    return Findings(array, moved, header, recovery.plane, superquadric_array(_take_parts(found), is_cube))


def _take_parts(found: Identified) -> Identified:
    """Replace the objects of a frame by their parts."""
    bodies, ids = [], []
    columns: dict[str, list[int]] = {"seen": [], "reason": [], "part": []}
    for k, body in enumerate(found.recovery.bodies):
        for number, fit in enumerate(body.parts or (), 1):
            bodies.append(replace(body, fit=fit, score=np.nan, parts=None, cavity=None))
            ids.append(found.ids[k])
            columns["seen"].append(found.columns["seen"][k] if "seen" in found.columns else 0)
            columns["reason"].append(_reason(bodies[-1], fit.superquadric))
            columns["part"].append(number)
    known = {name: tuple(values) for name, values in columns.items()}
    return Identified(replace(found.recovery, bodies=tuple(bodies)), tuple(ids), columns=known)


def superquadric_array(found: Identified, is_cube: bool) -> SuperquadricArray:
    """Every object of a frame, failed ones included; in the cube frame if ``is_cube``, else in the optical frame."""
    recovery = found.recovery
    if not recovery.bodies:
        return SuperquadricArray.empty()
    bodies = Superquadric.stack([body.superquadric for body in recovery.bodies])
    if is_cube:
        bodies = unit_cube.cube_from_optical(bodies)
    covariances = np.stack([body.covariance for body in recovery.bodies])
    turns = np.stack([body.superquadric.rotation_matrix for body in recovery.bodies])
    centres = np.swapaxes(turns, 1, 2) @ covariances[:, _CENTRE, _CENTRE] @ turns
    deviations = np.sqrt(np.einsum("nii->ni", covariances))
    return SuperquadricArray(
        **{name: getattr(bodies.untapered(), name) for name in _OF_A_BODY}, taper=bodies.taper, id=np.array(found.ids),
        **{name: np.array([getattr(body, name) for body in recovery.bodies]) for name in _OF_EACH_BODY},
        **{name: np.array(values, np.uint32) for name, values in found.columns.items()}, sigma_shape=deviations[:, 3:5],
        sigma_centre=np.sqrt(np.einsum("nii->ni", centres)), sigma_turn=deviations[:, 8:],
    )


def superquadrics(array: SuperquadricArray) -> Superquadric:
    """Return the bodies (n,) of a message, in its frame."""
    bodies = Superquadric(**{name: getattr(array, name).astype(float) for name in _OF_A_BODY})
    return bodies.with_taper(np.asarray(array.taper, float))


def _in_own_frames(array: SuperquadricArray) -> Superquadric:
    """Return the bodies (n,) of a message, each in its own frame."""
    return Superquadric.at_origin(array.size, array.shape).with_taper(np.asarray(array.taper, float))


def _join(meshes: Sequence[Mesh], array: SuperquadricArray) -> MarkerMesh:
    """Join meshes of the bodies of a message, each in its own frame, in the message's frame, with their outlines."""
    turns = poses.matrices(poses.unit_quaternions(array.rotation))
    vertices, faces, lines, count = [], [], [], 0
    for (own, corners), body, turn, centre in zip(meshes, _in_own_frames(array), turns, array.translation, strict=True):
        vertices.append(own @ turn.T + centre)
        faces.append(corners + count)
        lines.append(outline(body) @ turn.T + centre)
        count += len(own)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(lines)


def covariances(array: SuperquadricArray) -> np.ndarray:
    """(n, 11, 11) of the bodies of a message, from the deviations of sizes, centre and turn; NaN where unknown.  A
    message has no correlations, which sizes and centre of a fit have: a seen side is surer, a hidden one less sure."""
    found = np.zeros((len(array), 11, 11))
    deviations = [np.asarray(each, float) for each in (array.sigma_size, array.sigma_centre, array.sigma_turn)]
    size, centre, turn = (np.where(np.isfinite(each), each**2, np.nan) for each in deviations)
    axes = superquadrics(array).rotation_matrix
    found[:, range(3), range(3)] = size
    found[:, _CENTRE, _CENTRE] = (axes * centre[:, None]) @ axes.transpose(0, 2, 1)
    found[:, range(8, 11), range(8, 11)] = turn
    return found


def truth_array(bodies: Superquadric) -> SuperquadricArray:
    """Return a batch (n,) of known bodies: score 1, residual and deviations 0, ids 1 to n."""
    count = len(bodies)
    return SuperquadricArray(
        **{name: getattr(bodies, name) for name in _OF_A_BODY}, score=np.ones(count), residual=np.zeros(count),
        objectness=np.ones(count), sigma_size=np.zeros((count, 3)), sigma_shape=np.zeros((count, 2)),
        sigma_centre=np.zeros((count, 3)), sigma_turn=np.zeros((count, 3)), id=np.arange(1, count + 1, dtype=np.uint32),
        status=np.full(count, CONVERGED, dtype=np.uint32),
    )


def depth_message(depth: np.ndarray, header: Any, encoding: str, types: MessageTypes = find_type) -> Any:
    """Return an Image of depth (height, width) in metres, NaN or inf for nothing; mono8 and mono16: of the cube."""
    if encoding in _GREY_TYPES:
        return depth_image.grey_to_message(unit_cube.grey_from_depth(depth, _GREY_TYPES[encoding]), header, types)
    return depth_image.depth_to_message(np.where(np.isfinite(depth), depth, np.nan), header, encoding, types)


def depth_of(
    message: Any, is_cube: bool, scale: float | None = None, known: Stated | None = None
) -> tuple[Metres, str]:
    """Return the depth of an image message, and its encoding before it was packed.

    ``message``: sensor_msgs/Image of 16UC1 or 32FC1, or CompressedImage of the compressedDepth transport; if
    ``is_cube`` Image of mono8 or mono16, grey values of the unit cube.  ``scale``, ``known``: units, as
    :func:`depth_units.metres` takes them.  Raises ValueError for anything else.
    """
    if is_cube:
        return Metres(unit_cube.depth_from_grey(depth_image.grey_from_message(message))), str(message.encoding)
    if hasattr(message, "format"):
        numbers = compressed_depth.decode(message.format, message.data)
        encoding = compressed_depth.encoding(message.format) or ""
    else:
        numbers = depth_image.pixels_from_message(message, depth_image.DEPTH_ENCODINGS)
        encoding = str(message.encoding)
    found = depth_units.metres(numbers, scale, known)
    return found, encoding if found.scale == depth_units.MILLIMETRES else "32FC1"  # millimetres hold no other units


def size_of(message: Any) -> tuple[int, int]:
    """Width and height of an image or cloud; of a packed image from its header alone, ValueError if it is none."""
    if hasattr(message, "format"):
        return compressed_depth.size(message.format, message.data)
    return int(message.width), int(message.height)
