"""How to recover the objects of a frame: the options of :meth:`sq_perception.recovery.recoverer.Recoverer.recover`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from sq_perception.imaging import soft_agreement
from sq_perception.segmentation.options import SegmentationOptions

Method = Literal["auto", "network", "symmetry", "classic"]
NEEDS_NETWORK = ("auto", "network")


@dataclass(frozen=True, kw_only=True)
class RecoveryOptions(SegmentationOptions):
    """What may change from one frame to the next, beside what counts as an object.

    Attributes
    ----------
    method
        See :mod:`sq_perception.recovery.recoverer`.
    sharpness, tau
        s and tau of the soft renderer, in the score.
    time_budget
        Seconds per frame after which the surface fit tries no further start for any object.  Those with most pixels,
        large or near, come first.  Segments and predictions take the time that they take.
    free_space
        Whether a pixel beside an object shows that there is nothing before what it measured; not so where the image was
        made of a cloud.  Without it objects are fitted as things, with a model error.
    repair
        Part and join own segments, drop those of no object, and leave outliers out of fits, by a network; of a pinhole
        camera's images.  Masks from outside stay as they are.
    parts
        Whether to look for the parts of each object (:mod:`sq_perception.recovery.parts`), beside its body; with the
        methods ``auto`` and ``symmetry``, of a pinhole camera's images.

    Raises
    ------
    ValueError
        For a value outside its range.
    """

    method: Method = "auto"
    sharpness: float = soft_agreement.THESIS_SHARPNESS
    tau: float = soft_agreement.THESIS_TAU
    time_budget: float = np.inf
    free_space: bool = True
    repair: bool = True
    parts: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method not in get_args(Method):
            raise ValueError(f"method: expected one of {', '.join(get_args(Method))}, got {self.method!r}")
        for name, number in (("sharpness", self.sharpness), ("tau", self.tau)):
            if not (np.isfinite(number) and number > 0):
                raise ValueError(f"{name}: expected a positive number, got {number}")
        if not self.time_budget > 0:
            raise ValueError(f"time_budget: expected a positive number of seconds, got {self.time_budget}")
        # Options are compared from frame to frame: of an array no one truth.
        object.__setattr__(self, "depth_range", tuple(float(end) for end in self.depth_range))
        if self.workspace is not None:
            object.__setattr__(self, "workspace", tuple(float(side) for side in self.workspace))
        if self.workspace_pose is not None:
            pose = tuple(tuple(float(number) for number in part) for part in self.workspace_pose)
            object.__setattr__(self, "workspace_pose", pose)
