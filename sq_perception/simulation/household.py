"""Household objects: unions of superquadrics of household proportions.

A :class:`~sq_perception.simulation.thing.Thing` is drawn by its kind; bottles and vessels have their own module.

Families and their measures (ranges are wider than the sources: objects differ)
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
standards for fruit, table ware of hotel catalogues.  Benchmark objects are not among them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.simulation.containers import bottle, bowl, cup, tub, tube
from sq_perception.simulation.thing import (
    CARTON_RESTS,
    ON_X,
    ON_Y,
    ROUND_RESTS,
    UPRIGHT,
    Thing,
    about,
    assemble,
    draw_index,
    log_uniform,
    part,
)


def draw_thing(rng: np.random.Generator, kinds: Sequence[str] | None = None) -> Thing:
    """Draw a random object, of one of the given kinds or of any; a ValueError if one is unknown or none is given."""
    names = list(KINDS if kinds is None else kinds)
    if not names or not set(names) <= set(KINDS):
        raise ValueError(f"kinds: expected some of {', '.join(KINDS)}, got {names}")
    _, makers = _MAKERS[names[draw_index([_MAKERS[name][0] for name in names], rng)]]
    return makers[draw_index([likely for _, likely in makers], rng)][0](rng)


def _carton(rng: np.random.Generator) -> Thing:
    """Make a carton: depth, width, height in any order of length; edges from sharp to soft."""
    longest = log_uniform(rng, 0.045, 0.34)
    middle = longest * rng.uniform(0.3, 1.0)
    shortest = max(middle * log_uniform(rng, 0.12, 1.0), 0.012)
    edges = np.array([shortest, middle, longest])
    if rng.random() < 0.4:
        edges = edges[rng.permutation(3)]
    soft = 0.03 + 0.3 * rng.random(2) ** 2
    return assemble("box", "carton", [part(edges / 2, soft)], CARTON_RESTS)


def _book(rng: np.random.Generator) -> Thing:
    """Make a book in ISO 216 or similar trade formats, 5 to 50 mm thick."""
    height = rng.choice([0.297, 0.21, 0.148, 0.25]) * rng.uniform(0.9, 1.1)
    size = np.array([rng.uniform(0.005, 0.05), height * rng.uniform(0.6, 0.8), height]) / 2
    rests = (("flat", ON_X, 0.8), ("standing", UPRIGHT, 0.2))
    return assemble("box", "book", [part(size, rng.uniform(0.02, 0.1, 2))], rests)


def _soap(rng: np.random.Generator) -> Thing:
    """Make a bar of soap, eraser, or brick of wood or foam: small and softer."""
    longest = log_uniform(rng, 0.03, 0.14)
    edges = longest * np.array([rng.uniform(0.2, 0.7), rng.uniform(0.4, 1.0), 1.0])
    shape = rng.uniform(0.1, 0.5, 2)
    return assemble("box", "bar", [part(edges / 2, shape)], (("flat", ON_X, 0.6), *CARTON_RESTS))


def _tin(rng: np.random.Generator) -> Thing:
    """Make a drink or food can, flat tin or drum of powder: the makers' diameters, any height."""
    radius = float(rng.choice([0.052, 0.053, 0.058, 0.066, 0.073, 0.083, 0.099])) / 2 * rng.uniform(0.9, 1.1)
    if rng.random() < 0.35:
        radius = log_uniform(rng, 0.045, 0.13) / 2
    height = 2 * radius * log_uniform(rng, 0.35, 2.6)
    e1 = 0.03 + 0.2 * rng.random() ** 2
    end, is_seamed = radius, rng.random() < 0.6
    edge = 0.04 if is_seamed else 1.0  # seams are sharp
    rows = [part((radius, radius, height / 2), (min(e1, edge), 1.0))]
    top = height / 2
    if rng.random() < 0.35:  # the narrower end of a drink can, or a raised lid
        end, rim = rng.uniform(0.8, 0.98) * radius, rng.uniform(0.002, 0.01)
        rows.append(part((end, end, rim), (min(0.15, edge), 1.0), (0, 0, top)))
        top += rim
    cut = []
    if is_seamed:  # the ends lie a countersink of 3 to 7 mm below their rims
        for inner, z in ((end, top), (radius, -height / 2)):
            inner -= rng.uniform(0.0015, 0.0035)
            cut.append(part((inner, inner, rng.uniform(0.003, 0.007)), (0.1, 1.0), (0, 0, z)))
    return assemble("can", "tin", rows, ROUND_RESTS, cut)


