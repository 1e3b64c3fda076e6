"""Fixed sets of training and test images on disk: the thesis' way, beside the drawing on the fly of `dataset`.

A set is a folder of shards and a manifest.  Bodies follow the thesis' protocol
(:mod:`sq_perception.simulation.scenes`).

| framing | image | bits | value of a pixel from its grey level v | bodies in |
| --- | --- | --- | --- | --- |
| full | the cube, :mod:`sq_perception.imaging.unit_cube` | 8 | (v + 1/2) / 255 | the cube frame |
| cropped | :func:`sq_perception.simulation.view_rendering.render_views` | 16 | v / 65535 | the frame of the view |

In both 0 is background, and a value is the z of what is seen.  Full frames of 256 x 256 pixels are the thesis'.  The
depths of a view lie between 8 bit grey levels; hence 16 bit there, half a level off at most.

Files
-----
``manifest.json`` names the settings and the SHA-256 of each shard.  It is rewritten after every shard, so that a killed
generation goes on where it stopped.  ``train-00000.safetensors`` and so on hold SHARD bodies each:

    image   uint8 (bytes,)      one PNG after the other
    offset  int64 (n + 1,)      image k is bytes offset[k] to offset[k + 1]
    body    float32 (n, 12)     a1 a2 a3 e1 e2 t1 t2 t3 qx qy qz qw

Images are PNGs within one tensor because safetensors does not compress: a full frame takes 3.0 kB instead of 65.5,
the thesis' 170 000 images 0.5 GB instead of 11, and decoding one 0.2 ms; a view of 64 x 64 and 16 bit takes 2.0 kB
instead of 8.2.

The random numbers of a shard come from [seed, split, shard], train being split 0 and test 1: shards are independent and
any of them can be made again, equal to the bit with the same processor and versions of the libraries.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from sq_perception.files import output_file
from sq_perception.geometry.superquadric import FLAT_LENGTH, Superquadric
from sq_perception.learning import dataset
from sq_perception.learning.choices import Framing
from sq_perception.simulation.scenes import thesis_bodies

FORMAT, VERSION = "sq_perception.fixed_set", 2
MANIFEST = "manifest.json"
SPLITS = ("train", "test")
SHARD = 1000
"""Bodies in each shard but the last of a split."""
_PNG_LEVEL = 6


class FixedSetError(ValueError):
    """A set that is missing, unfinished, damaged or of another kind; the message names which."""


@dataclass(frozen=True)
class Settings:
    """Everything that fixes a set; raises ValueError for a value outside its range."""

    framing: Framing
    pixels: int
    train: int
    test: int
    seed: int

    def __post_init__(self) -> None:
        if self.framing not in get_args(Framing):
            raise ValueError(f"framing: expected one of {', '.join(get_args(Framing))}, got {self.framing!r}")
        for name, least in (("pixels", 2), ("train", 0), ("test", 0), ("seed", 0)):
            value = getattr(self, name)
            if type(value) is not int or value < least:
                raise ValueError(f"{name}: expected a whole number of at least {least}, got {value!r}")

    @property
    def dtype(self) -> type[np.unsignedinteger]:
        """The type of the grey levels."""
        return np.uint8 if self.framing == "full" else np.uint16

    def shards(self, split: str) -> dict[str, int]:
        """The files of a split, and how many bodies each holds."""
        count = self.train if split == "train" else self.test
        return {f"{split}-{k:05d}.safetensors": min(SHARD, count - k * SHARD) for k in range(-(-count // SHARD))}

    def values(self, grey: np.ndarray) -> np.ndarray:
        """Grey levels as the float32 input of a network; see the module."""
        levels = np.arange(np.iinfo(self.dtype).max + 1)
        centred = levels + 0.5 * (levels > 0) if self.framing == "full" else levels
        return (centred / levels[-1]).astype(np.float32)[grey]


def draw(settings: Settings, split: str, shard: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Grey images (n, p, p) of the first bodies of a shard, and these (n, 12), float32 in the frame of the images."""
    rng = np.random.default_rng([settings.seed, SPLITS.index(split), shard])
    if settings.framing == "cropped":
        views, seen = dataset.draw_views(count, rng, dataset.ViewSource(settings.pixels))
        # A view's nearest surface is at least 1/255: nothing seen is rounded to background.
        return np.round(views * np.float32(np.iinfo(settings.dtype).max)).astype(settings.dtype), _flat(seen)
    # Rendered as written, in single precision: whoever reads a body and renders it gets the image to the bit.
    flat = _flat(thesis_bodies(count, rng))
    return dataset.grey_frames(Superquadric.from_flat(flat), settings.pixels, settings.dtype), flat


def generate(folder: Path, settings: Settings, progress: Callable[[int], None] = lambda bodies: None) -> None:
    """Make a set, or finish and mend one; ``progress`` is called with the bodies of every finished shard.

    Raises
    ------
    FixedSetError
        If the folder holds a set of other settings, shards of none, or a manifest that cannot be read.
    """
    folder.mkdir(parents=True, exist_ok=True)
    done: dict[str, str] = {}
    if (folder / MANIFEST).exists():
        theirs, done = read_manifest(folder)
        if theirs != settings:
            raise FixedSetError(f"{folder}: holds a set of other settings, {theirs}, not {settings}")
    elif any(folder.glob("*.safetensors")):
        raise FixedSetError(f"{folder}: holds .safetensors files but no {MANIFEST}; choose another folder")
    _write_manifest(folder, settings, done)
    for split in SPLITS:
        for shard, (name, count) in enumerate(settings.shards(split).items()):
            if name not in done or _fault(folder / name, done[name]):
                content = _pack(*draw(settings, split, shard, count))
                output_file.write(folder / name, content)
                done[name] = hashlib.sha256(content).hexdigest()
                _write_manifest(folder, settings, done)
            progress(count)


