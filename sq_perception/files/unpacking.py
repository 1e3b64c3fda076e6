"""Arrays, images and YAML out of files from outside, bounded before memory is taken: a megabyte can claim any size.

Nothing in a file is executed: no pickle, and YAML of plain data alone.
"""

from __future__ import annotations

import glob
import math
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

MOST_PIXELS = 2**25  # pixels of an image, or numbers of an array: no depth camera has more
MOST_BYTES = 16 * MOST_PIXELS  # bytes of a file
LONGEST_TEXT = 2**20  # bytes of a YAML, JSON or text
_KINDS = ("PNG", "BMP", "TIFF")


class UnpackingError(ValueError):
    """A file that cannot be unpacked, or would become too large; the message names what was expected."""


def npz_arrays(path: Path, names: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of an NPZ archive that have these names, by name; all of them by default."""
    try:
        found = {}
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            sizes = {info.filename.removesuffix(".npy"): info.file_size for info in archive.zip.infolist()}
            for name in sizes if names is None else names:
                if name in sizes:
                    if sizes[name] > MOST_BYTES:
                        raise UnpackingError(f"{name}: expected at most {MOST_BYTES} bytes, got {sizes[name]}")
                    found[name] = _check_count(archive[name], f"{name}: ")
        return found
    except Exception as error:  # whatever damaged files lead to: NumPy reads their headers as Python of old
        raise UnpackingError(f"not a readable NPZ archive: {error}") from error


def npy_array(path: Path) -> np.ndarray:
    """Return the array of an NPY file."""
    try:
        return np.array(_check_count(np.load(path, mmap_mode="r", allow_pickle=False)))  # a map is as long as its file
    except Exception as error:  # likewise
        raise UnpackingError(f"not a readable NPY file: {error}") from error


def _check_count(array: np.ndarray, where: str = "") -> np.ndarray:
    if array.size > MOST_PIXELS:
        raise UnpackingError(f"{where}expected at most {MOST_PIXELS} numbers, got {array.size}")
    return array


def grey_image(path: Path, of_indices: bool = False) -> np.ndarray:
    """Read a grey PNG, BMP or TIFF (height, width), of any type of number; three equal channels are grey too.
    ``of_indices`` takes a palette's indices in place of its colours: so label images are stored."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of large and damaged ones: they are handled here
            with Image.open(path, formats=_KINDS) as image:
                image.verify()  # the check sums of a PNG
            with Image.open(path, formats=_KINDS) as image:
                if not 0 < math.prod(image.size) <= MOST_PIXELS:
                    raise ValueError(f"{image.width} x {image.height} pixels")
                mode, is_png = image.mode, image.format == "PNG"
                has_palette = mode in ("P", "PA")
                if has_palette and not of_indices:
                    pixels = np.asarray(image.convert("RGB"))
                else:
                    pixels = np.asarray(image.convert("L") if mode == "1" else image)
    except Exception as error:  # whatever damaged files lead to
        kinds = f"expected PNG, BMP or TIFF of 8 or 16 bit, or TIFF of 32 bit floats, 1 to {MOST_PIXELS} pixels"
        raise UnpackingError(f"not a readable image: {kinds}, got {error}") from error
    if mode in ("LA", "PA") and pixels.shape[-1] == 2:
        pixels = pixels[..., 0]
    if mode == "I" and is_png:  # as Pillow before 11.3 has those of 16 bit
        pixels = pixels.astype(np.uint16)
    if pixels.ndim == 2:
        return pixels
    first, *others = np.moveaxis(pixels[..., :3], -1, 0)
    if not all(np.array_equal(first, other) for other in others):
        raise UnpackingError(
            "expected a grey image, got a palette of colours: save its indices as grey values"
            if has_palette
            else "expected a grey image, got a colour image: is it the camera's picture, or depth drawn in colours?"
        )
    return np.ascontiguousarray(first)


def exr_image(path: Path) -> np.ndarray:
    """Read the depth (height, width) in an EXR of floats: its channel Z, V or Y, or what all its channels hold."""
    try:
        import OpenEXR
    except ImportError:
        raise UnpackingError("an EXR needs OpenEXR: pip install 'sq_perception[exr]'") from None
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            heads = [(part.header["dataWindow"], len(part.header["channels"])) for part in file.parts]
        count = sum(math.prod((int(side) + 1 for side in high - low), start=number) for (low, high), number in heads)
        if not 0 < count <= MOST_PIXELS:
            raise UnpackingError(f"expected 1 to {MOST_PIXELS} numbers, got {count}")
        with OpenEXR.File(str(path), separate_channels=True, num_threads=1) as file:
            found = {name.rpartition(".")[2]: channel.pixels for name, channel in file.channels().items()}
    except Exception as error:  # whatever damaged files lead to
        raise UnpackingError(f"not a readable EXR: {error}") from error
    channel, *others = [found[name] for name in ("Z", "V", "Y") if name in found][:1] or found.values()
    if channel.dtype.kind != "f" or not all(np.array_equal(channel, other, equal_nan=True) for other in others):
        raise UnpackingError(f"expected floats in a channel Z, V or Y, got {', '.join(found)}")
    return np.asarray(channel)


class _PlainLoader(yaml.SafeLoader):
    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise UnpackingError("expected plain data, got an alias (*)")  # a few bytes of them unfold endlessly
        return super().compose_node(parent, index)


def yaml_documents(data: bytes) -> list[Any]:
    """Return the documents of a YAML file's bytes."""
    if len(data) > LONGEST_TEXT:
        raise UnpackingError(f"expected at most {LONGEST_TEXT} bytes")
    try:
        return list(yaml.load_all(data.decode("utf-8"), _PlainLoader))
    except UnpackingError:
        raise
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise UnpackingError(f"not YAML: {' '.join(str(error).split()) or type(error).__name__}") from error


def read_yaml(path: Path) -> Any:
    """Return the one document of a YAML file; None if it is empty."""
    try:
        with path.open("rb") as file:
            documents = yaml_documents(file.read(LONGEST_TEXT + 1))
    except OSError as error:
        raise UnpackingError(str(error)) from error
    if len(documents) > 1:
        raise UnpackingError(f"expected one document, got {len(documents)}")
    return documents[0] if documents else None


def label_image(folder: Path, name: str) -> np.ndarray:
    """Read the instance masks of a frame as a label image, int32 (height, width), 0 for background.

    | in the folder | labels |
    | --- | --- |
    | ``NAME.png``, grey | its values |
    | ``NAME.png``, of a palette, as in PASCAL VOC and DAVIS | the indices of its colours |
    | ``NAME_000000.png``, ``NAME_000001.png`` ..., as in BOP's ``mask_visib`` | 1, 2, ...: a binary image each |
    """
    path = folder / f"{name}.png"
    if path.is_file():
        return grey_image(path, of_indices=True).astype(np.int32)
    found = folder.glob(f"{glob.escape(name)}_*.png")
    paths = sorted(each for each in found if each.stem.rpartition("_")[2].isdigit())
    if not paths:
        raise UnpackingError("no such mask")
    masks = [grey_image(each, of_indices=True) > 0 for each in paths]
    if len({mask.shape for mask in masks}) > 1:
        raise UnpackingError(f"expected masks of one size, got {sorted({mask.shape for mask in masks})}")
    labels = np.zeros(masks[0].shape, np.int32)
    for number, mask in enumerate(masks, 1):
        labels[mask] = number
    return labels
