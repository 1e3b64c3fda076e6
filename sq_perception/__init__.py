"""Superquadrics from depth images: geometry, imaging, fitting, learning and ROS 2 nodes.

What a script needs is offered here by name and imported when it is first used: ``import sq_perception`` alone loads
neither torch nor anything else that takes time.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from sq_perception.files import __version__

if TYPE_CHECKING:
    from sq_perception.evaluation.recovery_figure import recovery_figure
    from sq_perception.fitting.fit import Fit, Parts, Status
    from sq_perception.fitting.options import FitOptions
    from sq_perception.fitting.points import fit_mesh, fit_points
    from sq_perception.fitting.surface_fit import fit
    from sq_perception.geometry.mesh import export as write_mesh
    from sq_perception.geometry.mesh import mesh, sample
    from sq_perception.geometry.metrics import volume_iou as iou
    from sq_perception.geometry.superquadric import Superquadric
    from sq_perception.imaging.camera import Camera
    from sq_perception.imaging.raycast import render
    from sq_perception.recordings.frame_file import RecordedFrame
    from sq_perception.recordings.frame_file import read as read_frame
    from sq_perception.recovery.decomposition import decompose
    from sq_perception.recovery.recoverer import FrameRecovery, Recoverer, Recovery, RecoveryOptions
    from sq_perception.recovery.workers import recover_crops

__all__ = [
    "Camera",
    "Fit",
    "FitOptions",
    "FrameRecovery",
    "Parts",
    "RecordedFrame",
    "Recoverer",
    "Recovery",
    "RecoveryOptions",
    "Status",
    "Superquadric",
    "__version__",
    "decompose",
    "fit",
    "fit_mesh",
    "fit_points",
    "iou",
    "mesh",
    "read_frame",
    "recover_crops",
    "recovery_figure",
    "render",
    "sample",
    "write_mesh",
]

_HOMES = {
    "Camera": "imaging.camera",
    "Fit": "fitting.fit",
    "FitOptions": "fitting.options",
    "FrameRecovery": "recovery.recoverer",
    "Parts": "fitting.fit",
    "RecordedFrame": "recordings.frame_file",
    "Recoverer": "recovery.recoverer",
    "Recovery": "recovery.recoverer",
    "RecoveryOptions": "recovery.recoverer",
    "Status": "fitting.fit",
    "Superquadric": "geometry.superquadric",
    "decompose": "recovery.decomposition",
    "fit": "fitting.surface_fit",
    "fit_mesh": "fitting.points",
    "fit_points": "fitting.points",
    "iou": "geometry.metrics:volume_iou",
    "mesh": "geometry.mesh",
    "read_frame": "recordings.frame_file:read",
    "recover_crops": "recovery.workers",
    "recovery_figure": "evaluation.recovery_figure",
    "render": "imaging.raycast",
    "sample": "geometry.mesh",
    "write_mesh": "geometry.mesh:export",
}
"""The module of every name, and what it is called there if it is called otherwise."""


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, there = _HOMES[name].partition(":")
    globals()[name] = value = getattr(importlib.import_module(f"{__name__}.{module}"), there or name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
