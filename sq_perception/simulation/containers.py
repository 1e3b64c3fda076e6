"""Bottles, tubes, cups, bowls and tubs as unions of superquadrics, some with a cavity.

Measures and sources are in :mod:`sq_perception.simulation.household`.
"""

from __future__ import annotations

import numpy as np

from sq_perception.simulation.thing import (
    INVERTED,
    ON_X,
    ON_Y,
    OVAL_RESTS,
    ROUND_RESTS,
    UPRIGHT,
    Numbers,
    Row,
    Thing,
    about,
    assemble,
    log_uniform,
    part,
)

_OVERLAP, _EDGE = 0.56, 0.1
"""Half height of the slabs that revolved objects are stacked of, in their distance, and e1: where two meet, the surface
is 0.6 % nearer to the axis."""


def bottle(rng: np.random.Generator) -> Thing:
    """Make a round or oval bottle: body, shoulders, neck; cap, nozzle, pump or trigger; sometimes a waist or a
    handle."""
    oval = rng.random() < 0.55
    flat = rng.uniform(0.4, 0.92) if oval else 1.0
    e2 = rng.uniform(0.3, 1.0) if oval or rng.random() < 0.15 else 1.0
    width = log_uniform(rng, 0.045, 0.15) if oval else log_uniform(rng, 0.04, 0.11)
    height = min(width * log_uniform(rng, 1.4, 4.2), 0.36)
    a, b = width / 2, flat * width / 2
    straight = height * rng.uniform(0.4, 0.85)
    e1 = rng.uniform(0.05, 0.35)
    rows = [part((a, b, straight / 2), (e1, e2), (0, 0, straight / 2))]
    kind_of_body = rng.random()
    if kind_of_body < 0.15:  # wider or narrower towards the base
        low = rng.uniform(0.85, 1.12)
        rows.append(part((low * a, low * b, 0.25 * straight), (e1, e2), (0, 0, 0.25 * straight)))
    elif kind_of_body < 0.27:  # a waist: two bulges and what is between them
        waist = rng.uniform(0.78, 0.95)
        rows = [part((waist * a, waist * b, straight / 2), (e1, e2), (0, 0, straight / 2))]
        for middle, share in ((0.2, 0.22), (0.8, 0.22)):
            rows.append(part((a, b, share * straight), (rng.uniform(0.3, 0.8), e2), (0, 0, middle * straight)))
    rows += _shoulders(rng, a, b, e2, straight, height)
    rows += _closure(rng, a, b, straight, height)
    if oval and height > 0.16 and rng.random() < 0.18:
        rows += _grip(rng, a, straight, height)
    return assemble("bottle", "oval bottle" if flat < 1 else "round bottle", rows, OVAL_RESTS if oval else ROUND_RESTS)


def _shoulders(rng: np.random.Generator, a: float, b: float, e2: float, low: float, high: float) -> list[Row]:
    """Return the parts between the straight body, which ends at the height ``low``, and the neck at ``high``."""
    rise = high - low
    round_e2 = max(e2, rng.uniform(0.7, 1.0))
    if rng.random() < 0.6:  # a dome
        tall = rise * rng.uniform(0.5, 1.15)
        return [part((0.99 * a, 0.99 * b, tall), (rng.uniform(0.5, 1.0), e2), (0, 0, low - 0.05 * rise))]
    steps = 4
    power = rng.uniform(0.6, 1.8)
    neck_a, neck_b = rng.uniform(0.25, 0.7) * a, rng.uniform(0.3, 0.8) * b
    rows = []
    for k in range(steps):
        share = ((k + 0.7) / steps) ** power
        size = (a + (neck_a - a) * share, b + (neck_b - b) * share, 0.62 * rise / steps)
        mixed = e2 + (round_e2 - e2) * share
        rows.append(part(size, (rng.uniform(0.2, 0.5), mixed), (0, 0, low + rise * (k + 0.4) / steps)))
    return rows


