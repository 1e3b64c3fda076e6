"""Makes the fixed sets of :mod:`sq_perception.learning.fixed_set`, and goes on with those that were interrupted.

Rendering runs on numba's threads, encoding on as many of its own.  A shard is written beside its place and renamed, and
entered in the manifest only then: whatever is killed, and whenever, costs one shard.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
from safetensors.numpy import save

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.learning import dataset
from sq_perception.learning.fixed_set import (
    FORMAT,
    MANIFEST,
    VERSION,
    FixedSetError,
    check_file,
    read_manifest,
    shard_name,
)
from sq_perception.learning.fixed_set_settings import SPLITS, Settings
from sq_perception.simulation.scenes import thesis_bodies

_PNG_LEVEL = 6


def draw(settings: Settings, split: str, shard: int) -> tuple[np.ndarray, np.ndarray]:
    """Grey images (n, p, p) of one shard, and the bodies (n, 12) float32 in the frame of the images."""
    rng = np.random.default_rng(settings.seed_of(split, shard))
    count = settings.bodies_in(split, shard)
    if settings.framing == "cropped":
        views, seen = dataset.draw_views(count, rng, dataset.ViewSource(settings.pixels, settings.pinhole_share))
        # A view's nearest surface is at least 1/255: nothing seen is rounded to background.
        return np.round(views * np.float32(2**settings.bits - 1)).astype(settings.dtype), _flat(seen)
    # Rendered as written, in single precision: whoever reads a body and renders it gets the image to the bit.
    flat = _flat(thesis_bodies(count, rng))
    return dataset.grey_frames(Superquadric.from_flat(flat), settings.pixels, settings.dtype), flat


def _flat(bodies: Superquadric) -> np.ndarray:
    return np.ascontiguousarray(bodies.to_flat(), dtype=np.float32)


def generate(
    folder: Path | str, settings: Settings, threads: int = 0, progress: Callable[[int], None] | None = None
) -> None:
    """Make a set, or finish one that was interrupted.

    Parameters
    ----------
    folder
        Made if it is missing.  Shards of the same settings whose checksums are right are kept.
    threads
        For rendering and for encoding; 0 takes as many as numba is allowed.
    progress
        Called with the number of bodies of every finished shard.

    Raises
    ------
    FixedSetError
        If the folder holds a set of other settings, shards of none, or a manifest that cannot be read.
    ValueError
        For more threads than numba was given.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    most = most_threads()
    if not 0 <= threads <= most:
        raise ValueError(f"threads: expected 0 to {most} (NUMBA_NUM_THREADS), got {threads}")
    done: dict[str, dict[str, Any]] = {}
    if (folder / MANIFEST).exists():
        theirs, done = read_manifest(folder)
        if theirs != settings:
            raise FixedSetError(f"{folder}: holds a set of other settings, {asdict(theirs)}, not {asdict(settings)}")
    elif any(folder.glob("*.safetensors")):
        raise FixedSetError(f"{folder}: holds .safetensors files but no {MANIFEST}; choose another folder")
    _write_manifest(folder, settings, done)
    before = numba.get_num_threads()
    numba.set_num_threads(threads or most)
    try:
        with ThreadPoolExecutor(threads or most, thread_name_prefix="encode") as pool:
            for split in SPLITS:
                for shard in range(settings.shards(split)):
                    name = shard_name(split, shard)
                    if name not in done or not _is_intact(folder / name, done[name]):
                        done[name] = _write_shard(folder / name, settings, split, shard, pool)
                        _write_manifest(folder, settings, done)
                    if progress is not None:
                        progress(settings.bodies_in(split, shard))
    finally:
        numba.set_num_threads(before)


def _is_intact(path: Path, entry: dict[str, Any]) -> bool:
    try:
        check_file(path, entry)
    except FixedSetError:
        return False
    return True


def most_threads() -> int:
    """Threads that numba was given."""
    return int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


def _write_shard(path: Path, settings: Settings, split: str, shard: int, pool: ThreadPoolExecutor) -> dict[str, Any]:
    images, flat = draw(settings, split, shard)
    encoded = list(pool.map(_encoded, images))
    offset = np.concatenate([[0], np.cumsum([len(each) for each in encoded])]).astype(np.int64)
    about = {"format": FORMAT, "version": VERSION, "split": split, "shard": shard, "settings": asdict(settings)}
    # One entry of sorted JSON: safetensors writes several entries in no fixed order.
    content = save(
        {"image": np.concatenate(encoded), "offset": offset, "body": flat},
        {"fixed_set": json.dumps(about, sort_keys=True)},
    )
    _replace(path, content)
    return {
        "bodies": len(flat),
        "seed": settings.seed_of(split, shard),
        "bytes": len(content),
        "sha256": hashlib.sha256(content).hexdigest(),
    }


def _encoded(image: np.ndarray) -> np.ndarray:
    good, encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
    if not good:
        raise RuntimeError("OpenCV could not encode a PNG")
    return encoded.ravel()


def _write_manifest(folder: Path, settings: Settings, done: dict[str, dict[str, Any]]) -> None:
    document = {"format": FORMAT, "version": VERSION, "settings": asdict(settings), "shards": done}
    _replace(folder / MANIFEST, (json.dumps(document, indent=1) + "\n").encode())


def _replace(path: Path, content: bytes) -> None:
    """Whole or not at all."""
    unfinished = path.with_name(path.name + ".partial")
    unfinished.write_bytes(content)
    unfinished.replace(path)
