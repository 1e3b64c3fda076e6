"""Household things as they are: unions of superquadrics of household proportions.

A thing is a union of superquadrics in its own frame: metres, z up when it stands, the middle of its box at the origin.
What a planner needs of it, its convex hull, has the support function

    h(n) = max over the parts of  n.t + h_part(R^T n),

closed form through :meth:`Superquadric.support`.  An open vessel has cavities besides, superquadrics that are cut away
from the union; its hull does not know them.

Families and their measures (ranges are wider than the sources: things differ)
------------------------------------------------------------------------------
| kind | what | measures |
| --- | --- | --- |
| box | cartons, bricks, small packets, soap; books | longest edge 4.5 to 34 cm; ISO 216 A4 to A6, B5 (books) |
| can | cans, spray cans, jars with lids, rolls | drink 66 x 115 mm, 53 to 58 mm slim, food 54 to 105 mm wide |
| bottle | round, oval; shoulders, caps, pumps, triggers, handles; tubes | caps 24 to 50 mm: PCO 1881 28 mm, 38 mm |
| vessel | bowls, cups, mugs, plates, tubs, pots | cups 55 to 100 mm wide, bowls 9 to 24 cm, plates 14 to 28 cm |
| round | fruit, balls, eggs | 3 to 12 cm (UNECE fruit standards: apples 60 to 90 mm, citrus 45 to 110 mm) |
| tool | pens, handles with heads, clamps, drills | pens 8 to 20 mm by 11 to 16 cm; handles 10 to 25 cm |
| union | toys: 2 to 5 parts of any kind | parts of 1.5 to 7 cm |
| soft | bags, pouches, sponges | 6 to 28 cm, thickness 0.1 to 0.6 of the width |

Sources: EN 10333 and the can makers' common diameters (52, 53, 58, 66, 73, 83, 99 mm), ISBT finishes of PET bottles
(PCO 1881, 38 mm), 0.25 to 2 l bottles of water, oil, cleaner and shampoo as sold, ISO 216, ISO 12757 (pens), UNECE
standards for fruit, table ware of hotel catalogues.  No object of a benchmark is among them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.union import flat_support, support_of_union

KINDS = ("box", "can", "bottle", "vessel", "round", "tool", "union", "soft")
LIKELY = {
    "box": 0.29,
    "can": 0.18,
    "bottle": 0.24,
    "vessel": 0.10,
    "round": 0.06,
    "tool": 0.05,
    "union": 0.04,
    "soft": 0.04,
}
"""How often each comes where nothing else is asked for."""

_STRAIGHT = (0.0, 0.0, 0.0, 1.0)
_LEAN = (np.deg2rad(4.0), np.deg2rad(35.0))

UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
ON_X = np.array([0.0, -np.sqrt(0.5), 0.0, np.sqrt(0.5)])
"""The thing's x axis points up: it lies on a side."""
ON_Y = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
"""The thing's y axis, of an oval bottle the shorter one, points up."""
INVERTED = np.array([1.0, 0.0, 0.0, 0.0])

SIX_WAYS = np.concatenate([np.eye(3), -np.eye(3)])
NO_CAVITY = Superquadric.stack([])


@dataclass(frozen=True, eq=False)
class Rest:
    """A way to rest: the rotation, a quaternion (4,), from the thing's frame to one with z up, and its probability."""

    name: str
    turn: np.ndarray
    likely: float


