"""Scenes of household objects on a table: standing, lying, leaning on each other, stacked, close together.

The table's frame has x to the right, y away from the camera, z up; its origin is the point that the camera looks at,
from 0.5 to 1.2 m and, unless told otherwise, 20 to 70 degrees above the table.  Objects rest in it:

    apart       somewhere on the table, at least 3 mm from all others
    beside      pushed along the table against another one until they touch, as seen from above
    leaning     tilted towards another one and pushed against it: its lowest edge is on the table, the other one, which
                is high enough, holds its upper edge
    stacked     on a box or an upright can, its middle over the face that carries it

Two convex bodies are apart if some plane lies between them; planes that stand on the table, in 128 directions, and the
level ones between storeys are tried, so that nothing that is accepted penetrates.  A push by t along w leaves the gap
g_k + t n_k.w at the plane with the normal n_k; it ends where the widest one closes.

Metres; depth is the z coordinate, +inf where nothing is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.union import flat_support, move
from sq_perception.imaging.camera import Camera
from sq_perception.simulation.household import draw_thing
from sq_perception.simulation.rendering import render_things
from sq_perception.simulation.thing import SIX_WAYS, Thing
from sq_perception.simulation.thing_setting import level_directions, optical_from_table

MOST_THINGS = 8
TABLE_CAMERA = Camera(640, 480, 554.3, 554.3, 319.5, 239.5)  # VGA, 60 degrees wide

ELEVATION = (20.0, 70.0)  # degrees
_HOW = ("apart", "beside", "leaning", "leaning", "stacked", "stacked")
"""Tried; many an object can neither lean nor be stacked where it is tried."""
_UP = 128
_WAYS = np.concatenate([level_directions(_UP), SIX_WAYS[[2, 5]]])
"""Directions: level ones, and from the index ``_UP`` on up and down."""
_BACK = np.argmin(_WAYS @ _WAYS.T, axis=1)  # the index of the direction opposite to each


@dataclass(frozen=True, eq=False)
class PlacedThing:
    """One object of a scene."""

    thing: Thing
    rest: str  # how it lies, and how it came there
    rotation: np.ndarray
    translation: np.ndarray  # (3,), and the rotation (4,): optical from the object's frame
    label: int  # its value in the label image
    pixels: int  # how many pixels show it

    @property
    def parts(self) -> Superquadric:
        """The object's parts in the optical frame."""
        return Superquadric.from_flat(move(self.thing.parts.to_flat(), self.rotation, self.translation))


@dataclass(frozen=True, eq=False)
class ThingsOnTable:
    """A scene with its true image and its truth."""

    camera: Camera
    depth: np.ndarray
    """float64 (height, width), +inf where nothing is; a sensor of :mod:`sensor_noise` makes a measured image of it."""
    labels: np.ndarray  # int32 (height, width), true masks, 0 for no object
    plane: np.ndarray  # (4,), height above the table = n.p + d
    table: np.ndarray  # (3, 3), optical from table frame
    wall: float  # depth of the wall behind all of it, metres
    placed: tuple[PlacedThing, ...]


@dataclass(frozen=True, eq=False)
class _Resting:
    """An object in the table's frame, its support in ``_WAYS`` and whether others may stand on it."""

    thing: Thing
    rest: str
    turn: np.ndarray
    shift: np.ndarray
    reach: np.ndarray
    carries: bool

    def at(self, shift: np.ndarray) -> _Resting:
        by = shift - self.shift
        return replace(self, shift=self.shift + by, reach=self.reach + _WAYS @ by)

    def apart(self, other: _Resting, gap: float) -> bool:
        """Return whether a tried plane separates both by ``gap``; level planes need no gap."""
        free = -(self.reach + other.reach[_BACK])
        return bool((free[:_UP] >= gap).any() or (free[_UP:] >= -1e-9).any())

    def push(self, way: np.ndarray, other: _Resting) -> _Resting | None:
        """Push along the level ``way``, from before the other one, until it touches; None if it passes by."""
        gap, closing = -(other.reach + self.reach[_BACK])[:_UP], -(_WAYS[:_UP] @ way)
        comes = closing > 1e-6
        ends = (gap[comes] / closing[comes]).max()
        nearest = int(np.argmax(_WAYS[:_UP] @ way))
        if (gap[~comes] >= 0).any() or ends > other.reach[nearest] + other.reach[_BACK[nearest]]:
            return None
        return self.at(self.shift + way * ends)


def things_on_table(
    rng: np.random.Generator, count: int | None = None, camera: Camera = TABLE_CAMERA,
    elevation: tuple[float, float] = ELEVATION, kinds: Sequence[str] | None = None,
) -> ThingsOnTable:
    """Place ``count`` objects, or 1 to 8, of some kinds or any, on a table, all inside the image of a camera
    ``elevation`` (least, greatest) degrees above it.  Raises ValueError for a wrong count or camera, or if they do not
    fit."""
    if count is not None and not 1 <= count <= MOST_THINGS:
        raise ValueError(f"count: expected 1 to {MOST_THINGS} things, got {count}")
    if not camera.is_pinhole:
        raise ValueError("camera: expected a pinhole camera, got an orthographic one")
    wanted = int(rng.integers(1, MOST_THINGS + 1)) if count is None else count
    roll = float(np.deg2rad(5.0))
    for _ in range(15):
        look = optical_from_table(rng.uniform(*np.deg2rad(elevation)), rng.uniform(-roll, roll))
        eye = np.array([0.0, 0.0, rng.uniform(0.5, 1.2)])
        resting = _arrange(wanted, look, eye, camera, rng, kinds)
        if resting is not None:
            return _render(resting, look, eye, camera, rng)
    raise ValueError(f"no room for {wanted} things in an image of {camera.width} x {camera.height} pixels")


