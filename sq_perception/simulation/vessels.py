"""Cups, bowls and tubs: slabs of superquadrics with a cavity; measures in :mod:`sq_perception.simulation.household`."""

from __future__ import annotations

import numpy as np

from sq_perception.simulation.thing import (
    INVERTED,
    ON_X,
    ON_Y,
    UPRIGHT,
    Numbers,
    Row,
    Thing,
    about,
    assembled,
    log_uniform,
    part,
)


def _revolved(radii: Numbers, height: float, e1: float, e2: float = 1.0, flat: float = 1.0) -> list[Row]:
    """A stack of slabs with these radii from the base to the top."""
    count = len(radii)
    return [
        part((r, flat * r, 0.56 * height / count), (e1, e2), (0, 0, height * (k + 0.5) / count))
        for k, r in enumerate(radii)
    ]


def _cavity(radii: np.ndarray, height: float, wall: float, e2: float = 1.0, flat: float = 1.0) -> Row:
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
    return part((widest, flat * widest, height - wall), (best, e2), (0, 0, height))


def cup(rng: np.random.Generator) -> Thing:
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
            rows.append(part((thick * 0.8, thick, along), (0.6, 0.8), where, about(1, -slope)))
    rests = (("standing", UPRIGHT, 0.8), ("lying", ON_X if name == "cup" else ON_Y, 0.12), ("inverted", INVERTED, 0.08))
    return assembled("vessel", name, rows, rests, cut)


def bowl(rng: np.random.Generator) -> Thing:
    """Bowls, deep plates and plates: they widen upwards."""
    top = log_uniform(rng, 0.09, 0.28) / 2
    height = min(2 * top * rng.uniform(0.07, 0.6), 0.12)
    foot = top * rng.uniform(0.4, 0.7)
    count = 4 if height < 0.03 else 8
    share = (np.arange(count) + 0.75) / count
    radii = foot + (top - foot) * share ** rng.uniform(0.4, 0.9)
    rows = _revolved(radii, height, 0.35)
    cut = [_cavity(radii, height, rng.uniform(0.003, 0.006))]
    return assembled("vessel", "bowl", rows, (("standing", UPRIGHT, 0.93), ("inverted", INVERTED, 0.07)), cut)


def tub(rng: np.random.Generator) -> Thing:
    """Tubs and pots, round or softly square, often with a lid that reaches out."""
    top, height = rng.uniform(0.06, 0.2) / 2, rng.uniform(0.03, 0.14)
    bottom = top * rng.uniform(0.7, 1.0)
    e2, flat = (1.0, 1.0) if rng.random() < 0.6 else (rng.uniform(0.15, 0.6), rng.uniform(0.55, 1.0))
    radii = np.linspace(bottom, top, 6)[1:-1]
    rows = _revolved(radii, height, 0.2, e2, flat)
    lid = rng.uniform(0.003, 0.01)
    cut = []
    if rng.random() < 0.7:
        rows.append(part((1.04 * top, 1.04 * flat * top, lid), (0.2, e2), (0, 0, height)))
    else:
        cut = [_cavity(radii, height, 0.004, e2, flat)]
    rests = (("standing", UPRIGHT, 0.85), ("inverted", INVERTED, 0.08), ("on its side", ON_Y, 0.07))
    return assembled("vessel", "tub", rows, rests, cut)