@dataclass(frozen=True, eq=False)
class Thing:
    """One household thing.

    Attributes
    ----------
    kind : str
        One of :data:`KINDS`.
    name : str
        The family within the kind.
    parts : Superquadric
        Batch (k,) in the thing's own frame, metres.
    rests : tuple of Rest
        Their probabilities add up to 1.
    cavities : Superquadric
        Batch (m,), m >= 0: what is cut away from the union.
    surface : (n, 3), (m, 3), optional
        Vertices and faces of a mesh that is seen in place of the union, where the parts only tell its hull.
    """

    kind: str
    name: str
    parts: Superquadric
    rests: tuple[Rest, ...]
    cavities: Superquadric
    surface: tuple[np.ndarray, np.ndarray] | None = None

    def support(self, directions: np.ndarray) -> np.ndarray:
        """max n.p over the convex hull, in the thing's frame, for unit directions (J, 3), shape (J,)."""
        return support_of_union(self.parts, directions)

    @cached_property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner (3,) of the box around the thing in its own frame."""
        reach = self.support(SIX_WAYS)
        return -reach[3:], reach[:3]

    def pose(self, rng: np.random.Generator, leaning: float = 0.06) -> tuple[str, np.ndarray]:
        """A way to rest, turned about the vertical by any angle: its name and the quaternion (4,) to a frame with z up.

        ``leaning`` is the share of things that are tilted by 4 to 35 degrees, as by something under or beside them.
        """
        rest = self.rests[_one_of([rest.likely for rest in self.rests], rng)]
        name, turn = rest.name, rest.turn
        if rng.random() < leaning:
            tilt, way = rng.uniform(*_LEAN), rng.uniform(0, 2 * np.pi)
            name, turn = "leaning", quaternions.multiply(_turn(np.cos(way), np.sin(way), 0.0, tilt), turn)
        return name, quaternions.multiply(_turn(0.0, 0.0, 1.0, rng.uniform(0, 2 * np.pi)), turn)


def _turn(x: float, y: float, z: float, angle: float) -> np.ndarray:
    """The quaternion of a turn about a unit axis by an angle in radians."""
    s = np.sin(angle / 2)
    return np.array([x * s, y * s, z * s, np.cos(angle / 2)])


def _one_of(weights: Sequence[float], rng: np.random.Generator) -> int:
    """A random index with these weights."""
    return min(int(np.searchsorted(np.cumsum(weights), rng.random() * sum(weights), side="right")), len(weights) - 1)


def draw_thing(rng: np.random.Generator, kinds: Sequence[str] | None = None) -> Thing:
    """A random thing, of one of the given kinds or of any.

    Raises
    ------
    ValueError
        If a kind is unknown or none is given.
    """
    names = list(KINDS if kinds is None else kinds)
    if not names or not set(names) <= set(KINDS):
        raise ValueError(f"kinds: expected some of {', '.join(KINDS)}, got {names}")
    makers = _MAKERS[names[_one_of([LIKELY[name] for name in names], rng)]]
    return makers[_one_of([likely for _, likely in makers], rng)][0](rng)


_Numbers = Sequence[float] | np.ndarray
_Row = tuple[float, ...]
"""A part: a1 a2 a3 e1 e2 x y z qx qy qz qw."""


def _part(
    size: _Numbers,
    shape: _Numbers,
    at: _Numbers = (0.0, 0.0, 0.0),
    turn: _Numbers = _STRAIGHT,
) -> _Row:
    return (*size, *shape, *at, *turn)


def _about(axis: int, degrees: float) -> _Row:
    """The quaternion of a turn about a coordinate axis."""
    half = np.deg2rad(degrees) / 2
    turn = [0.0, 0.0, 0.0, float(np.cos(half))]
    turn[axis] = float(np.sin(half))
    return tuple(turn)


def _thing(
    kind: str, name: str, rows: list[_Row], rests: Sequence[tuple[str, np.ndarray, float]], cut: Sequence[_Row] = ()
) -> Thing:
    flat = np.array(rows)
    reach = flat_support(flat, SIX_WAYS)
    middle = 0.5 * (reach[:3] - reach[3:])
    flat[:, 5:8] -= middle
    cavities = NO_CAVITY
    if cut:
        cavities = Superquadric.from_flat(np.array(cut) - [*[0.0] * 5, *middle, *[0.0] * 4])
    total = sum(likely for _, _, likely in rests)
    ways = tuple(Rest(name, turn, likely / total) for name, turn, likely in rests)
    return Thing(kind, name, Superquadric.from_flat(flat), ways, cavities)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


_CARTON_RESTS = (("standing", UPRIGHT, 0.45), ("flat", ON_X, 0.3), ("on its side", ON_Y, 0.25))
_ROUND_RESTS = (("standing", UPRIGHT, 0.78), ("lying", ON_Y, 0.19), ("inverted", INVERTED, 0.03))
_OVAL_RESTS = (("standing", UPRIGHT, 0.75), ("lying", ON_Y, 0.2), ("on its side", ON_X, 0.05))


def _carton(rng: np.random.Generator) -> Thing:
    """Depth, width, height in any order of length; edges from sharp to soft."""
    longest = _log_uniform(rng, 0.045, 0.34)
    middle = longest * rng.uniform(0.3, 1.0)
    shortest = max(middle * _log_uniform(rng, 0.12, 1.0), 0.012)
    edges = np.array([shortest, middle, longest])
    if rng.random() < 0.4:
        edges = edges[rng.permutation(3)]
    soft = 0.03 + 0.3 * rng.random(2) ** 2
    return _thing("box", "carton", [_part(edges / 2, soft)], _CARTON_RESTS)


def _book(rng: np.random.Generator) -> Thing:
    """ISO 216 formats and trade formats near them; 5 to 50 mm thick."""
    height = rng.choice([0.297, 0.21, 0.148, 0.25]) * rng.uniform(0.9, 1.1)
    size = np.array([rng.uniform(0.005, 0.05), height * rng.uniform(0.6, 0.8), height]) / 2
    rests = (("flat", ON_X, 0.8), ("standing", UPRIGHT, 0.2))
    return _thing("box", "book", [_part(size, rng.uniform(0.02, 0.1, 2))], rests)


def _soap(rng: np.random.Generator) -> Thing:
    """Bars, erasers, bricks of wood or foam: small and softer."""
    longest = _log_uniform(rng, 0.03, 0.14)
    edges = longest * np.array([rng.uniform(0.2, 0.7), rng.uniform(0.4, 1.0), 1.0])
    shape = rng.uniform(0.1, 0.5, 2)
    return _thing("box", "bar", [_part(edges / 2, shape)], (("flat", ON_X, 0.6), *_CARTON_RESTS))


def _tin(rng: np.random.Generator) -> Thing:
    """Drink and food cans, flat tins, drums of powder: the makers' diameters, any height."""
    radius = rng.choice([0.052, 0.053, 0.058, 0.066, 0.073, 0.083, 0.099]) / 2 * rng.uniform(0.9, 1.1)
    if rng.random() < 0.35:
        radius = _log_uniform(rng, 0.045, 0.13) / 2
    height = 2 * radius * _log_uniform(rng, 0.35, 2.6)
    e1 = 0.03 + 0.2 * rng.random() ** 2
    rows = [_part((radius, radius, height / 2), (e1, 1.0))]
    end, top = radius, height / 2
    if rng.random() < 0.35:  # the narrower end of a drink can, or a raised lid
        end, rim = rng.uniform(0.8, 0.98) * radius, rng.uniform(0.002, 0.01)
        rows.append(_part((end, end, rim), (0.15, 1.0), (0, 0, top)))
        top += rim
    cut = []
    if rng.random() < 0.6:  # seamed ends, which lie a countersink of 3 to 7 mm below their rims
        for inner, z in ((end, top), (radius, -height / 2)):
            inner -= rng.uniform(0.0015, 0.0035)
            cut.append(_part((inner, inner, rng.uniform(0.003, 0.007)), (0.1, 1.0), (0, 0, z)))
    return _thing("can", "tin", rows, _ROUND_RESTS, cut)