def _arrange(
    count: int, look: np.ndarray, eye: np.ndarray, camera: Camera, rng: np.random.Generator, kinds: Sequence[str] | None
) -> list[_Resting] | None:
    resting: list[_Resting] = []
    spread = rng.uniform(0.08, 0.3)
    failed = 0
    while failed < 60:
        failed += 1
        how = str(rng.choice(_HOW)) if resting else "apart"
        placed = _draw(draw_thing(rng, kinds), how, resting, spread, rng)
        if placed is None or not _in_view(placed, look, eye, camera):
            continue
        if all(placed.apart(other, 0.003 if how == "apart" else -1e-6) for other in resting):
            resting.append(placed)
            failed = 0
        if len(resting) == count:
            return resting
    return None


def _draw(thing: Thing, how: str, others: list[_Resting], spread: float, rng: np.random.Generator) -> _Resting | None:
    """Place an object in one of the ways of the module; None if that is not possible."""
    rest, turn = thing.pose(rng, leaning=0.0)
    bearing = rng.uniform(0, 2 * np.pi)
    way = np.array([np.cos(bearing), np.sin(bearing), 0.0])
    if how == "leaning":
        # Tilted about a level axis, so that the upper end goes towards ``way``.
        half = 0.5 * rng.uniform(*np.deg2rad((8.0, 35.0)))
        tilt = np.array([-way[1] * np.sin(half), way[0] * np.sin(half), 0.0, np.cos(half)])
        turn = quaternions.multiply(tilt, turn)
    flat_top = thing.kind == "box" or (thing.kind == "can" and rest == "standing" and len(thing.parts) == 1)
    turned = move(thing.parts.to_flat(), turn, np.zeros(3))
    body = _Resting(thing, rest, turn, np.zeros(3), flat_support(turned, _WAYS), flat_top and how != "leaning")
    floor = body.reach[_BACK[_UP]]
    if how == "apart":
        return body.at(np.array([*(rng.normal(0, spread, 2)), floor]))
    able = [other for other in others if other.carries] if how == "stacked" else others
    if not able:
        return None
    other = able[rng.integers(len(able))]
    middle = (other.reach - other.reach[_BACK]) @ _WAYS / _UP
    if how == "stacked":
        face = 0.5 * (other.reach + other.reach[_BACK])[: _UP // 2 : _UP // 4]
        at = middle[:2] + rng.uniform(-0.25, 0.25, 2) * face.min()
        return replace(body.at(np.array([*at, other.reach[_UP] + floor])), rest=f"stacked, {rest}")
    if other.reach[_BACK[_UP]] < -1e-3:  # itself not on the table
        return None
    reach = flat_support(turned, way[None])[0]
    where = flat_support(move(other.thing.parts.to_flat(), other.turn, other.shift), -way[None])[0]
    along = np.array([-way[1], way[0], 0.0])
    aside = rng.normal(0, 0.01) if how == "leaning" else rng.normal(0, 0.03)
    # The plane across ``way`` that touches the other one, and this one from the other side.
    shift = way * (-where - reach) + along * (middle @ along + aside)
    placed = body.at(np.array([*shift[:2], floor])).push(way, other)
    if placed is not None and how == "leaning":
        if placed.reach[_UP] > other.reach[_UP] + 0.01 or thing.kind in ("round", "soft", "union"):
            return None
        return replace(placed, rest=f"leaning, {rest}")
    return placed


def _in_view(body: _Resting, look: np.ndarray, eye: np.ndarray, camera: Camera) -> bool:
    parts = move(move(body.thing.parts.to_flat(), body.turn, body.shift), look, eye)
    reach = flat_support(parts, SIX_WAYS)
    if -reach[5] < 0.35:
        return False
    corners = np.array([[x, y, -reach[5]] for x in (reach[0], -reach[3]) for y in (reach[1], -reach[4])])
    pixels = camera.project(corners)
    margin = 2.0
    limit = np.array([camera.width, camera.height]) - 1 - margin
    return bool((pixels > margin).all() and (pixels < limit).all())


def _render(
    resting: list[_Resting], look: np.ndarray, eye: np.ndarray, camera: Camera, rng: np.random.Generator
) -> ThingsOnTable:
    table = quaternions.to_matrix(look)
    plane = np.append(table[:, 2], -table[:, 2] @ eye)
    poses = [(quaternions.multiply(look, body.turn), table @ body.shift + eye) for body in resting]
    owner = np.concatenate([np.full(len(body.thing.parts), k) for k, body in enumerate(resting)])
    whose = np.concatenate([np.full(len(body.thing.cavities), k) for k, body in enumerate(resting)])
    parts = [move(body.thing.parts.to_flat(), *pose) for body, pose in zip(resting, poses, strict=True)]
    holes = [move(body.thing.cavities.to_flat(), *pose) for body, pose in zip(resting, poses, strict=True)]
    everything, cavities = (Superquadric.from_flat(np.concatenate(flat)) for flat in (parts, holes))
    wall = rng.uniform(1.8, 3.5)
    depth, index = render_things(everything, owner, cavities, whose, camera, plane, wall)
    placed = tuple(
        PlacedThing(body.thing, body.rest, *pose, k + 1, int(np.count_nonzero(index == k)))
        for k, (body, pose) in enumerate(zip(resting, poses, strict=True))
    )
    return ThingsOnTable(camera, depth, (index + 1).astype(np.int32), plane, table, wall, placed)
