"""Scenes of the gallery: household things at given places on a table, seen by one simulated sensor.

A thing stands with its middle at (right, away) of the table's origin, metres, turned by a heading, degrees; optical
frame for whatever the camera sees.  :mod:`tabletop` draws its scenes at random,
these are composed to show something.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from common import mesh_things, tabletop
from common.mesh_things import MeshThing
from common.tabletop import Tabletop
from sq_perception.simulation import sensor_noise
from sq_perception.simulation.scenes import plane_depth

_CONTACT = 3e-4


@dataclass(frozen=True, eq=False)
class Stood:
    """A thing on a table: its middle there (to the right, away from the camera), metres, and its heading, degrees."""

    name: str
    thing: MeshThing
    place: tuple[float, float]
    heading: float = 0.0
    turn: np.ndarray = field(default_factory=lambda: mesh_things.UPRIGHT)


def viewed(things: Sequence[Stood], sensor: str, down: float, distance: float) -> Tabletop:
    """Things on a table whose middle is ``distance`` metres away, looked down on by ``down`` degrees.

    Raises
    ------
    ValueError
        If two things are in one place, as seen from above.
    """
    camera, table = tabletop.CAMERA, tabletop.looked_down_on(np.deg2rad(down))
    origin = np.array([0.0, 0.0, distance])
    plane = np.append(table[:, 2], -table[:, 2] @ origin)
    placed: list[tuple[MeshThing, str, np.ndarray, np.ndarray]] = []
    outlines: list[np.ndarray] = []
    for each in things:
        turn = tabletop.about_z(np.deg2rad(each.heading)) @ each.turn
        corners = each.thing.hull @ turn.T
        low, high = corners.min(axis=0), corners.max(axis=0)
        place = np.append(each.place, 0.0) - np.append((low + high)[:2] / 2, low[2])
        outlines.append(tabletop.outline(corners + place))
        if any(tabletop.gap(outlines[-1], other) < -_CONTACT for other in outlines[:-1]):
            raise ValueError(f"{each.name}: stands where another thing is")
        placed.append((replace(each.thing, name=each.name), "", table @ turn, table @ place + origin))
    true, labels, known = tabletop.rendered(placed, plane_depth(plane, camera))
    depth = sensor_noise.preset(sensor).measure(true, camera, np.random.default_rng(0))
    return Tabletop(0, sensor, camera, depth, true, labels, plane, table, known)


def carton(width: float, depth: float, height: float) -> MeshThing:
    """A box with these edges along x, y and z, millimetres, rounded by 2 mm; none need be the shortest."""
    return mesh_things.rounded_box(np.array([width, depth, height]) / 1e3, 0.002)


def can(diameter: float, height: float) -> MeshThing:
    return mesh_things.cylinder(diameter / 1e3, height / 1e3, 0.002)


def bottle(number: int) -> MeshThing:
    return mesh_things.bottle(np.random.default_rng(number))


def kitchen() -> tuple[Stood, ...]:
    """Six things that hide each other."""
    return (
        Stood("cereal box", carton(190, 60, 270), (-0.06, 0.19), 12),
        Stood("can", can(75, 110), (-0.11, 0.06)),
        Stood("small box", carton(85, 60, 45), (0.0, -0.05), 35),
        Stood("tall can", can(66, 160), (0.115, 0.09)),
        Stood("carton", carton(70, 95, 120), (0.2, 0.2), -20),
        Stood("lying can", can(66, 115), (-0.22, -0.06), 60, mesh_things.ON_X),
    )