def _spray_can(rng: np.random.Generator) -> Thing:
    """Aerosols: 35 to 66 mm wide, dome and cap."""
    radius, height = rng.uniform(0.035, 0.068) / 2, rng.uniform(0.1, 0.25)
    cap, tall = rng.uniform(0.45, 0.98) * radius, rng.uniform(0.015, 0.06)
    dome = rng.uniform(0.3, 0.8) * radius
    rows = [
        _part((radius, radius, height / 2), (0.08, 1.0)),
        _part((0.97 * radius, 0.97 * radius, dome), (rng.uniform(0.6, 1.0), 1.0), (0, 0, height / 2)),
        _part((cap, cap, tall / 2), (rng.uniform(0.08, 0.5), 1.0), (0, 0, height / 2 + 0.6 * dome + 0.3 * tall)),
    ]
    return _thing("can", "spray can", rows, _ROUND_RESTS)


def _jar(rng: np.random.Generator) -> Thing:
    """Jars with lids, round or softly square."""
    radius = rng.uniform(0.045, 0.12) / 2
    height = 2 * radius * rng.uniform(0.5, 1.9)
    e2 = 1.0 if rng.random() < 0.75 else rng.uniform(0.3, 0.8)
    lid = radius * rng.uniform(0.72, 1.03)
    tall = rng.uniform(0.009, 0.03)
    rows = [
        _part((radius, radius, height / 2), (rng.uniform(0.1, 0.45), e2)),
        _part((lid, lid, tall / 2), (rng.uniform(0.05, 0.25), 1.0), (0, 0, height / 2 + tall * rng.uniform(0.2, 0.48))),
    ]
    return _thing("can", "jar", rows, _ROUND_RESTS)


