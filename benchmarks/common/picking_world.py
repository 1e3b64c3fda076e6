"""A table with things and a free-flying parallel gripper, in MuJoCo: what the picking benchmark is decided by.

The world's frame has x to the right, y away from the camera, z up; the table is z = 0.  The gripper is made of the
boxes of :class:`sq_perception.grasping.gripper.Gripper`: the hand follows a target by a stiff spring, the fingers move
as one, position controlled, and push with at most the gripper's force.  Things are unions of convex parts (the parts'
own triangle meshes) or, with a cavity, of the convex pieces of their walls, of one density, each with its own friction
against everything.

One pick: the open gripper is placed 10 cm before the grasp and comes along its axis, closes, lifts by 10 cm, shakes
once along x and once along y, and holds, or not.  It stops where it is pushed back by more than a real arm allows.

Metres, seconds, kilograms, newtons.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np

from sq_perception.geometry import mesh
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.grasping.gripper import Gripper
from sq_perception.grasping.trials import DENSITY
from sq_perception.simulation.thing import NO_CAVITY

STEP = 0.002
APPROACH, LIFT = 0.10, 0.10
SHAKE, SHAKES = 0.03, 2.0
"""Amplitude and frequency; 4.7 m/s^2."""
STOP = 20.0
"""Newtons at which the approach is given up: a Panda's own threshold of contact."""
REACH = 0.35
"""Things farther from the middle than that, along x or y, are lost."""
_FAR = 50.0
_REST = 0.01
"""m/s and rad/s below which nothing moves."""
_RESOLUTION = 16
_FINGER_MASS, _HAND_MASS = 0.015, 0.73
"""franka_description."""
_ARMATURE = 0.2
"""Of a finger's drive, so that a finger does not arrive as a hammer."""
_SPEED = 0.05
"""m/s of a finger: its data sheet."""
_ROLLING, _PAD_ARM = 2e-4, 6e-3
"""Metres: of rolling; mean arm of a pad's friction against turning on the spot."""
_SECTORS, _SLICES, _THINNEST = 24, 6, 1e-3
"""Pieces that a wall is made of, around and upwards; metres of it at least."""


@dataclass(frozen=True, eq=False)
class Thing:
    """What lies on the table: convex parts (k,) in its own frame, a cavity (0 or 1,) about its z axis, its friction."""

    parts: Superquadric
    friction: float
    name: str = "thing"
    cavity: Superquadric = NO_CAVITY

    def solids(self) -> list[np.ndarray]:
        """Vertices (n, 3) of convex pieces that make it up."""
        around = [len(self.cavity) > 0 and _on_axis(part, self.cavity[0]) for part in self.parts]
        found = [mesh.triangles(self.parts[k], _RESOLUTION)[0] for k in range(len(around)) if not around[k]]
        if any(around):
            found += walls([self.parts[k] for k in range(len(around)) if around[k]], self.cavity[0])
        return found


def _on_axis(part: Superquadric, cavity: Superquadric) -> bool:
    """Whether a part stands on the upright axis of a cavity; a handle does not."""
    aside = np.concatenate([part.translation[:2] - cavity.translation[:2], part.rotation[:3]])
    return bool(np.abs(aside).max() < 1e-6)


def walls(stack: Sequence[Superquadric], cavity: Superquadric) -> list[np.ndarray]:
    """Convex pieces of bodies about an upright axis less a cavity about it: sectors of a wall, discs of a floor."""
    angles = np.linspace(0, 2 * np.pi, _SECTORS + 1)
    base = min(part.translation[2] - part.size[2] for part in stack)
    top = max(part.translation[2] + part.size[2] for part in stack)
    z = np.linspace(base + 1e-4, top - 1e-4, 200)
    thick = np.max([_radii(part, z, angles[:1]) for part in stack], axis=0) - _radii(cavity, z, angles[:1])
    top = z[np.flatnonzero(thick[:, 0] > _THINNEST)[-1]]
    floor = max(cavity.translation[2] - cavity.size[2], base + 2e-3)
    found = []
    for low, high, count in ((z[0], floor, 3), (floor, top, _SLICES)):
        for levels in pairwise(np.linspace(low, high, count + 1)):
            outer = np.max([_radii(part, np.array(levels), angles) for part in stack], axis=0)
            inner = _radii(cavity, np.array(levels), angles) if low == floor else 0 * outer
            inner = np.clip(inner, 0.0, outer - _THINNEST)
            if inner.max() <= 0:
                found.append(_ring(outer, angles, levels))
                continue
            for k in range(_SECTORS):
                sector = slice(k, k + 2)
                pieces = [_ring(r[:, sector], angles[sector], levels) for r in (outer, inner)]
                found.append(np.concatenate(pieces))
    return [piece + [*cavity.translation[:2], 0.0] for piece in found]


