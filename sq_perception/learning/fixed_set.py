"""Fixed sets of training and test images on disk: the thesis' way, beside the drawing on the fly of `dataset`.

A set is a folder of shards and a manifest.  Bodies follow the thesis' protocol
(:mod:`sq_perception.simulation.scenes`).

| framing | image | value of a pixel from its grey level v | bodies in |
| --- | --- | --- | --- |
| full | the cube, :mod:`sq_perception.imaging.unit_cube` | (v + 1/2) / (2^bits - 1) | the cube frame |
| cropped | :func:`sq_perception.simulation.view_rendering.render_views` | v / (2^bits - 1) | the frame of the view |

In both 0 is background, and a value is the z of what is seen.  Full frames of 8 bit and 256 x 256 pixels are the
thesis'.  The depths of a view lie between its grey levels; hence 16 bit there by default, half a level off at most.

Files
-----
``manifest.json`` names the settings and, for each shard, its number of bodies, seed, size and SHA-256.  It is rewritten
after every shard, so that a killed generation goes on where it stopped.  ``train-00000.safetensors`` and so on hold

    image   uint8 (bytes,)      one PNG after the other
    offset  int64 (n + 1,)      image k is bytes offset[k] to offset[k + 1]
    body    float32 (n, 12)     a1 a2 a3 e1 e2 t1 t2 t3 qx qy qz qw

Images are PNGs within one tensor because safetensors does not compress: a full frame takes 3.0 kB instead of 65.5,
the thesis' 170 000 images 0.5 GB instead of 11, and decoding one 0.2 ms; a view of 64 x 64 and 16 bit takes 2.0 kB
instead of 8.2.

The random numbers of a shard come from [seed, split, shard], train being split 0 and test 1: shards are independent and
any of them can be made again, equal to the bit with the same processor and versions of the libraries.

This module reads them; :mod:`sq_perception.learning.fixed_set_writer` makes them.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from safetensors import SafetensorError, safe_open

from sq_perception.geometry.superquadric import FLAT_LENGTH, Superquadric
from sq_perception.learning import dihedral
from sq_perception.learning.fixed_set_settings import SPLITS, Settings

FORMAT = "sq_perception.fixed_set"
VERSION = 1
MANIFEST = "manifest.json"

_LARGEST_MANIFEST = 1 << 26
_PNG_HEAD = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"
_PNG_HEAD_BYTES = 29
_CHUNK = 1 << 20


class FixedSetError(ValueError):
    """A set that is missing, unfinished, damaged or of another kind; the message says which."""


def shard_name(split: str, shard: int) -> str:
    """The file of one shard."""
    return f"{split}-{shard:05d}.safetensors"


def read_manifest(folder: Path) -> tuple[Settings, dict[str, dict[str, Any]]]:
    """Settings and the finished shards; everything in them is of the right type and in its range."""
    path = folder / MANIFEST
    try:
        with path.open("rb") as file:
            content = file.read(_LARGEST_MANIFEST + 1)
        if len(content) > _LARGEST_MANIFEST:
            raise ValueError("too large for a manifest")
        document = json.loads(content)
    except OSError as error:
        raise FixedSetError(f"{folder}: no fixed set, there is no readable {MANIFEST} ({error})") from error
    except (ValueError, RecursionError) as error:
        raise FixedSetError(f"{path}: damaged: {error}") from error
    found = (document.get("format"), document.get("version")) if isinstance(document, dict) else (None, None)
    if found != (FORMAT, VERSION):
        raise FixedSetError(f"{path}: expected format {FORMAT}, version {VERSION}, got {found[0]!r}, {found[1]!r}")
    try:
        settings = Settings(**document["settings"])
    except (KeyError, TypeError, ValueError) as error:
        raise FixedSetError(f"{path}: damaged settings: {error}") from error
    shards = document.get("shards")
    if not isinstance(shards, dict):
        raise FixedSetError(f"{path}: damaged, expected a list of shards")
    for split in SPLITS:
        for shard in range(settings.shards(split)):
            name = shard_name(split, shard)
            if name in shards and not _is_entry(shards[name], settings, split, shard):
                raise FixedSetError(f"{path}: damaged, the entry of {name} is none of a shard")
    return settings, shards


def _is_entry(entry: Any, settings: Settings, split: str, shard: int) -> bool:
    return (
        isinstance(entry, dict)
        and entry.get("bodies") == settings.bodies_in(split, shard)
        and entry.get("seed") == settings.seed_of(split, shard)
        and isinstance(entry.get("bytes"), int)
        and isinstance(entry.get("sha256"), str)
    )


def sha256(path: Path) -> str:
    """Checksum of a file, in hexadecimal digits."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        for block in iter(partial(file.read, _CHUNK), b""):
            digest.update(block)
    return digest.hexdigest()


