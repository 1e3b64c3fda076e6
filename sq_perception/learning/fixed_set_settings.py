"""What fixes a set of :mod:`sq_perception.learning.fixed_set`: its images, their number and where chance begins.

NumPy is imported where pixels are touched, so that the help of ``sq-perception dataset`` need not wait for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, get_args

from sq_perception.learning.choices import Framing

if TYPE_CHECKING:
    import numpy as np

SPLITS = ("train", "test")

_MOST_PIXELS = 4096
_MOST_BODIES = 100_000_000
_LARGEST_SHARD = 100_000
_MOST_SHARDS = 100_000


@dataclass(frozen=True)
class Settings:
    """Everything that fixes a set.

    Raises
    ------
    ValueError
        For a value outside its range.
    """

    framing: Framing = "cropped"
    pixels: int = 64
    bits: int = 16
    train: int = 150_000
    test: int = 20_000
    shard: int = 1000
    """Bodies in each shard but the last of a split."""
    seed: int = 1
    pinhole_share: float = 0.0
    """Share of the views that a pinhole camera sees, as in :class:`sq_perception.learning.dataset.ViewSource`."""

    def __post_init__(self) -> None:
        whole = {
            "pixels": (2, _MOST_PIXELS),
            "bits": (8, 16),
            "train": (0, _MOST_BODIES),
            "test": (0, _MOST_BODIES),
            "shard": (1, _LARGEST_SHARD),
            "seed": (0, 2**63 - 1),
        }
        for name, (low, high) in whole.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise ValueError(f"{name}: expected a whole number from {low} to {high}, got {value!r}")
        for split in SPLITS:
            if self.shards(split) > _MOST_SHARDS:
                raise ValueError(
                    f"shard: {self.count(split)} bodies make more than {_MOST_SHARDS} shards of {self.shard}"
                )
        if self.bits not in (8, 16):
            raise ValueError(f"bits: expected 8 or 16, got {self.bits}")
        if self.framing not in get_args(Framing):
            raise ValueError(f"framing: expected one of {', '.join(get_args(Framing))}, got {self.framing!r}")
        if isinstance(self.pinhole_share, bool) or not (
            isinstance(self.pinhole_share, (int, float)) and 0 <= self.pinhole_share <= 1
        ):
            raise ValueError(f"pinhole_share: expected a number from 0 to 1, got {self.pinhole_share!r}")
        if self.framing == "full" and self.pinhole_share:
            raise ValueError("pinhole_share: a full frame is orthographic")

    @property
    def dtype(self) -> type[np.unsignedinteger]:
        import numpy as np

        return np.uint8 if self.bits == 8 else np.uint16

    def count(self, split: str) -> int:
        """Bodies in a split."""
        return self.train if split == "train" else self.test

    def shards(self, split: str) -> int:
        """Shards of a split."""
        return -(-self.count(split) // self.shard)

    def bodies_in(self, split: str, shard: int) -> int:
        """Bodies in one shard."""
        return min(self.shard, self.count(split) - shard * self.shard)

    def seed_of(self, split: str, shard: int) -> list[int]:
        """What the generator of one shard starts from."""
        return [self.seed, SPLITS.index(split), shard]

    def values(self, grey: np.ndarray) -> np.ndarray:
        """Grey levels as the float32 input of a network; see :mod:`sq_perception.learning.fixed_set`."""
        return self._table[grey]

    @cached_property
    def _table(self) -> np.ndarray:
        """The value of every grey level, float32."""
        import numpy as np

        levels = np.arange(2**self.bits)
        centred = levels + 0.5 * (levels > 0) if self.framing == "full" else levels
        return (centred / (2**self.bits - 1)).astype(np.float32)