def _spray_can(rng: np.random.Generator) -> Thing:
    """Make an aerosol can, 35 to 66 mm wide, with dome and cap."""
    radius, height = rng.uniform(0.035, 0.068) / 2, rng.uniform(0.1, 0.25)
    cap, tall = rng.uniform(0.45, 0.98) * radius, rng.uniform(0.015, 0.06)
    dome = rng.uniform(0.3, 0.8) * radius
    rows = [
        part((radius, radius, height / 2), (0.08, 1.0)),
        part((0.97 * radius, 0.97 * radius, dome), (rng.uniform(0.6, 1.0), 1.0), (0, 0, height / 2)),
        part((cap, cap, tall / 2), (rng.uniform(0.08, 0.5), 1.0), (0, 0, height / 2 + 0.6 * dome + 0.3 * tall)),
    ]
    return assemble("can", "spray can", rows, ROUND_RESTS)


def _jar(rng: np.random.Generator) -> Thing:
    """Make a jar with a lid, round or softly square."""
    radius = rng.uniform(0.045, 0.12) / 2
    height = 2 * radius * rng.uniform(0.5, 1.9)
    e2 = 1.0 if rng.random() < 0.75 else rng.uniform(0.3, 0.8)
    lid = radius * rng.uniform(0.72, 1.03)
    tall = rng.uniform(0.009, 0.03)
    rows = [
        part((radius, radius, height / 2), (rng.uniform(0.1, 0.45), e2)),
        part((lid, lid, tall / 2), (rng.uniform(0.05, 0.25), 1.0), (0, 0, height / 2 + tall * rng.uniform(0.2, 0.48))),
    ]
    return assemble("can", "jar", rows, ROUND_RESTS)


def _roll(rng: np.random.Generator) -> Thing:
    """Make a roll of paper, tape, foil or biscuits."""
    if rng.random() < 0.5:
        radius, height = rng.uniform(0.08, 0.14) / 2, rng.uniform(0.09, 0.26)
    elif rng.random() < 0.5:
        radius, height = rng.uniform(0.06, 0.13) / 2, rng.uniform(0.012, 0.06)
    else:
        radius, height = rng.uniform(0.03, 0.07) / 2, rng.uniform(0.12, 0.32)
    rests = (("standing", UPRIGHT, 0.5), ("lying", ON_Y, 0.5))
    return assemble("can", "roll", [part((radius, radius, height / 2), (rng.uniform(0.03, 0.3), 1.0))], rests)


def _fruit(rng: np.random.Generator) -> Thing:
    """Make a fruit, ball or egg: nearly an ellipsoid."""
    radius = log_uniform(rng, 0.03, 0.12) / 2
    size = radius * np.array([1.0, rng.uniform(0.9, 1.0), rng.uniform(0.75, 1.45)])
    rows = [part(size, rng.uniform(0.8, 1.0, 2))]
    choice = rng.random()
    if choice < 0.2:  # a pear
        rows.append(part(size * [0.6, 0.6, 0.8], (1.0, 1.0), (0, 0, 0.8 * size[2])))
    elif choice < 0.35:  # the tips of a lemon
        rows.append(part((0.3 * radius, 0.3 * radius, 1.2 * size[2]), (0.9, 1.0)))
    rests = (("standing", UPRIGHT, 0.5), ("lying", ON_X, 0.25), ("on its side", ON_Y, 0.25))
    return assemble("round", "fruit", rows, rests)


def _bend(rng: np.random.Generator) -> Thing:
    """Make a banana or another bent object: an arc of ellipsoids in the xz plane, which lies on a side."""
    thick, bend = rng.uniform(0.028, 0.045) / 2, np.deg2rad(rng.uniform(40, 110))
    long = rng.uniform(0.12, 0.2)
    radius, steps = long / bend, 5
    rows = []
    for angle in np.linspace(-bend / 2, bend / 2, steps):
        r = thick * (1 - 0.45 * (2 * angle / bend) ** 2)
        where = (radius * (np.cos(angle) - 1), 0.0, radius * np.sin(angle))
        rows.append(part((r, r, 0.75 * long / steps), (0.8, 1.0), where, about(1, -np.rad2deg(angle))))
    return assemble("round", "bent fruit", rows, (("lying", ON_Y, 1.0),))


def _pen(rng: np.random.Generator) -> Thing:
    """Make a pen, marker, pencil or brush."""
    radius, long = rng.uniform(0.007, 0.021) / 2, rng.uniform(0.09, 0.17)
    cap = radius * rng.uniform(0.85, 1.25)
    share = rng.uniform(0.25, 0.45)
    rows = [
        part((radius, radius, (1 - share) * long / 2), (0.15, rng.uniform(0.7, 1.0)), (0, 0, (1 - share) * long / 2)),
        part((cap, cap, share * long / 2), (rng.uniform(0.1, 0.5), 1.0), (0, 0, (1 - share / 2) * long)),
    ]
    return assemble("tool", "pen", rows, (("lying", ON_Y, 0.95), ("standing", UPRIGHT, 0.05)))