def _roll(rng: np.random.Generator) -> Thing:
    """Rolls of paper, tape, foil, biscuits."""
    if rng.random() < 0.5:
        radius, height = rng.uniform(0.08, 0.14) / 2, rng.uniform(0.09, 0.26)
    elif rng.random() < 0.5:
        radius, height = rng.uniform(0.06, 0.13) / 2, rng.uniform(0.012, 0.06)
    else:
        radius, height = rng.uniform(0.03, 0.07) / 2, rng.uniform(0.12, 0.32)
    rests = (("standing", UPRIGHT, 0.5), ("lying", ON_Y, 0.5))
    return _thing("can", "roll", [_part((radius, radius, height / 2), (rng.uniform(0.03, 0.3), 1.0))], rests)


def _bottle(rng: np.random.Generator) -> Thing:
    """Round and oval bottles: body, shoulders, neck; cap, nozzle, pump or trigger; sometimes a waist or a handle."""
    oval = rng.random() < 0.55
    flat = rng.uniform(0.4, 0.92) if oval else 1.0
    e2 = rng.uniform(0.3, 1.0) if oval or rng.random() < 0.15 else 1.0
    width = _log_uniform(rng, 0.045, 0.15) if oval else _log_uniform(rng, 0.04, 0.11)
    height = min(width * _log_uniform(rng, 1.4, 4.2), 0.36)
    a, b = width / 2, flat * width / 2
    straight = height * rng.uniform(0.4, 0.85)
    e1 = rng.uniform(0.05, 0.35)
    rows = [_part((a, b, straight / 2), (e1, e2), (0, 0, straight / 2))]
    kind_of_body = rng.random()
    if kind_of_body < 0.15:  # wider or narrower towards the base
        low = rng.uniform(0.85, 1.12)
        rows.append(_part((low * a, low * b, 0.25 * straight), (e1, e2), (0, 0, 0.25 * straight)))
    elif kind_of_body < 0.27:  # a waist: two bulges and what is between them
        waist = rng.uniform(0.78, 0.95)
        rows = [_part((waist * a, waist * b, straight / 2), (e1, e2), (0, 0, straight / 2))]
        for middle, share in ((0.2, 0.22), (0.8, 0.22)):
            rows.append(_part((a, b, share * straight), (rng.uniform(0.3, 0.8), e2), (0, 0, middle * straight)))
    rows += _shoulders(rng, a, b, e2, straight, height)
    rows += _closure(rng, a, b, straight, height)
    if oval and height > 0.16 and rng.random() < 0.18:
        rows += _grip(rng, a, straight, height)
    return _thing("bottle", "oval bottle" if flat < 1 else "round bottle", rows, _OVAL_RESTS if oval else _ROUND_RESTS)


def _shoulders(rng: np.random.Generator, a: float, b: float, e2: float, low: float, high: float) -> list[_Row]:
    """From the straight body, which ends at the height ``low``, to the neck at ``high``."""
    rise = high - low
    round_e2 = max(e2, rng.uniform(0.7, 1.0))
    if rng.random() < 0.6:  # a dome
        tall = rise * rng.uniform(0.5, 1.15)
        return [_part((0.99 * a, 0.99 * b, tall), (rng.uniform(0.5, 1.0), e2), (0, 0, low - 0.05 * rise))]
    steps = 4
    power = rng.uniform(0.6, 1.8)
    neck_a, neck_b = rng.uniform(0.25, 0.7) * a, rng.uniform(0.3, 0.8) * b
    rows = []
    for k in range(steps):
        share = ((k + 0.7) / steps) ** power
        size = (a + (neck_a - a) * share, b + (neck_b - b) * share, 0.62 * rise / steps)
        mixed = e2 + (round_e2 - e2) * share
        rows.append(_part(size, (rng.uniform(0.2, 0.5), mixed), (0, 0, low + rise * (k + 0.4) / steps)))
    return rows


