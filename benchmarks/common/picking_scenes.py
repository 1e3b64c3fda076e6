"""Scenes of the picking benchmark: five household things that some parallel gripper could take, upright or dropped.

    packed   upright within 24 x 24 cm, at least 5 mm apart; drawn again if one falls over
    pile     dropped one after the other into a box of 24 x 24 cm, which is then taken away

Things are those of :mod:`sq_perception.simulation.household`, all kinds, drawn with seeds of their own: the networks
were trained with others of the same generator.  Vessels have walls and are open.  A thing is drawn again if nothing of
it can be taken as it stands or, in a pile, as it lies lowest: if in every level direction it is wider than 74 mm, and
so is what of it is within 3 cm of its top (a neck, a cap), and it has no open rim; if it is lower than 25 mm; or longer
than 25 cm.  Which of these a gripper can reach where they come to lie is not looked at.

One fixed camera, 45 degrees above the table at 0.75 m; odd seeds see through a Kinect v1, even ones through a D435.
What is planned in its frame is carried out as far off as a camera is calibrated to an arm: 2 mm and 0.3 degrees, drawn
once a scene.  The fingers push with 30 N, which a carton bears.  The world's frame is that of :mod:`picking_world`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from common.picking_world import Thing, World
from sq_perception.geometry import mesh
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.union import flat_support, move
from sq_perception.grasping.gripper import PANDA
from sq_perception.simulation import household, sensor_noise
from sq_perception.simulation.household import draw_thing
from sq_perception.simulation.rendering import render_things
from sq_perception.simulation.thing import NO_CAVITY, ON_X, ON_Y, UPRIGHT
from sq_perception.simulation.thing_setting import optical_from_table
from sq_perception.simulation.things_on_table import TABLE_CAMERA

KINDS = ("packed", "pile")
THINGS = 5
GRIPPER = replace(PANDA, force=30.0)
WIDEST, LOWEST, LONGEST, CAP = 0.074, 0.025, 0.25, 0.03
RIM = (0.02, 0.015)
"""Radius and depth of a cavity that a finger goes into."""
HALF = 0.12
GAP = 0.005
LOOK = optical_from_table(np.pi / 4, 0.0)
EYE = np.array([0.0, 0.0, 0.75])
"""Optical from world: p_optical = R(LOOK) p_world + EYE."""
_BEARINGS = np.linspace(0, 2 * np.pi, 36, endpoint=False)
_LEVEL = np.stack([np.cos(_BEARINGS), np.sin(_BEARINGS), 0 * _BEARINGS], axis=1)
_FRICTION = (0.5, 1.0)
_UPRIGHT = np.deg2rad(10.0)
_CALIBRATION = 0.002, float(np.deg2rad(0.3))
_RESTS = (UPRIGHT, ON_X, ON_Y)


@dataclass(frozen=True, eq=False)
class Scene:
    """Things as they lie: their positions (5, 3) and rotations (5, 4) in the world, and the sensor."""

    kind: str
    seed: int
    things: tuple[Thing, ...]
    positions: np.ndarray
    rotations: np.ndarray

    @property
    def sensor(self) -> str:
        return "kinect_v1" if self.seed % 2 else "realsense_d435"

    def world(self) -> World:
        """A new world with the things in it."""
        world = World(self.things, GRIPPER)
        for k in range(len(self.things)):
            world.put(k, self.positions[k], self.rotations[k])
        return world

    def carried_out(self, position: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the gripper is when it is sent to a pose of the optical frame: a pose in the world."""
        rng = np.random.default_rng([self.seed, 2])
        shift, turn = (sigma * rng.standard_normal(3) for sigma in _CALIBRATION)
        position, rotation = to_world(position, rotation)
        off = quaternions.from_rotation_vector(turn)
        return quaternions.to_matrix(off) @ position + shift, quaternions.multiply(off, rotation)


def scene(kind: str, seed: int, things: Sequence[str] = ()) -> Scene:
    """The scene of this number, of these kinds or names of things, each as often; the same every time."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    while True:
        found = _packed(rng, things) if kind == "packed" else _pile(rng, things)
        if found is not None:
            return Scene(kind, seed, *found)


def observed(world: World, sensor: str, rng: np.random.Generator) -> np.ndarray:
    """What the sensor measures of a world, the gripper out of sight."""
    parts, owner = seen(world, [thing.parts for thing in world.things])
    cavities, cavity_owner = seen(world, [thing.cavity for thing in world.things])
    table = quaternions.to_matrix(LOOK)[:, 2]
    plane = np.append(table, -table @ EYE)
    depth, _ = render_things(parts, owner, cavities, cavity_owner, TABLE_CAMERA, plane)
    return sensor_noise.preset(sensor).measure(depth, TABLE_CAMERA, rng)


def seen(world: World, bodies: list[Superquadric]) -> tuple[Superquadric, np.ndarray]:
    """Bodies (k,) in the optical frame of all things that are left, and whose they are."""
    rows, owner = [np.empty((0, 12))], []
    for k in world.left:
        if len(bodies[k]):
            position, rotation = world.pose(k)
            rows.append(move(move(bodies[k].to_flat(), rotation, position), LOOK, EYE))
            owner += [k] * len(bodies[k])
    return Superquadric.from_flat(np.concatenate(rows)), np.array(owner, dtype=int)


def to_world(position: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A pose of the optical frame in the world."""
    back = quaternions.conjugate(LOOK)
    return quaternions.to_matrix(back) @ (position - EYE), quaternions.multiply(back, rotation)