def read_manifest(folder: Path) -> tuple[Settings, dict[str, str]]:
    """Settings, and the SHA-256 of the finished shards."""
    path = folder / MANIFEST
    try:
        document = json.loads(path.read_bytes())
        if (document["format"], document["version"]) != (FORMAT, VERSION):
            raise ValueError(f"expected {FORMAT}, version {VERSION}: make it again")
        return Settings(**document["settings"]), dict(document["shards"])
    except OSError as error:
        raise FixedSetError(f"{folder}: no fixed set, there is no readable {MANIFEST} ({error})") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise FixedSetError(f"{path}: not the manifest of a fixed set: {error}") from error


class FixedSet:
    """One split of a set, read at random; a shard's checksum is checked when it is first touched.

    A shard that was touched stays open: its bodies (100 kB) in memory, its images mapped from the file.

    Raises
    ------
    FixedSetError
        If the set is missing, unfinished or damaged: here, or when a damaged shard is read.
    """

    def __init__(self, folder: Path, split: str) -> None:
        if split not in SPLITS:
            raise ValueError(f"split: expected one of {', '.join(SPLITS)}, got {split!r}")
        self._folder = folder
        self.settings, self._done = read_manifest(folder)
        self._shards = self.settings.shards(split)
        if not self._shards.keys() <= self._done.keys():
            raise FixedSetError(f"{folder}: {split} is not finished; run the generation again, it goes on")
        self._open: dict[str, tuple[Any, np.ndarray, np.ndarray]] = {}

    def __len__(self) -> int:
        return sum(self._shards.values())

    def batch(self, indices: Sequence[int] | np.ndarray) -> tuple[np.ndarray, Superquadric]:
        """Images float32 (n, p, p), as a network takes them, and bodies (n,) in the frame of the images.

        Raises
        ------
        IndexError
            For an index outside of 0 to len - 1.
        FixedSetError
            If a shard is damaged.
        """
        chosen, pixels = np.asarray(indices, dtype=int), self.settings.pixels
        if chosen.size and not 0 <= chosen.min() <= chosen.max() < len(self):
            raise IndexError(f"expected indices from 0 to {len(self) - 1}, got {chosen.min()} to {chosen.max()}")
        grey = np.empty((chosen.size, pixels, pixels), self.settings.dtype)
        flat = np.empty((chosen.size, FLAT_LENGTH))
        names = list(self._shards)
        for k, index in enumerate(chosen):
            name, within = names[index // SHARD], int(index % SHARD)
            images, offset, bodies = self._open_shard(name)
            grey[k] = cv2.imdecode(images[int(offset[within]) : int(offset[within + 1])], cv2.IMREAD_UNCHANGED)
            flat[k] = bodies[within]
        return self.settings.values(grey), Superquadric.from_flat(flat)

    def _open_shard(self, name: str) -> tuple[Any, np.ndarray, np.ndarray]:
        """Images (bytes,), offsets and bodies of a shard."""
        if name not in self._open:
            path = self._folder / name
            if fault := _fault(path, self._done[name]):
                raise FixedSetError(fault)
            try:
                file = safe_open(str(path), framework="numpy")
                self._open[name] = file.get_slice("image"), file.get_tensor("offset"), file.get_tensor("body")
            except (SafetensorError, OSError) as error:
                raise FixedSetError(f"{path}: not a readable shard: {error}") from error
        return self._open[name]


class ShuffledBatches:
    """Batches of a fixed set, every image once a round, in a new order each round; stands where a ViewPool stands.

    Each image comes in a random one of its 8 positions (:mod:`sq_perception.learning.dataset`).
    """

    def __init__(self, fixed_set: FixedSet, rng: np.random.Generator) -> None:
        if len(fixed_set) == 0:
            raise ValueError("the set is empty: there is nothing to draw batches from")
        self._set, self._rng = fixed_set, rng
        self._order = np.empty(0, dtype=np.int64)

    def batch(self, count: int) -> tuple[np.ndarray, Superquadric]:
        """Images (count, p, p) and bodies (count,) in their frame."""
        while len(self._order) < count:
            self._order = np.concatenate([self._order, self._rng.permutation(len(self._set))])
        chosen, self._order = self._order[:count], self._order[count:]
        return dataset.turn_at_random(*self._set.batch(chosen), self._rng)


def _write_manifest(folder: Path, settings: Settings, done: dict[str, str]) -> None:
    document = {"format": FORMAT, "version": VERSION, "settings": asdict(settings), "shards": done}
    output_file.write(folder / MANIFEST, (json.dumps(document, indent=1) + "\n").encode())


def _flat(bodies: Superquadric) -> np.ndarray:
    return np.ascontiguousarray(bodies.to_flat(), dtype=np.float32)


def _pack(images: np.ndarray, flat: np.ndarray) -> bytes:
    with ThreadPoolExecutor(thread_name_prefix="encode") as pool:
        encode = partial(cv2.imencode, ".png", params=[cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
        packed = [encoded.ravel() for _, encoded in pool.map(encode, images)]
    offset = np.concatenate([[0], np.cumsum([len(image) for image in packed])]).astype(np.int64)
    return save({"image": np.concatenate(packed), "offset": offset, "body": flat})


def _fault(path: Path, checksum: str) -> str:
    """What is wrong with a shard; empty if nothing."""
    try:
        found = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        return f"{path}: cannot be read: {error}"
    return "" if found == checksum else f"{path}: damaged, its checksum is not the one of the manifest"