def _closure(rng: np.random.Generator, a: float, b: float, low: float, top: float) -> list[_Row]:
    """The neck, from within the shoulders at the height ``low`` to ``top``, and what closes it above."""
    radius = min(rng.uniform(0.024, 0.05) / 2, 0.95 * b)
    tall = rng.uniform(0.012, 0.045)
    aside = rng.uniform(-0.35, 0.35) * a if rng.random() < 0.12 else 0.0
    base = top - 0.012
    choice = rng.random()
    wide = rng.uniform(0.5, 0.95)
    flip = 0.5 <= choice < 0.68
    neck = rng.uniform(0.75, 1.0) * (wide * b if flip else radius)
    long = rng.uniform(0.0, 0.06) if choice < 0.25 else 0.0
    middle = aside if choice < 0.82 and not flip else 0.0
    rows = [_part((neck, neck, (top + long - low) / 2), (0.1, 1.0), (middle, 0, (top + long + low) / 2))]
    if choice < 0.5:  # a screw cap
        size = (radius, radius, tall / 2)
        return [*rows, _part(size, (rng.uniform(0.05, 0.4), 1.0), (aside, 0, base + long + tall / 2))]
    if flip:  # a wide cap, oval as the bottle or round
        size = (wide * a, wide * b, tall / 2) if rng.random() < 0.6 else (wide * b, wide * b, tall / 2)
        return [*rows, _part(size, (rng.uniform(0.1, 0.5), rng.uniform(0.6, 1.0)), (0, 0, base + tall / 2))]
    if choice < 0.82:  # a nozzle that tapers
        long, tip = rng.uniform(0.02, 0.06), rng.uniform(0.004, 0.008)
        rows.append(_part((radius, radius, 0.009), (0.15, 1.0), (aside, 0, base + 0.006)))
        for k in range(3):
            r = radius * 0.8 + (tip - radius * 0.8) * (k + 0.5) / 3
            rows.append(_part((r, r, 0.65 * long / 3), (0.3, 1.0), (aside, 0, base + 0.012 + long * (k + 0.5) / 3)))
        return rows
    if choice < 0.91:  # a pump
        stem, reach = rng.uniform(0.02, 0.05), rng.uniform(0.018, 0.045)
        side = rng.choice([-1.0, 1.0])
        return [
            *rows,
            _part((radius, radius, 0.01), (0.15, 1.0), (0, 0, base + 0.008)),
            _part((0.005, 0.005, stem / 2), (0.2, 1.0), (0, 0, base + 0.015 + stem / 2)),
            _part((0.011, 0.011, 0.007), (0.4, 1.0), (0, 0, base + 0.015 + stem)),
            _part((reach / 2, 0.006, 0.005), (0.4, 0.5), (side * reach / 2, 0, base + 0.015 + stem)),
        ]
    long = rng.uniform(0.07, 0.11)  # a spray head with a trigger
    side = rng.choice([-1.0, 1.0])
    return [
        *rows,
        _part((radius, radius, 0.014), (0.15, 1.0), (0, 0, base + 0.01)),
        _part((0.012, 0.012, 0.02), (0.3, 0.6), (0, 0, base + 0.035)),
        _part((long / 2, 0.013, 0.014), (0.4, 0.3), (side * 0.15 * long, 0, base + 0.06), _about(1, side * 8.0)),
        _part((0.005, 0.008, 0.026), (0.4, 0.5), (side * 0.45 * long, 0, base + 0.038), _about(1, side * -18.0)),
    ]


def _grip(rng: np.random.Generator, a: float, straight: float, height: float) -> list[_Row]:
    """The handle of a jug, beside its shoulder."""
    thick, out = rng.uniform(0.008, 0.014), a * rng.uniform(0.75, 1.05)
    low, high = straight * rng.uniform(0.55, 0.8), height * rng.uniform(0.88, 0.98)
    tall = high - low
    return [
        _part((thick, thick, tall / 2), (0.4, 0.8), (out, 0, low + tall / 2), _about(1, rng.uniform(-15.0, 0.0))),
        _part((max(0.3 * a, thick), thick, thick), (0.5, 0.5), (0.7 * a, 0, high)),
    ]


