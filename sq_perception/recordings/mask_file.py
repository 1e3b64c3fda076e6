"""Instance masks beside recorded frames, as label images: 0 is background.

| in the folder | labels |
| --- | --- |
| ``NAME.png``, grey | its values |
| ``NAME.png``, of a palette, as in PASCAL VOC and DAVIS | the indices of its colours |
| ``NAME_000000.png``, ``NAME_000001.png`` ..., as in BOP's ``mask_visib`` | 1, 2, ...: a binary image each |
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sq_perception.files.unpacking import UnpackingError, grey_image


def read(folder: Path, name: str) -> np.ndarray:
    """Read the label image of a frame, int32 (height, width).

    Raises
    ------
    ValueError
        If there is none, one is unreadable, or binary images of one frame differ in size.
    """
    path = folder / f"{name}.png"
    if path.is_file():
        return _image(path).astype(np.int32)
    paths = sorted(each for each in folder.glob(f"{_escape(name)}_*.png") if each.stem.rpartition("_")[2].isdigit())
    if not paths:
        raise ValueError(f"{path}: no such mask")
    masks = [_image(each) > 0 for each in paths]
    if len({mask.shape for mask in masks}) > 1:
        raise ValueError(f"{paths[0]}: expected masks of one size, got {sorted({mask.shape for mask in masks})}")
    labels = np.zeros(masks[0].shape, np.int32)
    for number, mask in enumerate(masks, 1):
        labels[mask] = number
    return labels


def _image(path: Path) -> np.ndarray:
    try:
        return grey_image(path, of_indices=True)
    except UnpackingError as error:
        raise ValueError(f"{path}: {error}") from error


def _escape(name: str) -> str:
    """Escape a name for :meth:`pathlib.Path.glob`."""
    return "".join(f"[{letter}]" if letter in "*?[" else letter for letter in name)