def _thing(rng: np.random.Generator, packed: bool, things: Sequence[str]) -> Thing:
    wanted = things[rng.integers(len(things))] if things else ""
    while True:
        drawn = draw_thing(rng, [wanted] if wanted in household.KINDS else None)
        if wanted not in ("", drawn.kind, drawn.name):
            continue
        cavity = drawn.cavities[:1] if drawn.kind == "vessel" else NO_CAVITY
        thing = Thing(drawn.parts, rng.uniform(*_FRICTION), drawn.name, cavity)
        turn = UPRIGHT
        if not packed:
            turn = min(_RESTS, key=lambda turn: np.ptp(_points(thing, turn)[:, 2]))
        if can_be_taken(thing, turn):
            return thing


def can_be_taken(thing: Thing, turn: np.ndarray) -> bool:
    """Whether some part of a thing that rests like that could be between the fingers; see the module."""
    points = _points(thing, turn)
    if np.ptp(points, axis=0).max() > LONGEST or np.ptp(points[:, 2]) < LOWEST:
        return False
    if len(thing.cavity) and turn is UPRIGHT and (thing.cavity.size[0, [0, 2]] > RIM).all():
        return True
    cap = points[points[:, 2] > points[:, 2].max() - CAP]
    return bool(min(np.ptp(one @ _LEVEL.T, axis=0).min() for one in (points, cap)) < WIDEST)


def _points(thing: Thing, turn: np.ndarray) -> np.ndarray:
    """Points all over the parts of a thing, turned."""
    points = np.concatenate([mesh.triangles(part, 16)[0] for part in thing.parts])
    return points @ quaternions.to_matrix(turn).T


Poses = tuple[tuple[Thing, ...], np.ndarray, np.ndarray]


def _packed(rng: np.random.Generator, wanted: Sequence[str]) -> Poses | None:
    things, flats, positions, rotations = [], [], [], []
    for _ in range(THINGS):
        thing = _thing(rng, True, wanted)
        angle = rng.uniform(0, np.pi)
        turn = np.array([0.0, 0.0, np.sin(angle), np.cos(angle)])
        low = -float(flat_support(thing.parts.to_flat(), np.array([[0, 0, -1.0]]))[0])
        for _ in range(200):
            at = np.array([*rng.uniform(-HALF, HALF, 2), 1e-3 - low])
            flat = move(thing.parts.to_flat(), turn, at)
            reach = flat_support(flat, _LEVEL)
            if all((-other - np.roll(reach, 18)).max() > GAP for other in flats):
                break
        else:
            return None
        things.append(thing)
        flats.append(reach)
        positions.append(at)
        rotations.append(turn)
    return _settled(things, positions, rotations)


def _pile(rng: np.random.Generator, wanted: Sequence[str]) -> Poses | None:
    things = [_thing(rng, False, wanted) for _ in range(THINGS)]
    world = World(things, GRIPPER, walls=HALF)
    for k in range(THINGS):
        at = np.array([*rng.uniform(-0.3 * HALF, 0.3 * HALF, 2), 0.3])
        world.put(k, at, quaternions.random(1, rng)[0])
        world.settle(1.0)
    world.open_walls()
    world.settle(1.5)
    return _resting(world)


def _settled(things: list[Thing], positions: list[np.ndarray], rotations: list[np.ndarray]) -> Poses | None:
    world = World(things, GRIPPER)
    for k in range(len(things)):
        world.put(k, positions[k], rotations[k])
    world.settle(1.5)
    found = _resting(world)
    if found is not None and (quaternions.to_matrix(found[2])[:, 2, 2] < np.cos(_UPRIGHT)).any():
        return None
    return found


def _resting(world: World) -> Poses | None:
    """The things as they lie; None if one left the table or is still moving."""
    if len(world.left) < THINGS or np.abs(world.data.qvel[8:]).max() > 0.5:
        return None
    poses = [world.pose(k) for k in range(THINGS)]
    return world.things, np.array([p for p, _ in poses]), np.array([r for _, r in poses])