def _tube(rng: np.random.Generator) -> Thing:
    """Squeeze tubes: round at the cap, flat at the crimp; they lie, or stand on the cap."""
    radius, long = rng.uniform(0.02, 0.055) / 2, rng.uniform(0.07, 0.2)
    flat = np.linspace(0.95, rng.uniform(0.1, 0.35), 5)
    rows = [
        _part((radius * (1.3 - 0.3 * f), radius * f, 0.62 * long / 5), (0.25, 0.9), (0, 0, long * (k + 0.5) / 5))
        for k, f in enumerate(flat)
    ]
    cap, tall = radius * rng.uniform(0.55, 1.0), rng.uniform(0.01, 0.03)
    rows.append(_part((cap, cap, tall / 2), (0.15, 1.0), (0, 0, -tall / 2)))
    return _thing("bottle", "tube", rows, (("lying", ON_Y, 0.75), ("standing", UPRIGHT, 0.25)))


def _revolved(radii: _Numbers, height: float, e1: float, e2: float = 1.0, flat: float = 1.0) -> list[_Row]:
    """A stack of slabs with these radii from the base to the top."""
    count = len(radii)
    return [
        _part((r, flat * r, 0.56 * height / count), (e1, e2), (0, 0, height * (k + 0.5) / count))
        for k, r in enumerate(radii)
    ]


def _cavity(radii: np.ndarray, height: float, wall: float, e2: float = 1.0, flat: float = 1.0) -> _Row:
    """The widest of some superquadrics about the middle of the rim that stays within a stack of slabs."""
    count = len(radii)
    # Depth below the rim of each slab's lower end, in depths of the cavity.
    depth = np.minimum(height * (1 - np.arange(count) / count) / (height - wall), 0.97)
    widest, best = 0.0, 1.0
    for e1 in (0.15, 0.4, 0.7, 1.0):
        radius = float(((radii - wall) / (1 - depth ** (2 / e1)) ** (e1 / 2)).min())
        radius = min(radius, radii[-1] - wall)
        if radius > widest + 1e-4:
            widest, best = radius, e1
    widest = max(widest, 0.3 * float(radii[-1]))
    return _part((widest, flat * widest, height - wall), (best, e2), (0, 0, height))


def _cup(rng: np.random.Generator) -> Thing:
    """Cups, tumblers and mugs, straight or tapered."""
    top, height = rng.uniform(0.055, 0.1) / 2, rng.uniform(0.05, 0.15)
    bottom = top * (1.0 if rng.random() < 0.45 else rng.uniform(0.6, 0.95))
    wall = rng.uniform(0.002, 0.006)
    count = 1 if bottom == top else 6
    radii = np.linspace(bottom, top, count + 2)[1:-1]
    rows = _revolved(radii, height, 0.08 if count == 1 else 0.2)
    cut = [_cavity(radii, height, wall)]
    name = "cup"
    if rng.random() < 0.55:
        name, thick = "mug", rng.uniform(0.004, 0.009)
        tall, out = height * rng.uniform(0.28, 0.42), rng.uniform(0.018, 0.038)
        at, steps = 0.5 * (bottom + top) - 0.004, 6
        for angle in np.linspace(-80, 80, steps):
            c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
            where = (at + out * c, 0, height / 2 + tall * s)
            along = 1.7 * tall * np.pi / steps / 2
            slope = np.rad2deg(np.arctan2(out * s, tall * c))
            rows.append(_part((thick * 0.8, thick, along), (0.6, 0.8), where, _about(1, -slope)))
    rests = (("standing", UPRIGHT, 0.8), ("lying", ON_X if name == "cup" else ON_Y, 0.12), ("inverted", INVERTED, 0.08))
    return _thing("vessel", name, rows, rests, cut)


def _bowl(rng: np.random.Generator) -> Thing:
    """Bowls, deep plates and plates: they widen upwards."""
    top = _log_uniform(rng, 0.09, 0.28) / 2
    height = min(2 * top * rng.uniform(0.07, 0.6), 0.12)
    foot = top * rng.uniform(0.4, 0.7)
    count = 4 if height < 0.03 else 8
    share = (np.arange(count) + 0.75) / count
    radii = foot + (top - foot) * share ** rng.uniform(0.4, 0.9)
    rows = _revolved(radii, height, 0.35)
    cut = [_cavity(radii, height, rng.uniform(0.003, 0.006))]
    return _thing("vessel", "bowl", rows, (("standing", UPRIGHT, 0.93), ("inverted", INVERTED, 0.07)), cut)


