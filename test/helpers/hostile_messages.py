"""Messages that a camera should never send, and what a node says to each of them.

A hostile frame is an image with its camera_info and its mask, each of them sound, wrong in one or several fields, or
missing.  Sizes stay below 200 x 200 pixels of data, so that thousands of frames can be sent; what the fields *claim*
has no such limit.
"""

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from hypothesis import strategies as st
from running_nodes import Peer, until
from sensor_msgs.msg import CameraInfo, Image, RegionOfInterest
from started_nodes import Child
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from sq_msgs_py.depth_image import Intrinsics, byte_array, intrinsics_to_message
from sq_msgs_py.superquadrics import SuperquadricArray

SIZES = ((1, 1), (1, 2), (2, 2), (3, 7), (16, 12), (33, 21), (64, 48), (80, 60), (1, 200), (200, 1), (160, 120))
"""Width and height of sound images."""
PIXELS: dict[str, type[Any]] = {
    "32FC1": np.float32, "16UC1": np.uint16, "mono8": np.uint8, "8UC1": np.uint8, "mono16": np.uint16,
    "32SC1": np.int32,
}  # fmt: skip
UNKNOWN = ("", " ", "32fc1", "32FC1 ", "32FC2", "64FC1", "16SC1", "rgb8", "bgr8", "bayer_rggb8", "yuv422", "\x00",
           "16UC1; compressedDepth png", "深度", "x" * 70_000)  # fmt: skip
WILD = (0.0, -0.0, 1.0, -1.0, 5e-324, 1e-300, 1e-20, 1e20, 1e300, -1e300, float("inf"), float("-inf"), float("nan"))
_MOST = 2**32 - 1
_SIDES = (0, 1, 2, 3, 64, 80, 65535, 65536, 2**31 - 1, 2**31, _MOST)
_DEFECT = re.compile(r"[A-Za-z]*(Error|Exception|Warning|Interrupt)\b")
_AGAIN = 0.3
"""Seconds after which a frame without a verdict is sent once more: best effort may lose it."""


@dataclass(frozen=True, eq=False)
class HostileFrame:
    """An image and its companions; None where one is missing."""

    image: Image
    info: CameraInfo | None
    mask: Image | None


@dataclass(frozen=True)
class Verdict:
    answered: bool
    message: str

    @property
    def kind(self) -> str:
        """The text before the first colon, where it was refused: what was wrong."""
        return "" if self.answered else self.message.split(":")[0]

    @property
    def is_defect(self) -> bool:
        """Whether the node was surprised: an exception without a message of its own."""
        return not self.answered and _DEFECT.fullmatch(self.kind) is not None


# What is wrong with the pixels


LAYOUTS = ("bits", "constant", "checkerboard", "stripes", "one pixel", "ball", "noise", "all kinds")
VALUES = (0.0, 0.5, 1.5, -1.0, 1e-45, 1e-20, 1e18, 1e30, 3.4e38, float("nan"), float("inf"), float("-inf"))