def _add_handle(rng: np.random.Generator) -> Thing:
    """Make a handle with a head: hammer, screwdriver, spatula, brush, spoon or torch."""
    long, thick = rng.uniform(0.1, 0.25), rng.uniform(0.012, 0.036) / 2
    flat = rng.uniform(0.5, 1.0)
    rows = [part((thick, flat * thick, long / 2), (rng.uniform(0.1, 0.4), rng.uniform(0.5, 1.0)), (0, 0, long / 2))]
    choice = rng.random()
    if choice < 0.35:  # across, as a hammer
        rows.append(part((rng.uniform(0.03, 0.06), 0.6 * thick + 0.008, 0.6 * thick + 0.008), (0.3, 0.3), (0, 0, long)))
    elif choice < 0.7:  # a blade, a spoon, a brush
        wide, far = rng.uniform(0.012, 0.045), rng.uniform(0.03, 0.07)
        blade = (wide, rng.uniform(0.002, 0.012), far)
        rows.append(part(blade, rng.uniform(0.2, 1.0, 2), (0, 0, long + 0.8 * far)))
    else:  # a shaft
        thin, far = rng.uniform(0.002, 0.006), rng.uniform(0.04, 0.15)
        rows.append(part((thin, thin, far / 2), (0.2, 1.0), (0, 0, long + far / 2 - 0.004)))
    return assemble("tool", "handled tool", rows, (("lying", ON_Y, 1.0),))


def _gun(rng: np.random.Generator) -> Thing:
    """Make a drill, glue gun or hair dryer: a barrel, a grip below it and its end."""
    barrel, thick = rng.uniform(0.12, 0.2), rng.uniform(0.035, 0.075) / 2
    grip, slope = rng.uniform(0.08, 0.14), rng.uniform(-20.0, 5.0)
    at = barrel * rng.uniform(0.15, 0.35)
    rows = [
        part((barrel / 2, thick * 0.9, thick), (0.5, 0.4), (0, 0, grip)),
        part((0.022, 0.016, grip / 2), (0.4, 0.7), (-at, 0, grip / 2), about(1, slope)),
        part((0.03, 0.012, 0.012), (0.4, 1.0), (barrel / 2 + 0.02, 0, grip)),
    ]
    if rng.random() < 0.6:
        rows.append(part((0.045, 0.03, 0.02), (0.25, 0.3), (-at, 0, 0.0)))
    return assemble("tool", "gun", rows, (("lying", ON_Y, 0.7), ("standing", UPRIGHT, 0.3)))


def _toy(rng: np.random.Generator) -> Thing:
    """Make two to five connected parts of any form."""
    rows = [part(np.exp(rng.uniform(np.log(0.015), np.log(0.07), 3)), rng.uniform(0.1, 1.0, 2))]
    for _ in range(rng.integers(1, 5)):
        size = np.exp(rng.uniform(np.log(0.008), np.log(0.045), 3))
        other = rows[rng.integers(len(rows))]
        way = rng.standard_normal(3) * [1.0, 1.0, 0.7]
        way /= np.linalg.norm(way)
        at = np.array(other[5:8]) + way * np.array(other[:3]) * rng.uniform(0.6, 1.1)
        rows.append(part(size, rng.uniform(0.1, 1.0, 2), at, quaternions.random(1, rng)[0]))
    return assemble(
        "union", "toy", rows, (("standing", UPRIGHT, 0.5), ("lying", ON_X, 0.25), ("on its side", ON_Y, 0.25))
    )


def _bag(rng: np.random.Generator) -> Thing:
    """Make a bag, pouch or sponge: a soft box, thinner towards the seam."""
    width = log_uniform(rng, 0.06, 0.22)
    height, depth = width * rng.uniform(0.6, 1.6), width * rng.uniform(0.1, 0.6)
    size = np.array([depth, width, height]) / 2
    rows = [part(size, rng.uniform(0.25, 0.9, 2))]
    if rng.random() < 0.4:
        rows.append(part(size * [rng.uniform(0.1, 0.4), 0.95, 0.25], (0.3, 0.3), (0, 0, 0.9 * size[2])))
    return assemble("soft", "bag", rows, (("lying", ON_X, 0.5), ("standing", UPRIGHT, 0.5)))


_MAKERS: dict[str, tuple[float, tuple[tuple[Callable[[np.random.Generator], Thing], float], ...]]] = {
    "box": (0.29, ((_carton, 0.78), (_book, 0.1), (_soap, 0.12))),
    "can": (0.18, ((_tin, 0.55), (_jar, 0.2), (_spray_can, 0.13), (_roll, 0.12))),
    "bottle": (0.24, ((bottle, 0.92), (tube, 0.08))),
    "vessel": (0.10, ((cup, 0.45), (bowl, 0.3), (tub, 0.25))),
    "round": (0.06, ((_fruit, 0.75), (_bend, 0.25))),
    "tool": (0.05, ((_pen, 0.35), (_add_handle, 0.4), (_gun, 0.25))),
    "union": (0.04, ((_toy, 1.0),)),
    "soft": (0.04, ((_bag, 1.0),)),
}
"""Default frequency of each kind, and its families with their frequencies."""
KINDS = tuple(_MAKERS)
