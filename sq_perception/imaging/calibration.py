"""The camera of a camera_info: whether its images are raw, and the pinhole camera that they are made to fit.

Everything behind expects images of an ideal pinhole camera.  A camera_info describes two images at once, the raw one (K
and the distortion D) and the rectified one (P), and nothing in it shows which of them it came with.  So ``distortion``
decides:

    apply     the image is raw
    ignore    the image is rectified
    auto      the image is raw if D is not all zero, unless its name shows otherwise

A name marks the image as rectified if one of its last two parts has the word ``rect`` or ``rectified`` in it; words
are what is left between ``/``, ``_`` and other marks.  The transport's own part (``compressedDepth``) does not count.
``image_rect``, ``image_rect_raw``, ``depth/rect/image`` and ``depth_registered/image_rect`` are rectified,
``image_raw``, ``depth/image`` and ``direct/image`` are not.  A file's name is its folder's and its own.

Depth registered to a colour image has the geometry and the D of that image: ``aligned_depth_to_color/image_raw`` is as
distorted as the raw colour image, ``depth_registered/image_rect`` lies on the rectified one.

A rectified image has the intrinsics of P, or of K where P is not set; a raw one those of K, whatever P is, and is
rectified here (:mod:`sq_perception.imaging.rectification`).

A camera_info is whatever has the fields of the message: one of rclpy, of rosbags, or from a YAML file.

Reference: sensor_msgs/CameraInfo; REP 104; image_geometry, which takes all zeros for no distortion in every model too.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from sq_msgs_py.depth_image import Intrinsics, intrinsics_from_message, raw_intrinsics_from_message, size_mismatch
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.compressed_depth import TRANSPORT
from sq_perception.imaging.distortion import FISHEYE, Distortion
from sq_perception.imaging.rectification import Rectification, rectification

Treatment = Literal["auto", "apply", "ignore"]

_WORDS = re.compile(r"[^0-9a-z]+")
_RECTIFIED = re.compile(r"rect(ified)?")


@dataclass(frozen=True)
class Calibration:
    """What is known of the camera of an image; :meth:`of` makes one from a camera_info."""

    camera: Camera  # the pinhole camera of the rectified images
    rectification: Rectification | None = None  # from raw images to those of camera; None where they are sent rectified
    note: str = ""
    """What auto has decided about distortion coefficients that are there, and how to change that; empty if it had
    nothing to decide."""

    @classmethod
    def of(cls, info: Any, name: str = "", distortion: Treatment = "auto") -> Calibration:
        """The calibration of a camera_info, for images of a topic or file of this ``name``; quick, as tables are made
        for the first image.  Raises ValueError with the reason and the setting that might help."""
        if distortion not in get_args(Treatment):
            raise ValueError(f"distortion: expected {', '.join(get_args(Treatment))}, got {distortion!r}")
        note = ""
        raw = distortion == "apply"
        if distortion == "auto" and is_distorted(info.d):
            raw = not is_rectified_name(name)
            note = _note(info, raw)
        if not raw:
            return cls(Camera(**vars(intrinsics_from_message(info))), note=note)
        try:
            known = raw_intrinsics_from_message(info)
            camera = Camera(**vars(known.intrinsics))
            lens = _lens(known.distortion_model, known.distortion)
            if lens is None:
                return cls(camera, note=note)
            found = rectification(camera, lens)
        except ValueError as error:
            raise ValueError(f"{error} (of a raw image; distortion = ignore takes it for rectified)") from error
        return cls(found.camera, found, note)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images as they are sent."""
        sent = self.camera if self.rectification is None else self.rectification.raw
        return sent.width, sent.height

    def rectify(self, depth: np.ndarray) -> np.ndarray:
        """The depth image (height, width) of ``camera`` from one as it was sent; metres, NaN for nothing.  Raises
        ValueError if the image has not the size of ``size``; the message names the likely reason."""
        self.check(depth)
        return depth if self.rectification is None else self.rectification.there.depth(depth)

    def rectify_labels(self, labels: np.ndarray) -> np.ndarray:
        """The label image of ``camera`` from one of the depth image as it was sent; raises as :meth:`rectify`."""
        self.check(labels)
        return labels if self.rectification is None else self.rectification.there.labels(labels)

    def as_sent(self, depth: np.ndarray) -> np.ndarray:
        """A depth image of ``camera`` with the pixels of the images as they are sent; metres, NaN or inf for nothing.
        Raises ValueError if the image has not the size of ``camera``."""
        self.camera.check_image(depth)
        return depth if self.rectification is None else self.rectification.back.depth(depth)

    def check(self, image: np.ndarray) -> None:
        """Raise ValueError unless the image (height, width) has the size of those that are sent."""
        fault = size_mismatch((image.shape[1], image.shape[0]), self.size)
        if fault:
            raise ValueError(f"camera_info: does not fit: {fault}")


def is_rectified_name(name: str) -> bool:
    """Whether the name of a topic or file marks its images as rectified; see the module."""
    parts = [part for part in name.lower().split("/") if part and part != TRANSPORT.lower()]
    return any(_RECTIFIED.fullmatch(word) for part in parts[-2:] for word in _WORDS.split(part))


def is_distorted(coefficients: Sequence[float]) -> bool:
    """Whether distortion coefficients are not all zero; one that is no number counts."""
    # A coefficient up to it counts as 0: a millionth of a pixel.
    return not all(abs(value) <= 1e-9 for value in coefficients)


def intrinsics(camera: Camera) -> Intrinsics:
    """The intrinsics of a camera, as :class:`Calibration` compares them."""
    return Intrinsics(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)


def _lens(model: str, coefficients: tuple[float, ...]) -> Distortion | None:
    """The distortion; None where it moves nothing.  A fisheye lens always moves something."""
    if model != FISHEYE and not is_distorted(coefficients):
        return None
    try:
        return Distortion(model, coefficients)
    except ValueError as error:
        raise ValueError(f"camera_info: {error}") from error


def _note(info: Any, raw: bool) -> str:
    coefficients = " ".join([str(info.distortion_model), *(f"{value:g}" for value in info.d)])
    done, says, other = ("is", "does not say", "ignore") if raw else ("is not", "says", "apply")
    return (
        f"the distortion ({coefficients}) {done} undone, as the name of the images {says} that they are rectified; "
        f"distortion = {other} takes them for {'rectified' if raw else 'raw'}"
    )