def pattern(
    layout: str, near: float, far: float, shape: tuple[int, int], dtype: type[Any], seed: int
) -> np.ndarray:
    """Pixels (height, width) of one value with another one laid over it; integers hold the nearest that they can."""
    rng = np.random.default_rng(seed)
    if layout == "bits":
        return np.frombuffer(rng.bytes(shape[0] * shape[1] * np.dtype(dtype).itemsize), dtype).reshape(shape).copy()
    y, x = np.indices(shape)
    over = {
        "checkerboard": (x + y) % 2 > 0,
        "stripes": y % 2 > 0,
        "one pixel": (x == shape[1] // 2) & (y == shape[0] // 2),
        "ball": np.hypot(x - shape[1] / 2, y - shape[0] / 2) < min(shape) / 3,
        "noise": rng.random(shape) < 0.5,
    }.get(layout, np.zeros(shape, bool))
    pixels = rng.choice(VALUES, shape) if layout == "all kinds" else np.where(over, far, near)
    if dtype != np.float32:
        limits = np.iinfo(dtype)
        pixels = np.clip(np.nan_to_num(1000 * pixels), limits.min, limits.max)
    return pixels.astype(dtype)


# Strategies; their parts are made once, which is most of the time of an example

_TEXTS = st.one_of(
    st.sampled_from(("", "a_camera", "/leading", "map", "ö" * 3000, "\x00", "a b", "../..", "相机")),
    st.text(st.characters(exclude_categories=("Cs",)), max_size=40),
)
_SECONDS = st.one_of(st.sampled_from((0, 1, -1, 1000, 2**31 - 1, -(2**31))), st.integers(-(2**31), 2**31 - 1))
_NANOSECONDS = st.one_of(st.sampled_from((0, 999_999_999, 10**9, _MOST)), st.integers(0, _MOST))
_SIDE = st.one_of(st.sampled_from(_SIDES), st.integers(0, _MOST))
_SIZE, _LAYOUT, _SEED = st.sampled_from(SIZES), st.sampled_from(LAYOUTS), st.integers(0, 99)
_VALUE = st.one_of(st.sampled_from((0.5, 1.5)), st.sampled_from(VALUES))
_ORDER = st.one_of(st.just(0), st.integers(0, 255))
_PADDING = st.sampled_from((0, 0, 0, 1, 3, 64))
_NAMES = st.one_of(st.sampled_from((*UNKNOWN, *PIXELS)), _TEXTS)
_CHANGES = st.lists(st.sampled_from(("encoding", "width", "height", "step", "data")), min_size=1, max_size=3)
_NEAR = st.integers(-8, 8)
_LENGTH = st.one_of(st.sampled_from((0, 1, 2)), st.integers(0, 4096))
_NUMBER = st.one_of(st.sampled_from((*WILD, 60.0, 32.0, 1e4)), st.floats(width=64))
_ENTRY = st.one_of(st.sampled_from((60.0, 30.0, 64.0, 0.01, 1e6)), st.sampled_from((60.0, 30.0)), _NUMBER)
_DISTORTION = st.lists(_NUMBER, max_size=20)
_MODEL = st.one_of(st.sampled_from(("plumb_bob", "equidistant", "")), _TEXTS)
_BINNING = st.sampled_from((0, 1, 2, _MOST))
_REGION = st.one_of(st.just(0), _SIDE)
_INFO = st.sampled_from(("sound",) * 6 + ("hostile",) * 5 + ("other", "none"))
_COIN, _DIE = st.booleans(), st.integers(0, 9)
_DEPTH, _LABELS = ("32FC1", "16UC1"), ("mono8", "8UC1", "mono16", "16UC1", "32SC1")
_ENCODING = {encodings: st.sampled_from(encodings) for encodings in (_DEPTH, _LABELS)}


@st.composite
def headers(draw: st.DrawFn) -> Header:
    """Stamps of all times, those that are none included (nanoseconds above a second), and any frame."""
    return Header(stamp=Time(sec=draw(_SECONDS), nanosec=draw(_NANOSECONDS)), frame_id=draw(_TEXTS))


_HEADER = headers()


@st.composite
def sound_images(draw: st.DrawFn, encodings: tuple[str, ...] = _DEPTH) -> Image:
    """Images whose fields fit together, with any pixels, padding and byte order."""
    width, height = draw(_SIZE)
    encoding = draw(_ENCODING[encodings])
    dtype = np.dtype(PIXELS[encoding])
    pixels = pattern(draw(_LAYOUT), draw(_VALUE), draw(_VALUE), (height, width), PIXELS[encoding], draw(_SEED))
    big = draw(_ORDER)
    rows = pixels.astype(dtype.newbyteorder(">" if big else "<"))
    padded = np.zeros((height, width * dtype.itemsize + draw(_PADDING)), np.uint8)
    padded[:, : width * dtype.itemsize] = rows.view(np.uint8).reshape(height, -1)
    return Image(
        header=draw(_HEADER), height=height, width=width, encoding=encoding, is_bigendian=big,
        step=padded.shape[1], data=byte_array(padded),
    )  # fmt: skip


_SOUND = {encodings: sound_images(encodings) for encodings in (_DEPTH, _LABELS)}


@st.composite
def broken_images(draw: st.DrawFn, encodings: tuple[str, ...] = _DEPTH) -> Image:
    """Sound images with one to three fields changed; a change may happen to leave one sound."""
    image = draw(_SOUND[encodings])
    for change in draw(_CHANGES):
        if change == "encoding":
            image.encoding = draw(_NAMES)
        elif change == "step":
            image.step = max(image.step + draw(_NEAR), 0) if draw(_COIN) else draw(_SIDE)
            image.step = min(image.step, _MOST)
        elif change == "data":
            length = draw(_LENGTH) if draw(_COIN) else max(len(image.data) + draw(_NEAR), 0)
            image.data = byte_array(np.resize(np.arange(7, dtype=np.uint8), length))
        else:
            setattr(image, change, draw(_SIDE))
    return image


IMAGES, MASKS = (st.one_of(_SOUND[encodings], broken_images(encodings)) for encodings in (_DEPTH, _LABELS))
"""Depth images and label images, sound ones and broken ones."""


@st.composite
def hostile_infos(draw: st.DrawFn, width: int, height: int, header: Header) -> CameraInfo:
    """A camera_info for an image, with wild matrices, distortion, region of interest and binning."""
    info = CameraInfo(header=header, width=min(width, _MOST), height=min(height, _MOST))
    fx, fy, cx, cy, skew = (draw(_ENTRY) for _ in range(5))
    info.k = [fx, skew, cx, float(draw(_COIN)), fy, cy, 0.0, 0.0, float(draw(_COIN))]
    if draw(_COIN):
        info.p = [draw(_ENTRY), skew, draw(_ENTRY), draw(_NUMBER), 0.0, draw(_ENTRY), draw(_ENTRY), *[0.0] * 5]
    info.d = draw(_DISTORTION)
    info.distortion_model = draw(_MODEL)
    if draw(_COIN):
        info.binning_x, info.binning_y = draw(_BINNING), draw(_BINNING)
    if draw(_COIN):
        x, y, across, down = (draw(_REGION) for _ in range(4))
        info.roi = RegionOfInterest(x_offset=x, y_offset=y, width=across, height=down, do_rectify=draw(_COIN))
    if draw(_DIE) < 2:
        info.width, info.height = draw(_REGION), draw(_REGION)
    return info


def sound_info(image: Image) -> CameraInfo:
    width, height = max(int(image.width), 1), max(int(image.height), 1)
    known = Intrinsics(width, height, 60.0, 60.0, (width - 1) / 2, (height - 1) / 2)
    return intrinsics_to_message(known, image.header)


@st.composite
def frames(draw: st.DrawFn, *, masked: bool = False) -> HostileFrame:
    """Frames with at least one thing to object to, or to survive."""
    image = draw(IMAGES)
    kind = draw(_INFO)
    info: CameraInfo | None = sound_info(image)
    if kind == "hostile":
        info = draw(hostile_infos(int(image.width), int(image.height), image.header))
    elif kind != "sound":
        # Waited for by a patient node, so that few are sent.
        info = None if kind == "none" else sound_info(Image(width=17, height=23))
    mask = None
    if masked:
        mask = draw(MASKS)
        if draw(_DIE) < 7:
            mask = _of_size(mask, image)
        if draw(_DIE):
            mask.header = image.header
    return HostileFrame(image, info, mask)


def _of_size(mask: Image, image: Image) -> Image:
    """The mask's bytes as labels on the grid of a sound image."""
    width, height = int(image.width), int(image.height)
    if not 0 < width * height <= 40_000:
        return mask
    labels = np.resize(np.frombuffer(bytes(mask.data) or b"\0", np.uint8), (height, width))
    return Image(header=mask.header, width=width, height=height, encoding="mono8", step=width, data=byte_array(labels))


def difference(found: SuperquadricArray, known: SuperquadricArray) -> float:
    """The largest distance, metres, between bodies paired by their place: of centres, and of the sorted half sizes.

    Infinite if their numbers differ.
    """
    if len(found) != len(known):
        return float("inf")
    if not len(known):
        return 0.0
    gaps = np.linalg.norm(found.translation[:, None] - known.translation[None], axis=-1)
    pairs = gaps.argmin(axis=0)
    if len(set(pairs.tolist())) < len(known):
        return float("inf")
    sizes = np.abs(np.sort(found.size[pairs], axis=1) - np.sort(known.size, axis=1))
    return float(max(gaps.min(axis=0).max(), sizes.max()))


class Siege:
    """Sends hostile frames to one node and hears its verdict on each through ``~/trigger``."""

    def __init__(self, peer: Peer, node: str, alive: Sequence[Child] = ()) -> None:
        self._peer, self._node, self._alive = peer, node, tuple(alive)
        self._images = peer.publisher(Image, "depth/image")
        self._infos = peer.publisher(CameraInfo, "depth/camera_info")
        self.sent = 0
        until(lambda: self._images.get_subscription_count() and self._infos.get_subscription_count(), alive)

    def strike(self, frame: HostileFrame) -> Verdict:
        """Send a frame, and again where it gets lost, until the node has answered it."""
        verdict = self._peer.start_call(Trigger, f"{self._node}/trigger", Trigger.Request(), self._alive)
        # The node must know of the question when the image arrives, or the next copy of it is answered.
        time.sleep(0.002)
        due = 0.0

        def answered() -> bool:
            nonlocal due
            if not verdict.done() and time.monotonic() >= due:
                due = time.monotonic() + _AGAIN
                self._send(frame)
            return verdict.done()

        until(answered, self._alive)
        answer = verdict.result()
        return Verdict(answer.success, answer.message)

    def _send(self, frame: HostileFrame) -> None:
        if frame.info is not None:
            self._infos.publish(frame.info)
        if frame.mask is not None:
            self._peer.publisher(Image, "mask/image").publish(frame.mask)
        self._images.publish(frame.image)
        self.sent += 1
