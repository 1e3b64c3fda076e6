"""Necks and caps: what stands on a thing because the thing narrows towards it belongs to it.

Along the normal of the support, a thing has a width w(h) across the line of sight.  A bottle narrows towards its neck:

    w(top) < SHOULDER w(whole),      w(neck) about w(top),      the neck in the middle,

while what is stacked on a thing stands on a top that is as wide as the thing.  Convexity alone cuts both alike, at the
concave edge between them.  Widths are between the 3 % and 97 % quantiles of what is seen.

In 160 scenes of benchmarks/household_things this gave 25 of 42 cut parts back to their things and joined no two things.
Bottles that lie stay cut.  Metres, optical frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sq_perception.geometry.quantiles import quantile
from sq_perception.imaging import regions
from sq_perception.imaging.camera import Camera

_SHOULDER = 0.945
"""Of the whole width, that of the highest part of a thing that narrows; flat tops were seen 0.94 to 1.06 wide."""
_NARROWEST, _WIDEST = 0.35, 1.3
"""Of the width of that part, the width of a neck with its cap; a pen on a box is narrower, a can on a tin wider."""
_OFF_CENTRE = 0.2
"""Of the whole width, between the middles."""
_WIDEST_BOTTLE = 0.12
"""Metres; canisters are wider, and so are most things that others are put on."""
_GAP = 0.03
"""Metres of height that steep shoulders and smeared edges leave between the two."""
_TALLEST = 2.0
"""Heights of the thing; a neck is seldom taller."""
_HIGHEST = 0.15
"""Of a thing's height: its highest part."""
_SAMPLES = 400
"""Of a segment: its quantiles settle to a hundredth."""
_LEAST_PIXELS = 30
"""Of a segment whose quantiles say anything."""
_LEAST_SLANT = 0.3
"""Sine of the angle between the line of sight and the normal: from above, there are no heights to be seen."""


@dataclass(frozen=True, eq=False)
class _Profile:
    """Heights and places across the line of sight of a segment's points, both (n,), and how far away they are."""

    height: np.ndarray
    across: np.ndarray
    away: float

    @cached_property
    def foot_and_top(self) -> tuple[float, float]:
        return quantile(self.height, 0.05), quantile(self.height, 0.95)

    @cached_property
    def sides(self) -> tuple[float, float]:
        return quantile(self.across, 0.03), quantile(self.across, 0.97)

    @property
    def width(self) -> float:
        left, right = self.sides
        return right - left

    @cached_property
    def shoulder(self) -> float:
        """Width of the highest part."""
        foot, top = self.foot_and_top
        across = self.across[self.height >= top - _HIGHEST * (top - foot)]
        return quantile(across, 0.97) - quantile(across, 0.03)

    def with_(self, other: _Profile) -> _Profile:
        both = [np.concatenate(each) for each in ((self.height, other.height), (self.across, other.across))]
        return _Profile(both[0], both[1], self.away)

    def narrows_to(self, neck: _Profile) -> bool:
        """Whether the other one is the neck of this one."""
        foot, top = self.foot_and_top
        neck_foot, neck_top = neck.foot_and_top
        if not -_GAP < neck_foot - top < _GAP or neck_top - neck_foot > _TALLEST * (top - foot):
            return False
        if self.width > _WIDEST_BOTTLE or abs(self.away - neck.away) > self.width:
            return False
        shoulder = self.shoulder
        if shoulder > _SHOULDER * self.width:
            return False
        off = abs(sum(self.sides) - sum(neck.sides)) / 2
        return _NARROWEST * shoulder < neck.width < _WIDEST * shoulder and off < _OFF_CENTRE * self.width


def joined(labels: np.ndarray, depth: np.ndarray, camera: Camera, plane: np.ndarray) -> np.ndarray:
    """Segments (height, width), 0 for nothing, with necks and caps given to what they stand on.

    ``depth`` is 0 where nothing was measured; ``plane`` (4,) is the support, height above it = n.p + d.
    """
    up = plane[:3]
    sideways = np.array([up[1], -up[0], 0.0])
    slant = float(np.linalg.norm(sideways))
    if slant < _LEAST_SLANT:
        return labels
    forward = np.cross(sideways, up) / slant
    extents = regions.extents(labels)
    profiles: dict[int, _Profile] = {}
    for label in np.flatnonzero(extents[:, 0] >= _LEAST_PIXELS).tolist():
        rows, columns = regions.pixels(labels, label, extents[label])
        step = 1 + rows.size // _SAMPLES
        rows, columns = rows[::step], columns[::step]
        points = camera.unproject(columns, rows, depth[rows, columns])
        away = quantile(points @ forward, 0.5)
        profiles[label] = _Profile(points @ plane[:3] + plane[3], points @ sideways / slant, away)
    number = np.arange(len(extents), dtype=labels.dtype)
    # From below: a cap stands on a neck that stands on a bottle.
    for label in sorted(profiles, key=lambda other: quantile(profiles[other].height, 0.5)):
        below = [other for other in profiles if other != label and profiles[other].narrows_to(profiles[label])]
        if below:
            nearest = min(below, key=lambda other: abs(profiles[other].away - profiles[label].away))
            profiles[nearest] = profiles[nearest].with_(profiles.pop(label))
            number[number == label] = nearest
    return regions.renumbered(labels, number)