def _tub(rng: np.random.Generator) -> Thing:
    """Tubs and pots, round or softly square, often with a lid that reaches out."""
    top, height = rng.uniform(0.06, 0.2) / 2, rng.uniform(0.03, 0.14)
    bottom = top * rng.uniform(0.7, 1.0)
    e2, flat = (1.0, 1.0) if rng.random() < 0.6 else (rng.uniform(0.15, 0.6), rng.uniform(0.55, 1.0))
    radii = np.linspace(bottom, top, 6)[1:-1]
    rows = _revolved(radii, height, 0.2, e2, flat)
    lid = rng.uniform(0.003, 0.01)
    cut = []
    if rng.random() < 0.7:
        rows.append(_part((1.04 * top, 1.04 * flat * top, lid), (0.2, e2), (0, 0, height)))
    else:
        cut = [_cavity(radii, height, 0.004, e2, flat)]
    rests = (("standing", UPRIGHT, 0.85), ("inverted", INVERTED, 0.08), ("on its side", ON_Y, 0.07))
    return _thing("vessel", "tub", rows, rests, cut)


def _fruit(rng: np.random.Generator) -> Thing:
    """Fruit, balls, eggs: near to ellipsoids."""
    radius = _log_uniform(rng, 0.03, 0.12) / 2
    size = radius * np.array([1.0, rng.uniform(0.9, 1.0), rng.uniform(0.75, 1.45)])
    rows = [_part(size, rng.uniform(0.8, 1.0, 2))]
    choice = rng.random()
    if choice < 0.2:  # a pear
        rows.append(_part(size * [0.6, 0.6, 0.8], (1.0, 1.0), (0, 0, 0.8 * size[2])))
    elif choice < 0.35:  # the tips of a lemon
        rows.append(_part((0.3 * radius, 0.3 * radius, 1.2 * size[2]), (0.9, 1.0)))
    rests = (("standing", UPRIGHT, 0.5), ("lying", ON_X, 0.25), ("on its side", ON_Y, 0.25))
    return _thing("round", "fruit", rows, rests)


def _bent(rng: np.random.Generator) -> Thing:
    """Bananas and other bent things: an arc of ellipsoids in the xz plane; they lie on a side."""
    thick, bend = rng.uniform(0.028, 0.045) / 2, np.deg2rad(rng.uniform(40, 110))
    long = rng.uniform(0.12, 0.2)
    radius, steps = long / bend, 5
    rows = []
    for angle in np.linspace(-bend / 2, bend / 2, steps):
        r = thick * (1 - 0.45 * (2 * angle / bend) ** 2)
        where = (radius * (np.cos(angle) - 1), 0.0, radius * np.sin(angle))
        rows.append(_part((r, r, 0.75 * long / steps), (0.8, 1.0), where, _about(1, -np.rad2deg(angle))))
    return _thing("round", "bent fruit", rows, (("lying", ON_Y, 1.0),))


def _pen(rng: np.random.Generator) -> Thing:
    """Pens, markers, pencils, brushes."""
    radius, long = rng.uniform(0.007, 0.021) / 2, rng.uniform(0.09, 0.17)
    cap = radius * rng.uniform(0.85, 1.25)
    share = rng.uniform(0.25, 0.45)
    rows = [
        _part((radius, radius, (1 - share) * long / 2), (0.15, rng.uniform(0.7, 1.0)), (0, 0, (1 - share) * long / 2)),
        _part((cap, cap, share * long / 2), (rng.uniform(0.1, 0.5), 1.0), (0, 0, (1 - share / 2) * long)),
    ]
    return _thing("tool", "pen", rows, (("lying", ON_Y, 0.95), ("standing", UPRIGHT, 0.05)))


def _handled(rng: np.random.Generator) -> Thing:
    """A handle with a head: hammers, screwdrivers, spatulas, brushes, spoons, torches."""
    long, thick = rng.uniform(0.1, 0.25), rng.uniform(0.012, 0.036) / 2
    flat = rng.uniform(0.5, 1.0)
    rows = [_part((thick, flat * thick, long / 2), (rng.uniform(0.1, 0.4), rng.uniform(0.5, 1.0)), (0, 0, long / 2))]
    choice = rng.random()
    if choice < 0.35:  # across, as a hammer
        rows.append(
            _part((rng.uniform(0.03, 0.06), 0.6 * thick + 0.008, 0.6 * thick + 0.008), (0.3, 0.3), (0, 0, long))
        )
    elif choice < 0.7:  # a blade, a spoon, a brush
        wide, far = rng.uniform(0.012, 0.045), rng.uniform(0.03, 0.07)
        blade = (wide, rng.uniform(0.002, 0.012), far)
        rows.append(_part(blade, rng.uniform(0.2, 1.0, 2), (0, 0, long + 0.8 * far)))
    else:  # a shaft
        thin, far = rng.uniform(0.002, 0.006), rng.uniform(0.04, 0.15)
        rows.append(_part((thin, thin, far / 2), (0.2, 1.0), (0, 0, long + far / 2 - 0.004)))
    return _thing("tool", "handled tool", rows, (("lying", ON_Y, 1.0),))


