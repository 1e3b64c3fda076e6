"""RVL, a lossless packing of 16 bit depth images that is fast rather than small.

The image is a sequence of runs: how many zeros, how many other pixels, then each of these as its difference to the last
pixel that was not zero, with the sign in the lowest bit (0 -1 1 -2 2 ... become 0 1 2 3 4 ...).  Every number is
written in groups of three bits, low groups first; a group is a nibble, whose fourth and highest bit marks that another
one follows.  Nibbles fill words of 32 bits from the top, and words are little endian.

The numbers are separated all at once; only the runs, some thousand in an image, are walked through one by one.

Reference: A. D. Wilson, Fast lossless depth image compression, ISS 2017.
"""

from __future__ import annotations

import numpy as np

MOST_PIXELS = 2**23
"""Most pixels of an image: above any depth camera's; unpacking takes some 100 bytes of memory for each."""

_MOST_BYTES = 4
"""Bytes for each pixel: 17 bits of a difference are 6 nibbles, and a run of one pixel has 2 more."""
_MOST_GROUPS = 9
"""Groups of a number: 27 bits, more than the pixels."""


def decode(data: bytes, width: int, height: int) -> np.ndarray:
    """The pixels, uint16 (height, width), 1 to ``MOST_PIXELS`` of them.

    Raises ValueError if the data does not hold that many pixels.
    """
    count = width * height
    if len(data) > _MOST_BYTES * count + 64:
        raise ValueError(f"RVL: expected at most {_MOST_BYTES} bytes for each of {count} pixels, got {len(data)} bytes")
    numbers = _numbers(data)
    view = memoryview(numbers.data)  # whose elements are plain integers, six times faster than an array's
    heads, runs = [], []
    at = pixel = 0
    while pixel < count:
        if at + 2 > len(view):
            raise ValueError(f"RVL: expected {count} pixels, the data ends after {pixel}")
        zeros, others = view[at], view[at + 1]
        if zeros + others == 0 or pixel + zeros + others > count or at + 2 + others > len(view):
            raise ValueError(f"RVL: not readable after {pixel} of {count} pixels")
        heads += [at, at + 1]
        runs += [zeros, others]
        at, pixel = at + 2 + others, pixel + zeros + others
    folded = np.delete(numbers[:at], heads)
    differences = (folded >> 1) ^ -(folded & 1)
    image = np.zeros(count, np.uint16)
    is_pixel = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    # What leaves 16 bits comes back at the other end.
    image[is_pixel] = np.cumsum(differences, dtype=np.int64).astype(np.uint16)
    return image.reshape(height, width)


def _numbers(data: bytes) -> np.ndarray:
    """All numbers, int32, in their order; the last ones may be padding."""
    words = np.frombuffer(data, "<u4", len(data) // 4)
    octets = words.astype(">u4").view(np.uint8)
    nibbles = np.stack([octets >> 4, octets & 15], axis=-1).reshape(-1)
    ends = np.flatnonzero(nibbles < 8)
    if not ends.size:
        return np.zeros(0, np.int32)
    starts = np.concatenate([[0], ends[:-1] + 1])
    lengths = ends - starts + 1
    if lengths.max() > _MOST_GROUPS:
        raise ValueError(f"RVL: expected numbers of at most {_MOST_GROUPS} groups, got {lengths.max()}")
    numbers = (nibbles[starts] & 7).astype(np.int32)
    for group in range(1, int(lengths.max())):
        longer = np.flatnonzero(lengths > group)
        numbers[longer] |= (nibbles[starts[longer] + group] & 7).astype(np.int32) << (3 * group)
    return numbers