def _closure(rng: np.random.Generator, a: float, b: float, low: float, top: float) -> list[Row]:
    """Return the neck, from within the shoulders at the height ``low`` to ``top``, and its closure."""
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
    rows = [part((neck, neck, (top + long - low) / 2), (0.1, 1.0), (middle, 0, (top + long + low) / 2))]
    if choice < 0.5:  # a screw cap
        size = (radius, radius, tall / 2)
        return [*rows, part(size, (rng.uniform(0.05, 0.4), 1.0), (aside, 0, base + long + tall / 2))]
    if flip:  # a wide cap, oval as the bottle or round
        size = (wide * a, wide * b, tall / 2) if rng.random() < 0.6 else (wide * b, wide * b, tall / 2)
        return [*rows, part(size, (rng.uniform(0.1, 0.5), rng.uniform(0.6, 1.0)), (0, 0, base + tall / 2))]
    if choice < 0.82:  # a nozzle that tapers
        long, tip = rng.uniform(0.02, 0.06), rng.uniform(0.004, 0.008)
        rows.append(part((radius, radius, 0.009), (0.15, 1.0), (aside, 0, base + 0.006)))
        for k in range(3):
            r = radius * 0.8 + (tip - radius * 0.8) * (k + 0.5) / 3
            rows.append(part((r, r, 0.65 * long / 3), (0.3, 1.0), (aside, 0, base + 0.012 + long * (k + 0.5) / 3)))
        return rows
    if choice < 0.91:  # a pump
        stem, reach = rng.uniform(0.02, 0.05), rng.uniform(0.018, 0.045)
        side = rng.choice([-1.0, 1.0])
        return [
            *rows,
            part((radius, radius, 0.01), (0.15, 1.0), (0, 0, base + 0.008)),
            part((0.005, 0.005, stem / 2), (0.2, 1.0), (0, 0, base + 0.015 + stem / 2)),
            part((0.011, 0.011, 0.007), (0.4, 1.0), (0, 0, base + 0.015 + stem)),
            part((reach / 2, 0.006, 0.005), (0.4, 0.5), (side * reach / 2, 0, base + 0.015 + stem)),
        ]
    long = rng.uniform(0.07, 0.11)  # a spray head with a trigger
    side = rng.choice([-1.0, 1.0])
    return [
        *rows,
        part((radius, radius, 0.014), (0.15, 1.0), (0, 0, base + 0.01)),
        part((0.012, 0.012, 0.02), (0.3, 0.6), (0, 0, base + 0.035)),
        part((long / 2, 0.013, 0.014), (0.4, 0.3), (side * 0.15 * long, 0, base + 0.06), about(1, side * 8.0)),
        part((0.005, 0.008, 0.026), (0.4, 0.5), (side * 0.45 * long, 0, base + 0.038), about(1, side * -18.0)),
    ]


def _grip(rng: np.random.Generator, a: float, straight: float, height: float) -> list[Row]:
    """Return the handle of a jug, beside its shoulder."""
    thick, out = rng.uniform(0.008, 0.014), a * rng.uniform(0.75, 1.05)
    low, high = straight * rng.uniform(0.55, 0.8), height * rng.uniform(0.88, 0.98)
    tall = high - low
    return [
        part((thick, thick, tall / 2), (0.4, 0.8), (out, 0, low + tall / 2), about(1, rng.uniform(-15.0, 0.0))),
        part((max(0.3 * a, thick), thick, thick), (0.5, 0.5), (0.7 * a, 0, high)),
    ]


def tube(rng: np.random.Generator) -> Thing:
    """Make a squeeze tube: round at the cap, flat at the crimp; it lies, or stands on the cap."""
    radius, long = rng.uniform(0.02, 0.055) / 2, rng.uniform(0.07, 0.2)
    flat = np.linspace(0.95, rng.uniform(0.1, 0.35), 5)
    rows = [
        part((radius * (1.3 - 0.3 * f), radius * f, 0.62 * long / 5), (0.25, 0.9), (0, 0, long * (k + 0.5) / 5))
        for k, f in enumerate(flat)
    ]
    cap, tall = radius * rng.uniform(0.55, 1.0), rng.uniform(0.01, 0.03)
    rows.append(part((cap, cap, tall / 2), (0.15, 1.0), (0, 0, -tall / 2)))
    return assemble("bottle", "tube", rows, (("lying", ON_Y, 0.75), ("standing", UPRIGHT, 0.25)))