def _gun(rng: np.random.Generator) -> Thing:
    """Drills, glue guns, hair dryers: a barrel, a grip below it and what the grip ends in."""
    barrel, thick = rng.uniform(0.12, 0.2), rng.uniform(0.035, 0.075) / 2
    grip, slope = rng.uniform(0.08, 0.14), rng.uniform(-20.0, 5.0)
    at = barrel * rng.uniform(0.15, 0.35)
    rows = [
        _part((barrel / 2, thick * 0.9, thick), (0.5, 0.4), (0, 0, grip)),
        _part((0.022, 0.016, grip / 2), (0.4, 0.7), (-at, 0, grip / 2), _about(1, slope)),
        _part((0.03, 0.012, 0.012), (0.4, 1.0), (barrel / 2 + 0.02, 0, grip)),
    ]
    if rng.random() < 0.6:
        rows.append(_part((0.045, 0.03, 0.02), (0.25, 0.3), (-at, 0, 0.0)))
    return _thing("tool", "gun", rows, (("lying", ON_Y, 0.7), ("standing", UPRIGHT, 0.3)))


def _toy(rng: np.random.Generator) -> Thing:
    """Two to five parts of any form that hold together."""
    rows = [_part(np.exp(rng.uniform(np.log(0.015), np.log(0.07), 3)), rng.uniform(0.1, 1.0, 2))]
    for _ in range(rng.integers(1, 5)):
        size = np.exp(rng.uniform(np.log(0.008), np.log(0.045), 3))
        other = rows[rng.integers(len(rows))]
        way = rng.standard_normal(3) * [1.0, 1.0, 0.7]
        way /= np.linalg.norm(way)
        at = np.array(other[5:8]) + way * np.array(other[:3]) * rng.uniform(0.6, 1.1)
        rows.append(_part(size, rng.uniform(0.1, 1.0, 2), at, quaternions.random(1, rng)[0]))
    return _thing(
        "union", "toy", rows, (("standing", UPRIGHT, 0.5), ("lying", ON_X, 0.25), ("on its side", ON_Y, 0.25))
    )


def _bag(rng: np.random.Generator) -> Thing:
    """Bags and pouches: soft boxes, thinner towards the seam; sponges."""
    width = _log_uniform(rng, 0.06, 0.22)
    height, depth = width * rng.uniform(0.6, 1.6), width * rng.uniform(0.1, 0.6)
    size = np.array([depth, width, height]) / 2
    rows = [_part(size, rng.uniform(0.25, 0.9, 2))]
    if rng.random() < 0.4:
        rows.append(_part(size * [rng.uniform(0.1, 0.4), 0.95, 0.25], (0.3, 0.3), (0, 0, 0.9 * size[2])))
    return _thing("soft", "bag", rows, (("lying", ON_X, 0.5), ("standing", UPRIGHT, 0.5)))


_MAKERS: dict[str, tuple[tuple[Callable[[np.random.Generator], Thing], float], ...]] = {
    "box": ((_carton, 0.78), (_book, 0.1), (_soap, 0.12)),
    "can": ((_tin, 0.55), (_jar, 0.2), (_spray_can, 0.13), (_roll, 0.12)),
    "bottle": ((_bottle, 0.92), (_tube, 0.08)),
    "vessel": ((_cup, 0.45), (_bowl, 0.3), (_tub, 0.25)),
    "round": ((_fruit, 0.75), (_bent, 0.25)),
    "tool": ((_pen, 0.35), (_handled, 0.4), (_gun, 0.25)),
    "union": ((_toy, 1.0),),
    "soft": ((_bag, 1.0),),
}
