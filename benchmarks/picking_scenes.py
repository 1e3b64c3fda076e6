"""Scenes of the picking benchmark: five household things that the gripper can take, upright or dropped.

    packed   upright within 24 x 24 cm, at least 5 mm apart; drawn again if one falls over
    pile     dropped one after the other into a box of 24 x 24 cm, which is then taken away

Things are those of :mod:`sq_perception.simulation.household`, all kinds but vessels, whose walls are no convex parts.
A thing that no grasp of the gripper could take is drawn again: packed, one that is wider than 70 mm in every level
direction or not 4 to 25 cm high; in a pile, one whose box has a middle edge above 70 mm, a longest above 20 cm or a
shortest below 15 mm.

One fixed camera, 45 degrees above the table at 0.75 m; odd seeds see through a Kinect v1, even ones through a D435.
The world's frame is that of :mod:`picking_world`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from picking_world import Thing, World
from things_on_table import TABLE_CAMERA

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.union import flat_support, moved
from sq_perception.grasping.gripper import PANDA
from sq_perception.simulation import household, sensor_noise
from sq_perception.simulation.thing_rendering import render_things
from sq_perception.simulation.thing_views import looking_down

KINDS = ("packed", "pile")
THINGS = 5
WIDEST, TALLEST, LOWEST, THINNEST, LONGEST = 0.07, 0.25, 0.04, 0.015, 0.20
HALF = 0.12
GAP = 0.005
LOOK = looking_down(np.pi / 4, 0.0)
EYE = np.array([0.0, 0.0, 0.75])
"""Optical from world: p_optical = R(LOOK) p_world + EYE."""
_BEARINGS = np.linspace(0, 2 * np.pi, 36, endpoint=False)
_LEVEL = np.stack([np.cos(_BEARINGS), np.sin(_BEARINGS), 0 * _BEARINGS], axis=1)
_FRICTION = (0.5, 1.0)
_UPRIGHT = np.deg2rad(10.0)


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
        world = World(self.things, PANDA)
        for k in range(len(self.things)):
            world.put(k, self.positions[k], self.rotations[k])
        return world


def scene(kind: str, seed: int) -> Scene:
    """The scene of this number; the same every time."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    while True:
        found = _packed(rng) if kind == "packed" else _pile(rng)
        if found is not None:
            return Scene(kind, seed, *found)


def observed(world: World, sensor: str, rng: np.random.Generator) -> np.ndarray:
    """What the sensor measures of a world, the gripper out of sight."""
    parts, owner = bodies_seen(world)
    table = quaternions.to_matrix(LOOK)[:, 2]
    none = Superquadric.stack([])
    plane = np.append(table, -table @ EYE)
    depth, _ = render_things(parts, owner, none, np.empty(0, dtype=int), TABLE_CAMERA, plane)
    return sensor_noise.preset(sensor).measured(depth, TABLE_CAMERA, rng)


def bodies_seen(world: World) -> tuple[Superquadric, np.ndarray]:
    """Parts (k,) in the optical frame of all things that are left, and whose they are."""
    rows, owner = [np.empty((0, 12))], []
    for k in world.left:
        position, rotation = world.pose(k)
        rows.append(moved(moved(world.things[k].parts.to_flat(), rotation, position), LOOK, EYE))
        owner += [k] * len(world.things[k].parts)
    return Superquadric.from_flat(np.concatenate(rows)), np.array(owner, dtype=int)


def to_world(position: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A pose of the optical frame in the world."""
    back = quaternions.conjugate(LOOK)
    return quaternions.to_matrix(back) @ (position - EYE), quaternions.multiply(back, rotation)


def _thing(rng: np.random.Generator, packed: bool) -> Thing:
    kinds = [kind for kind in household.KINDS if kind != "vessel"]
    while True:
        drawn = household.draw_thing(rng, kinds)
        low, high = drawn.box
        edges = np.sort(high - low)
        width = drawn.support(_LEVEL) + drawn.support(-_LEVEL)
        if packed:
            fits = width.min() < WIDEST and LOWEST < drawn.height < TALLEST
        else:
            fits = edges[0] > THINNEST and edges[1] < WIDEST and edges[2] < LONGEST
        if fits:
            return Thing(drawn.parts, rng.uniform(*_FRICTION), drawn.name)


Poses = tuple[tuple[Thing, ...], np.ndarray, np.ndarray]


def _packed(rng: np.random.Generator) -> Poses | None:
    things, flats, positions, rotations = [], [], [], []
    for _ in range(THINGS):
        thing = _thing(rng, packed=True)
        angle = rng.uniform(0, np.pi)
        turn = np.array([0.0, 0.0, np.sin(angle), np.cos(angle)])
        low = -float(flat_support(thing.parts.to_flat(), np.array([[0, 0, -1.0]]))[0])
        for _ in range(200):
            at = np.array([*rng.uniform(-HALF, HALF, 2), 1e-3 - low])
            flat = moved(thing.parts.to_flat(), turn, at)
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


def _pile(rng: np.random.Generator) -> Poses | None:
    things = [_thing(rng, packed=False) for _ in range(THINGS)]
    world = World(things, PANDA, walls=HALF)
    for k in range(THINGS):
        at = np.array([*rng.uniform(-0.3 * HALF, 0.3 * HALF, 2), 0.3])
        world.put(k, at, quaternions.random(1, rng)[0])
        world.settle(1.0)
    world.open_walls()
    world.settle(1.5)
    return _resting(world)


def _settled(things: list[Thing], positions: list[np.ndarray], rotations: list[np.ndarray]) -> Poses | None:
    world = World(things, PANDA)
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