def check_file(path: Path, entry: dict[str, Any]) -> None:
    """Raise FixedSetError unless a shard is the one that its entry in the manifest describes."""
    try:
        size = path.stat().st_size
        if size != entry["bytes"]:
            raise FixedSetError(f"{path}: damaged, {size} bytes instead of {entry['bytes']}")
        if sha256(path) != entry["sha256"]:
            raise FixedSetError(f"{path}: damaged, its checksum is not the one of the manifest")
    except OSError as error:
        raise FixedSetError(f"{path}: cannot be read: {error}") from error


def verify(folder: Path | str, progress: Callable[[int], None] | None = None) -> list[str]:
    """What is wrong with a set, one sentence a shard; empty if nothing is.

    Raises
    ------
    FixedSetError
        If there is no readable manifest.
    """
    folder = Path(folder)
    settings, entries = read_manifest(folder)
    complaints = []
    for split in SPLITS:
        for shard in range(settings.shards(split)):
            name = shard_name(split, shard)
            if name not in entries:
                complaints.append(f"{folder / name}: not made yet")
                continue
            try:
                check_file(folder / name, entries[name])
            except FixedSetError as error:
                complaints.append(str(error))
            if progress is not None:
                progress(settings.bodies_in(split, shard))
    return complaints


class _Shard:
    """An open shard, its images mapped from the file."""

    def __init__(self, path: Path, settings: Settings, count: int) -> None:
        self._path, self._settings = path, settings
        try:
            self._file = safe_open(str(path), framework="numpy")
            slices = {name: self._file.get_slice(name) for name in ("image", "offset", "body")}
            found = {name: (each.get_dtype(), list(each.get_shape())) for name, each in slices.items()}
            total = found["image"][1]
            wanted = {"image": ("U8", total[:1]), "offset": ("I64", [count + 1]), "body": ("F32", [count, FLAT_LENGTH])}
            if found != wanted:
                raise FixedSetError(f"{path}: expected {wanted}, got {found}")
            self._images = slices["image"]
            self._offset = self._file.get_tensor("offset")
            self._flat = self._file.get_tensor("body").astype(float)
        except (SafetensorError, OSError) as error:
            raise FixedSetError(f"{path}: not a readable shard: {error}") from error
        ends = self._offset[0] == 0 and self._offset[-1] == total[0]
        if not ends or (self._offset < 0).any() or (np.diff(self._offset) < _PNG_HEAD_BYTES).any():
            raise FixedSetError(f"{path}: the offsets do not divide the images")
        try:
            Superquadric.from_flat(self._flat)
        except ValueError as error:
            raise FixedSetError(f"{path}: holds no bodies: {error}") from error

    def read(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Grey image (p, p) and body (12,)."""
        encoded = self._images[int(self._offset[k]) : int(self._offset[k + 1])]
        side, bits = self._settings.pixels, self._settings.bits
        # The decoder allocates what the header of the PNG asks for.
        expected = _PNG_HEAD + struct.pack(">IIBB", side, side, bits, 0)
        image = None
        if encoded[: len(expected)].tobytes() == expected:
            try:
                image = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED)
            except cv2.error as error:
                raise FixedSetError(f"{self._path}: image {k} cannot be decoded: {error.err}") from error
        if image is None or image.shape != (side, side) or image.dtype != self._settings.dtype:
            raise FixedSetError(f"{self._path}: image {k} is no grey PNG of {side} x {side} pixels and {bits} bit")
        return image, self._flat[k]


class FixedSet:
    """One split of a set, read at random; a shard's checksum is checked when it is first touched.

    Parameters
    ----------
    folder
        Of the manifest.
    split : str
        "train" or "test".
    cache : int
        Shards kept open.  Each costs its bodies (100 kB for 1000 of them); images stay in the file, mapped.

    Raises
    ------
    FixedSetError
        If the set is missing, unfinished or damaged: here, or when a damaged shard is read.
    """

    def __init__(self, folder: Path | str, split: str, cache: int = 256) -> None:
        if split not in SPLITS:
            raise ValueError(f"split: expected one of {', '.join(SPLITS)}, got {split!r}")
        if cache < 1:
            raise ValueError(f"cache: expected at least 1 shard, got {cache}")
        self._folder, self._split, self._cache = Path(folder), split, cache
        self.settings, entries = read_manifest(self._folder)
        if any(shard_name(split, k) not in entries for k in range(self.settings.shards(split))):
            raise FixedSetError(f"{folder}: {split} is not finished; run the generation again, it goes on")
        self._entries = entries
        self._checked: set[int] = set()
        self._open: OrderedDict[int, _Shard] = OrderedDict()

    def __len__(self) -> int:
        return self.settings.count(self._split)

    def batch(self, indices: Sequence[int] | np.ndarray) -> tuple[np.ndarray, Superquadric]:
        """Images float32 (n, p, p), as a network takes them, and bodies (n,) in the frame of the images.

        Raises
        ------
        IndexError
            For an index outside of 0 to len - 1.
        FixedSetError
            If a shard is damaged.
        """
        chosen = np.asarray(indices)
        if chosen.ndim != 1 or (chosen.size and chosen.dtype.kind not in "iu"):
            raise ValueError(f"indices: expected integers (n,), got {chosen.dtype} {chosen.shape}")
        if chosen.size and not 0 <= chosen.min() <= chosen.max() < len(self):
            raise IndexError(f"expected indices from 0 to {len(self) - 1}, got {chosen.min()} to {chosen.max()}")
        pixels = self.settings.pixels
        grey = np.empty((chosen.size, pixels, pixels), self.settings.dtype)
        flat = np.empty((chosen.size, FLAT_LENGTH))
        # Shard by shard, so that a cache smaller than the set opens each but once a batch.
        for k in np.argsort(chosen, kind="stable"):
            shard, within = divmod(int(chosen[k]), self.settings.shard)
            grey[k], flat[k] = self._shard(shard).read(within)
        return self.settings.values(grey), Superquadric.from_flat(flat)

    def _shard(self, number: int) -> _Shard:
        if number in self._open:
            self._open.move_to_end(number)
            return self._open[number]
        name = shard_name(self._split, number)
        if number not in self._checked:
            check_file(self._folder / name, self._entries[name])
            self._checked.add(number)
        while len(self._open) >= self._cache:
            self._open.popitem(last=False)
        count = self.settings.bodies_in(self._split, number)
        self._open[number] = _Shard(self._folder / name, self.settings, count)
        return self._open[number]


class ShuffledBatches:
    """Batches of a fixed set, every image once a round, in a new order each round; stands where a ViewPool stands.

    With ``positions`` each image comes in a random one of its 8 positions (:mod:`sq_perception.learning.dihedral`).
    """

    def __init__(self, fixed_set: FixedSet, rng: np.random.Generator, positions: bool = True) -> None:
        if len(fixed_set) == 0:
            raise ValueError("the set is empty: there is nothing to draw batches from")
        self._set, self._rng, self._positions = fixed_set, rng, positions
        self._order = np.empty(0, dtype=np.int64)

    def batch(self, count: int) -> tuple[np.ndarray, Superquadric]:
        """Images (count, p, p) and bodies (count,) in their frame."""
        while len(self._order) < count:
            self._order = np.concatenate([self._order, self._rng.permutation(len(self._set))])
        chosen, self._order = self._order[:count], self._order[count:]
        images, bodies = self._set.batch(chosen)
        if not self._positions:
            return images, bodies
        turns, mirror = self._rng.integers(4, size=count), self._rng.random(count) < 0.5
        return dihedral.moved_images(images, turns, mirror), dihedral.moved_bodies(bodies, turns, mirror)
