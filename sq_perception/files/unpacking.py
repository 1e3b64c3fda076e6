"""Arrays and images out of files from outside, whose size is known before anything is unpacked.

A file of a megabyte can claim, or unpack to, any number of gigabytes.  So the size that it claims is read first, must
be bounded, and for arrays must be what the file really holds; only then is memory taken.

Pillow reads the size and the kind in an image's header without unpacking it.

Reference: https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html (an NPZ is a ZIP of such arrays).
"""

from __future__ import annotations

import io
import math
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import IO

import cv2
import numpy as np

MOST_PIXELS = 2**25
"""Pixels of an image, or numbers of an array: no depth camera has more."""
MOST_BYTES = 2**28
"""Bytes of a packed file."""
_PNG = b"\x89PNG\r\n\x1a\n"


class UnpackingError(ValueError):
    """A file that cannot be unpacked, or would become too large; the message names what was expected."""


def npz_arrays(path: Path, names: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an NPZ archive that have these names, by name; all of them by default.

    Raises
    ------
    UnpackingError
        If it is no readable archive of plain arrays, or one of them is larger than MOST_PIXELS numbers.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            held = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            return {name: _array(archive, held[name]) for name in (held if names is None else names) if name in held}
    except Exception as error:  # whatever damaged files lead to: NumPy reads their headers as Python of old
        raise UnpackingError(f"not a readable NPZ archive: {error}") from error


def npy_array(path: Path) -> np.ndarray:
    """The array of an NPY file.

    Raises
    ------
    UnpackingError
        If it is no plain array, or larger than MOST_PIXELS numbers.
    """
    try:
        with path.open("rb") as file:
            return _numbers(file, path.stat().st_size)
    except Exception as error:  # likewise
        raise UnpackingError(f"not a readable NPY file: {error}") from error


def grey_image(path: Path, of_indices: bool = False) -> np.ndarray:
    """A grey PNG, BMP or TIFF (height, width), of any type of number; three equal channels are grey too.

    ``of_indices`` takes a palette's indices in place of its colours: so label images are stored.

    Raises
    ------
    UnpackingError
        If it cannot be read, is no grey image, or has more than MOST_PIXELS pixels.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise UnpackingError(f"expected at most {MOST_BYTES} bytes, got {path.stat().st_size}")
        encoded = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise UnpackingError(f"not a readable image: {error}") from error
    width, height, has_palette = _image_header(encoded)
    if not (width >= 1 and height >= 1 and width * height <= MOST_PIXELS):
        raise UnpackingError(f"not a readable image: expected 1 to {MOST_PIXELS} pixels, got {width} x {height}")
    if has_palette and of_indices:
        return _palette_indices(encoded)
    try:
        image = cv2.imdecode(_plain_png(encoded) if encoded[:8].tobytes() == _PNG else encoded, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise UnpackingError(f"not a readable image: {error.err}") from error
    if image is None:
        raise UnpackingError("not a readable image")
    if image.ndim == 3:
        first, *others = np.moveaxis(image[..., :3], -1, 0)
        if not all(np.array_equal(first, other, equal_nan=True) for other in others):
            raise UnpackingError(
                "expected a grey image, got a palette of colours: save its indices as grey values"
                if has_palette
                else "expected a grey image, got a colour image: is it the camera's picture, or depth drawn in colours?"
            )
        image = np.ascontiguousarray(first)
    return image


def exr_image(path: Path) -> np.ndarray:
    """The depth in an EXR of floats, (height, width): its channel Z, V or Y, or what all its channels hold.

    Raises
    ------
    UnpackingError
        If OpenEXR is not installed, or the file holds no such image, or more than MOST_PIXELS numbers.
    """
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


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(info) as file:
        return _numbers(file, info.file_size, f"{info.filename}: ")


def _numbers(file: IO[bytes], file_size: int, where: str = "") -> np.ndarray:
    """The array of an open NPY file of so many bytes."""
    version = np.lib.format.read_magic(file)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, is_fortran, dtype = header(file)
    if dtype.hasobject:
        raise UnpackingError(f"{where}expected numbers, got objects")
    count = math.prod(shape)
    if count > MOST_PIXELS or count * dtype.itemsize > 16 * MOST_PIXELS:
        raise UnpackingError(f"{where}expected at most {MOST_PIXELS} numbers, got {count}")
    size = count * dtype.itemsize
    if file_size != file.tell() + size:
        raise UnpackingError(f"{where}expected {size} bytes of numbers, got {file_size - file.tell()}")
    return np.frombuffer(file.read(size), dtype).reshape(shape, order="F" if is_fortran else "C").copy()


def _plain_png(encoded: np.ndarray) -> np.ndarray:
    """A PNG's pixels alone, without profiles and texts: its decoder writes on the standard error what it finds there.

    Raises UnpackingError where a part is missing or damaged, for the same reason.
    """
    data, at, kept = encoded.tobytes(), len(_PNG), [_PNG]
    while at + 12 <= len(data):
        length, name = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length
        if end > len(data) or zlib.crc32(data[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            break
        if name in (b"IHDR", b"PLTE", b"IDAT", b"IEND"):
            kept.append(data[at:end])
        if name == b"IEND":
            return np.frombuffer(b"".join(kept), np.uint8)
        at = end
    raise UnpackingError("not a readable image: a part of the PNG is missing or damaged")


def _palette_indices(encoded: np.ndarray) -> np.ndarray:
    from PIL import Image

    try:
        with Image.open(io.BytesIO(encoded.tobytes()), formats=("PNG", "BMP", "TIFF")) as image:
            return np.asarray(image.getchannel("P") if image.mode == "PA" else image)
    except Exception as error:  # whatever damaged files lead to
        raise UnpackingError(f"not a readable image: {error}") from error


def _image_header(encoded: np.ndarray) -> tuple[int, int, bool]:
    """Width, height, and whether the pixels are indices of colours."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of large and damaged ones: they are handled here
            with Image.open(io.BytesIO(encoded.tobytes()), formats=("PNG", "BMP", "TIFF")) as image:
                return *image.size, image.mode in ("P", "PA")
    except Exception as error:  # whatever damaged headers lead to
        kinds = "PNG, BMP or TIFF of 8 or 16 bit, or TIFF of 32 bit floats"
        raise UnpackingError(f"not a readable image: expected {kinds}, at most {MOST_PIXELS} pixels") from error