def _radii(body: Superquadric, z: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Distances (j, k) from its upright axis to a body at heights (j,) along angles (k,); 0 beyond its ends."""
    a, b, c = body.size
    e1, e2 = body.shape
    high = np.minimum(np.abs(z - body.translation[2]) / c, 1.0)
    share = (1 - high ** (2 / e1)) ** (e1 / 2)
    across = ((np.abs(np.cos(angles)) / a) ** (2 / e2) + (np.abs(np.sin(angles)) / b) ** (2 / e2)) ** (-e2 / 2)
    return np.asarray(share[:, None] * across)


def _ring(radii: np.ndarray, angles: np.ndarray, levels: Sequence[float]) -> np.ndarray:
    """Points (2 k, 3) at two levels with radii (2, k) along angles (k,)."""
    z = np.repeat(np.array(levels)[:, None], len(angles), axis=1)
    return np.stack([radii * np.cos(angles), radii * np.sin(angles), z], axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class Pick:
    """What came of one.

    Attributes
    ----------
    held
        The thing that was taken away, or -1.
    how
        "held", or why not: "collision" (the fingers or the hand met something on the way), "missed" (nothing between
        the pads once they closed), "slipped" (it was, but not any more after lift and shake).
    touched
        Of a collision: "table", the name of a thing, or empty.
    """

    held: int
    how: str
    touched: str = ""


class World:
    """Things on a table; :meth:`pick` changes it.  ``watch`` is called after every step of the physics."""

    watch: Callable[[World], None] | None = None

    def __init__(self, things: Sequence[Thing], gripper: Gripper, walls: float | None = None) -> None:
        self.things, self.gripper = tuple(things), gripper
        self.model = mujoco.MjModel.from_xml_string(_xml(self.things, gripper, walls))
        self.data = mujoco.MjData(self.model)
        named = mujoco.mj_name2id
        self._hand = named(self.model, mujoco.mjtObj.mjOBJ_BODY, "hand")
        self._bodies = [named(self.model, mujoco.mjtObj.mjOBJ_BODY, f"thing{k}") for k in range(len(things))]
        self._thing_of = {body: k for k, body in enumerate(self._bodies)}
        fingers = [named(self.model, mujoco.mjtObj.mjOBJ_BODY, side) for side in ("left", "right")]
        self._sides = dict(zip(fingers, (0, 1), strict=True))
        self._gone: set[int] = set()
        self._walls = [g for g in range(self.model.ngeom) if self.model.geom(g).name.startswith("wall")]
        for k in range(len(things)):
            self._park(k)
        self._hide()

    # Things

    def put(self, thing: int, position: np.ndarray, rotation: np.ndarray) -> None:
        """Place a thing, at rest; ``rotation`` is a quaternion x y z w."""
        at = self._address(thing)
        self.data.qpos[at : at + 3] = position
        self.data.qpos[at + 3 : at + 7] = np.roll(rotation, 1)
        speed = self.model.body(self._bodies[thing]).dofadr[0]
        self.data.qvel[speed : speed + 6] = 0
        self._gone.discard(thing)
        mujoco.mj_forward(self.model, self.data)

    def pose(self, thing: int) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) and rotation (4,) x y z w."""
        at = self._address(thing)
        return self.data.qpos[at : at + 3].copy(), np.roll(self.data.qpos[at + 3 : at + 7], -1)

    @property
    def left(self) -> list[int]:
        """Things on the table within reach."""
        return [k for k in range(len(self.things)) if k not in self._gone and self._within(k)]

    def settle(self, seconds: float) -> None:
        """Let things move with the gripper out of the way, until they rest or this time is over."""
        self._hide()
        for k in range(int(seconds / STEP)):
            self._step()
            if k > 50 and k % 10 == 0 and np.abs(self.data.qvel[8:]).max() < _REST:
                break

    def open_walls(self) -> None:
        """Take away the walls that things were dropped between."""
        for wall in self._walls:
            self.model.geom_contype[wall] = self.model.geom_conaffinity[wall] = 0

    def gripper_pose(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Position (3,) and rotation (4,) x y z w of the TCP, and the opening."""
        at = self.model.jnt_qposadr[self.model.body("hand").jntadr[0]]
        pose = self.data.qpos[at : at + 9].copy()
        return pose[:3], np.roll(pose[3:7], -1), float(pose[7] + pose[8])

    # Picking

    def pick(self, position: np.ndarray, rotation: np.ndarray, opening: float) -> Pick:
        """Try a grasp: pose of the TCP in the world and the opening before it closes; a thing that is held is gone."""
        z = quaternions.to_matrix(rotation)[:, 2]
        self._place(position - APPROACH * z, rotation, opening)
        touched = self._push()
        if touched[0] < STOP:
            touched = self._travel(position, rotation, 0.8)
        result = Pick(-1, "collision", touched[1])
        if touched[0] < STOP:
            result = self._closed_and_lifted(position, rotation)
        if result.held >= 0:
            self._gone.add(result.held)
            self._park(result.held)
        else:
            self._open(self.gripper.opening)
            self._run(0.3)
        self.settle(1.0)
        return result

    def _closed_and_lifted(self, position: np.ndarray, rotation: np.ndarray) -> Pick:
        self._close()
        if self._between() < 0:
            return Pick(-1, "missed")
        self._travel(position + [0.0, 0.0, LIFT], rotation, 0.6, stop=np.inf)
        for way in np.eye(3)[:2]:
            for t in np.arange(0, 1 / SHAKES, STEP):
                self._aim(position + [0.0, 0.0, LIFT] + SHAKE * np.sin(2 * np.pi * SHAKES * t) * way, rotation)
                self._step()
        held = self._between()
        return Pick(held, "held") if held >= 0 else Pick(-1, "slipped")

    def _between(self) -> int:
        """The thing that both fingers touch, or -1."""
        touching: list[set[int]] = [set(), set()]
        for contact in self.data.contact[: self.data.ncon]:
            first, second = (int(self.model.geom_bodyid[geom]) for geom in contact.geom)
            for finger, other in ((first, second), (second, first)):
                if finger in self._sides and other in self._thing_of:
                    touching[self._sides[finger]].add(self._thing_of[other])
        both = touching[0] & touching[1]
        return min(both, default=-1)

    def _travel(
        self, position: np.ndarray, rotation: np.ndarray, seconds: float, stop: float = STOP
    ) -> tuple[float, str]:
        """Go straight there; the greatest force on the way and what gave it, at once if it is too much."""
        start = self.data.mocap_pos[0].copy()
        most = (0.0, "")
        steps = int(seconds / STEP)
        for k in range(steps + 100):
            self._aim(start + min((k + 1) / steps, 1.0) * (position - start), rotation)
            self._step()
            most = max(most, self._push())
            if most[0] > stop:
                break
        return most

    def _push(self) -> tuple[float, str]:
        """Sum of the contact forces on the gripper, and what gives the greatest one."""
        gripper = {self._hand, *self._sides}
        total, most, what = 0.0, 0.0, ""
        force = np.zeros(6)
        for k, contact in enumerate(self.data.contact[: self.data.ncon]):
            bodies = [int(self.model.geom_bodyid[geom]) for geom in contact.geom]
            mine = [body in gripper for body in bodies]
            if mine[0] == mine[1]:
                continue
            mujoco.mj_contactForce(self.model, self.data, k, force)
            total += force[0]
            if force[0] > most:
                other = bodies[mine.index(False)]
                most, what = force[0], str(self._thing_of.get(other, "table"))
        return total, what

    def _aim(self, position: np.ndarray, rotation: np.ndarray) -> None:
        self.data.mocap_pos[0], self.data.mocap_quat[0] = position, np.roll(rotation, 1)

    def _open(self, opening: float) -> None:
        self.data.ctrl[:] = 0.5 * opening

    def _close(self) -> None:
        """Fingers towards each other at their speed, then a rest."""
        from_here = float(self.data.ctrl[0])
        for k in range(int(from_here / _SPEED / STEP)):
            self._open(2 * (from_here - k * STEP * _SPEED))
            self._step()
        self._open(0.0)
        self._run(0.2)

    def _place(self, position: np.ndarray, rotation: np.ndarray, opening: float) -> None:
        self._aim(position, rotation)
        self._open(opening)
        at = self.model.body("hand").jntadr[0]
        at = self.model.jnt_qposadr[at]
        self.data.qpos[at : at + 7] = np.concatenate([position, np.roll(rotation, 1)])
        self.data.qpos[at + 7 : at + 9] = 0.5 * opening
        first = self.model.body("hand").dofadr[0]
        self.data.qvel[first : first + 8] = 0
        self._step()

    def _hide(self) -> None:
        self._place(np.array([0.0, 0.0, 3.0]), np.array([0.0, 0.0, 0.0, 1.0]), self.gripper.opening)

    def _park(self, thing: int) -> None:
        self.put(thing, np.array([_FAR + thing, _FAR, 0.5]), np.array([0.0, 0.0, 0.0, 1.0]))
        self._gone.add(thing)

    def _within(self, thing: int) -> bool:
        x, y, z = self.pose(thing)[0]
        return bool(abs(x) < REACH and abs(y) < REACH and z > -0.05)

    def _address(self, thing: int) -> int:
        return int(self.model.jnt_qposadr[self.model.body(self._bodies[thing]).jntadr[0]])

    def _step(self) -> None:
        mujoco.mj_step(self.model, self.data)
        if self.watch is not None:
            self.watch(self)

    def _run(self, seconds: float) -> None:
        for _ in range(int(seconds / STEP)):
            self._step()


def _xml(things: Sequence[Thing], gripper: Gripper, walls: float | None) -> str:
    assets, bodies = [], []
    for k, thing in enumerate(things):
        friction = f"{thing.friction:.4f} {_PAD_ARM * thing.friction:.5f} {_ROLLING}"
        geoms = []
        for p, vertices in enumerate(thing.solids()):
            numbers = " ".join(f"{value:.6f}" for value in vertices.ravel())
            assets.append(f'<mesh name="m{k}_{p}" vertex="{numbers}" inertia="convex"/>')
            geoms.append(
                f'<geom type="mesh" mesh="m{k}_{p}" friction="{friction}" priority="1" condim="6" density="{DENSITY}" '
                'solref="0.004 1" solimp="0.95 0.99 0.0005"/>'
            )
        bodies.append(f'<body name="thing{k}"><freejoint/>{"".join(geoms)}</body>')
    left, right, _ = gripper.boxes(0.0)
    x, y, z = gripper.hand
    back = -gripper.palm - 0.5 * z
    pad = 'friction="0.5" condim="6"'
    fingers = "".join(
        f'<body name="{name}"><joint name="{name}" type="slide" axis="0 {side} 0" range="0 {0.5 * gripper.opening}" '
        f'limited="true" damping="5" armature="{_ARMATURE}"/>'
        f'<geom type="box" pos="{_row(box[:3])}" size="{_row(box[3:])}" {pad} '
        f'mass="{_FINGER_MASS}"/></body>'
        for name, side, box in (("left", 1, left), ("right", -1, right))
    )
    held = "".join(
        f'<position joint="{name}" kp="2000" kv="100" forcerange="{-gripper.force} {gripper.force}"/>'
        for name in ("left", "right")
    )
    fence = ""
    if walls is not None:
        for n, (ax, ay) in enumerate(((1, 0), (-1, 0), (0, 1), (0, -1))):
            size = (0.01, walls + 0.02, 0.5) if ax else (walls + 0.02, 0.01, 0.5)
            fence += (
                f'<geom name="wall{n}" type="box" size="{_row(size)}" '
                f'pos="{ax * (walls + 0.01)} {ay * (walls + 0.01)} 0.5"/>'
            )
    return f"""
<mujoco model={quoteattr(gripper.name)}>
  <option timestep="{STEP}" cone="elliptic" impratio="10" integrator="implicitfast"><flag multiccd="enable"/></option>
  <size memory="64M"/>
  <asset>{"".join(assets)}</asset>
  <worldbody>
    <geom name="table" type="plane" size="0 0 1" friction="0.6 {0.6 * _PAD_ARM} {_ROLLING}" condim="6"/>{fence}
    <body name="target" mocap="true" pos="0 0 3"/>
    <body name="hand" pos="0 0 3" gravcomp="1"><freejoint/>
      <geom type="box" pos="0 0 {back}" size="{0.5 * x} {0.5 * y} {0.5 * z}" mass="{_HAND_MASS}" {pad}/>{fingers}
    </body>
    {"".join(bodies)}
  </worldbody>
  <equality>
    <weld body1="target" body2="hand" solref="0.01 1" solimp="0.95 0.99 0.001"/>
    <joint joint1="left" joint2="right" solref="0.004 1" solimp="0.95 0.99 0.0005"/>
  </equality>
  <contact><exclude body1="hand" body2="left"/><exclude body1="hand" body2="right"/></contact>
  <actuator>{held}</actuator>
</mujoco>"""


def _row(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in values)
