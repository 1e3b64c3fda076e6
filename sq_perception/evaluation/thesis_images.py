"""The test set: bodies of the thesis' protocol and their 8 bit images, which no training has seen.

Protocol (thesis, chapter 5.1; :mod:`sq_perception.simulation.scenes`): half sizes 25 to 75 of 255, exponents 0.1 to 1,
the centre at 128 +- 40, uniform rotations; images of 256 x 256 pixels whose grey value is the floor of 255 z.

Seeds.  Bodies come in blocks of 500, block b from the generator of ``SeedSequence(seed, spawn_key=(6, b))``, so that
the first n bodies are the same however many are drawn.  Training draws from ``[seed, step]`` and validates on ``0``: no
spawn key, hence other numbers for every seed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sq_perception.evaluation.protocol import DEFAULT_SEED
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast, unit_cube
from sq_perception.simulation.scenes import thesis_bodies

CAMERA = unit_cube.camera()
"""The orthographic camera of all images."""
CHUNK = 200
"""Images in memory at a time, 50 MB; changes no result."""
_BLOCK = 500
_SPAWN_KEY = 6


@dataclass(frozen=True)
class ThesisImages:
    """The test set of ``count`` bodies; a ValueError for fewer than one, or a negative seed."""

    count: int
    seed: int = DEFAULT_SEED

    def __post_init__(self) -> None:
        if self.count < 1 or self.seed < 0:
            raise ValueError(f"expected at least 1 body and a seed of at least 0, got {self.count}, seed {self.seed}")

    @cached_property
    def truth(self) -> Superquadric:
        """All bodies (count,) in the cube frame."""
        blocks = []
        for block in range(-(-self.count // _BLOCK)):
            seeds = np.random.SeedSequence(self.seed, spawn_key=(_SPAWN_KEY, block))
            blocks.append(thesis_bodies(_BLOCK, np.random.default_rng(seeds)).to_flat())
        return Superquadric.from_flat(np.concatenate(blocks)[: self.count])

    def image(self, number: int) -> np.ndarray:
        """Depth float32 (256, 256) of one body, NaN for background."""
        depth, _ = raycast.render(unit_cube.optical_from_cube(self.truth[number]), CAMERA)
        return unit_cube.depth_from_grey(unit_cube.grey_from_depth(depth))

    def chunks(self) -> Iterator[tuple[int, np.ndarray]]:
        """All images, some at a time: the number of the first body, and depth (n, 256, 256)."""
        for first in range(0, self.count, CHUNK):
            yield first, np.stack([self.image(number) for number in range(first, min(first + CHUNK, self.count))])
