"""Many images of one object each, such as the crops of a detector: one call, one answer an image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sq_perception.imaging.camera import Camera
from sq_perception.recovery.options import RecoveryOptions
from sq_perception.recovery.recoverer import Recoverer
from sq_perception.recovery.recovery import Recovery
from sq_perception.recovery.workers import Processes, Setup, Work, recover_all


def recover_crops(
    depths: Sequence[np.ndarray],
    cameras: Camera | Sequence[Camera],
    masks: Sequence[np.ndarray] | None = None,
    options: RecoveryOptions | None = None,
    jobs: int = 1,
) -> list[Recovery | None]:
    """Recover the one object of each of n images.

    Parameters
    ----------
    depths : n of float (height, width)
        Metres in the optical frame, NaN for nothing; they may differ in size.
    cameras
        One for all or one each; of a crop :meth:`Camera.cropped`.
    masks : n of bool (height, width), optional
        Where the object is; by default wherever something was measured, as in images with all else removed.
    options
        As of :meth:`Recoverer.recover`.
    jobs
        Processes that share the images.  More than one pays from some hundred images on, as each takes seconds to
        start; a script that asks for them begins below ``if __name__ == "__main__":``.

    Returns
    -------
    list of n
        None where the mask holds no reading.

    Raises
    ------
    ValueError
        If there is not one camera and one mask an image, or one does not fit its image.
    """
    count = len(depths)
    each = [cameras] * count if isinstance(cameras, Camera) else list(cameras)
    shown = [np.isfinite(depth) for depth in depths] if masks is None else list(masks)
    if (len(each), len(shown)) != (count, count):
        raise ValueError(f"expected a camera and a mask for each of {count} images, got {len(each)} and {len(shown)}")
    settings = options or RecoveryOptions()
    works = [
        Work(depth, camera, np.asarray(mask, bool).astype(np.int32), settings)
        for depth, camera, mask in zip(depths, each, shown, strict=True)
    ]
    if jobs > 1:
        answers = [answer for _, answer in recover_all(enumerate(works), Processes(Setup(None, settings), jobs))]
    else:
        recoverer = Recoverer(method=settings.method)
        answers = [recoverer.recover(work.depth, work.camera, work.labels, settings) for work in works]
    found: list[Recovery | None] = []
    for answer in answers:
        if isinstance(answer, Exception):
            raise answer
        found.append(answer.bodies[0] if answer is not None and answer.bodies else None)
    return found
