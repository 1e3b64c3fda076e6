"""The test set: bodies of the thesis' protocol and their 8 bit images, which no training has seen.

Protocol (thesis, chapter 5.1; :mod:`sq_perception.simulation.scenes`): half sizes 25 to 75 of 255, exponents 0.1 to 1,
the centre at 128 +- 40, uniform rotations; images of 256 x 256 pixels whose grey value is the floor of 255 z.

Seeds.  Bodies come in blocks of 500, block b from the generator of ``SeedSequence(seed, spawn_key=(6, b))``, so that
the first n bodies are the same however many are drawn.  Training draws from ``[seed, step]`` and validates on ``0``: no
spawn key, hence other numbers for every seed.

Images are rendered chunk by chunk and forgotten; a chunk of 200 takes 50 MB.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sq_perception.evaluation.protocol import DEFAULT_SEED
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast, unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.simulation.scenes import thesis_bodies

CHUNK = 200
"""Images in memory at a time; changes no result."""
_BLOCK = 500
_SPAWN_KEY = 6


@dataclass(frozen=True, eq=False)
class ImageChunk:
    """Consecutive bodies of the test set with their images.

    Attributes
    ----------
    first : int
        Number of the first body within the test set.
    truth : Superquadric
        Batch (n,) in the cube frame.
    depth : float32 (n, height, width)
        Depth of the unit cube's camera, 255 steps a unit, NaN for background.
    camera : Camera
    """

    first: int
    truth: Superquadric
    depth: np.ndarray
    camera: Camera

    def __len__(self) -> int:
        return len(self.depth)

    def head(self, count: int) -> ImageChunk:
        """The first ``count`` of these images; all of them where there are no more."""
        count = max(count, 0)
        return ImageChunk(self.first, self.truth[:count], self.depth[:count], self.camera)


@dataclass(frozen=True)
class ThesisImages:
    """The test set of ``count`` bodies; see the module.

    Raises
    ------
    ValueError
        For fewer than one body, or a negative seed.
    """

    count: int
    seed: int = DEFAULT_SEED

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError(f"count: expected at least 1 body, got {self.count}")
        if self.seed < 0:
            raise ValueError(f"seed: expected a number of at least 0, got {self.seed}")

    @property
    def camera(self) -> Camera:
        """The orthographic camera of all images."""
        return unit_cube.camera()

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
        depth, _ = raycast.render(unit_cube.optical_from_cube(self.truth[number]), self.camera)
        return unit_cube.depth_from_grey(unit_cube.grey_from_depth(depth))

    def chunks(self) -> Iterator[ImageChunk]:
        """All bodies with their images, some at a time."""
        for first in range(0, self.count, CHUNK):
            numbers = range(first, min(first + CHUNK, self.count))
            depth = np.stack([self.image(number) for number in numbers])
            yield ImageChunk(first, self.truth[first : numbers.stop], depth, self.camera)