def _revolve(radii: Numbers, height: float, e2: float = 1.0, flat: float = 1.0) -> list[Row]:
    """Return a stack of slabs with these radii from the base to the top."""
    count = len(radii)
    return [
        part((r, flat * r, _OVERLAP * height / count), (_EDGE, e2), (0, 0, height * (k + 0.5) / count))
        for k, r in enumerate(radii)
    ]


def _cavity(radii: np.ndarray, height: float, wall: float, e2: float = 1.0, flat: float = 1.0) -> list[Row]:
    """Return the widest of some superquadrics at the rim that stays within a stack of slabs; none if it is narrow.  At
    the height z a superquadric of the half height h has the radius a (1 - |z / h|^(2 / e1))^(e1 / 2)."""
    count = len(radii)
    z = np.linspace(wall, height, 100, endpoint=False)
    up = (z[:, None] - height * (np.arange(count) + 0.5) / count) / (_OVERLAP * height / count)
    outer = (radii * np.maximum(1 - np.abs(up) ** (2 / _EDGE), 0.0) ** (_EDGE / 2)).max(axis=1)
    down = (height - z) / (height - wall)
    widest, best = 0.0, 1.0
    for e1 in (0.15, 0.4, 0.7, 1.0):
        profile = (1 - np.minimum(down, 1 - 1e-9) ** (2 / e1)) ** (e1 / 2)
        radius = float(((outer - wall) / profile).min())
        if radius > widest + 1e-4:
            widest, best = radius, e1
    if widest < 0.3 * radii[-1]:
        return []
    return [part((widest, flat * widest, height - wall), (best, e2), (0, 0, height))]


def cup(rng: np.random.Generator) -> Thing:
    """Make a cup, tumbler or mug, straight or tapered."""
    top, height = rng.uniform(0.055, 0.1) / 2, rng.uniform(0.05, 0.15)
    bottom = top * (1.0 if rng.random() < 0.45 else rng.uniform(0.6, 0.95))
    wall = rng.uniform(0.002, 0.006)
    count = 1 if bottom == top else 6
    radii = np.linspace(bottom, top, count + 2)[1:-1]
    rows = _revolve(radii, height)
    cut = _cavity(radii, height, wall)
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
    return assemble("vessel", name, rows, rests, cut)


def bowl(rng: np.random.Generator) -> Thing:
    """Make a bowl, deep plate or plate that widens upwards."""
    top = log_uniform(rng, 0.09, 0.28) / 2
    height = min(2 * top * rng.uniform(0.07, 0.6), 0.12)
    foot = top * rng.uniform(0.4, 0.7)
    count = 4 if height < 0.03 else 8
    share = (np.arange(count) + 0.75) / count
    radii = foot + (top - foot) * share ** rng.uniform(0.4, 0.9)
    rows = _revolve(radii, height)
    cut = _cavity(radii, height, rng.uniform(0.003, 0.006))
    return assemble("vessel", "bowl", rows, (("standing", UPRIGHT, 0.93), ("inverted", INVERTED, 0.07)), cut)


def tub(rng: np.random.Generator) -> Thing:
    """Make a tub or pot, round or softly square, often with a wider lid."""
    top, height = rng.uniform(0.06, 0.2) / 2, rng.uniform(0.03, 0.14)
    bottom = top * rng.uniform(0.7, 1.0)
    e2, flat = (1.0, 1.0) if rng.random() < 0.6 else (rng.uniform(0.15, 0.6), rng.uniform(0.55, 1.0))
    radii = np.linspace(bottom, top, 6)[1:-1]
    rows = _revolve(radii, height, e2, flat)
    lid = rng.uniform(0.003, 0.01)
    cut: list[Row] = []
    if rng.random() < 0.7:
        rows.append(part((1.04 * top, 1.04 * flat * top, lid), (0.2, e2), (0, 0, height)))
    else:
        cut = _cavity(radii, height, 0.004, e2, flat)
    rests = (("standing", UPRIGHT, 0.85), ("inverted", INVERTED, 0.08), ("on its side", ON_Y, 0.07))
    return assemble("vessel", "tub", rows, rests, cut)
