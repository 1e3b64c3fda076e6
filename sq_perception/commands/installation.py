"""``sq-perception warm-up`` and ``doctor``: compile every kernel, and show what is installed and what is missing.

Compiled code is kept beside the modules, or in the user's cache if that folder cannot be written.  ``--only`` names
the steps that another process runs at the same time: what a first recovery needs beside the fit.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import platform
import re
import time
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from sq_perception.commands.console import FAILURE, SUCCESS, parser
from sq_perception.files import __version__

_WARM_UP_HELP = "Compile all kernels and keep them on disk (a minute or two), so that the first image does not wait."


def warm_up(arguments: Sequence[str]) -> int:
    """Run ``sq-perception warm-up``: run every step and print how long each took."""
    command = parser("warm-up", _WARM_UP_HELP)
    command.add_argument("--only", nargs="+", metavar="STEP", help="of its steps only these")
    only = command.parse_args(arguments).only
    if only is None:
        from sq_perception.geometry import kernel_cache

        kernel_cache.compile_beside()
    logging.getLogger("sq_perception.geometry.kernel_cache").setLevel(logging.ERROR)  # it says itself how far it is
    for name, action in steps():
        if only is not None and name not in only:
            continue
        began = time.perf_counter()
        print(f"preparing {name} ...", end=" ", flush=True)
        action()
        print(f"{time.perf_counter() - began:.1f} s", flush=True)
    return SUCCESS


def steps() -> list[tuple[str, Callable[[], object]]]:
    """Return name and action of each step that compiles."""
    import numpy as np

    from sq_perception.fitting import solina_bajcsy, surface_fit
    from sq_perception.geometry import metrics
    from sq_perception.geometry.superquadric import Superquadric
    from sq_perception.grasping import planner
    from sq_perception.imaging import raycast
    from sq_perception.imaging.camera import Camera
    from sq_perception.recovery import still_scene
    from sq_perception.recovery.recoverer import Recoverer
    from sq_perception.segmentation import segments
    from sq_perception.simulation import rendering, scenes
    from sq_perception.tracking import association

    batch = Superquadric.from_flat(np.array([[0.1, 0.2, 0.3, 0.5, 0.8, 0, 0, 1, 0, 0, 0, 1]]))
    body = batch[0]
    camera = Camera(32, 24, 30.0, 30.0, 16.0, 12.0)
    points = body.sample_surface(50, np.random.default_rng(0))
    table = scenes.table_scene(np.random.default_rng(0), 2, Camera(160, 120, 150.0, 150.0, 79.5, 59.5))

    def recover() -> None:
        recoverer = Recoverer()
        recoverer.warm_up(table.camera)
        recoverer.recover(table.render()[0], table.camera)  # what stands on a plane takes kernels of its own

    return [
        ("ray casting", lambda: raycast.render(body, camera)),
        ("canonical views", lambda: rendering.render_views(batch, 16)),
        ("overlap", lambda: metrics.volume_iou(batch, batch, 16)),
        ("classic fit", lambda: solina_bajcsy.fit(points)),
        ("surface fit", surface_fit.warm_up),
        ("segmentation", segments.warm_up),
        ("network", lambda: Recoverer(method="network").recover(table.render()[0], table.camera)),
        ("still scenes", still_scene.warm_up),
        ("tracking", association.warm_up),
        ("grasps", planner.warm_up),
        ("a whole recovery", recover),
    ]


_DOCTOR_HELP = """\
Show what is installed, what is missing, and how to get it; the exit code is 1 where the
core cannot work.
"""
_PACKAGE = Path(__file__).parent.parent
_EXTRAS = {
    "bags": ("rosbags", "mcap"),
    "exr": ("OpenEXR",),
    "train": ("torch",),
    "ros": ("rclpy", "sensor_msgs", "visualization_msgs"),
}
"""The modules of each extra."""


def doctor(arguments: Sequence[str]) -> int:
    """Run ``sq-perception doctor``; return the exit code."""
    parser("doctor", _DOCTOR_HELP).parse_args(arguments)
    faults = 0
    for what, finding, is_fault in findings():
        print(f"{what:12} {finding}")
        faults += is_fault
    return FAILURE if faults else SUCCESS


def findings() -> Iterator[tuple[str, str, bool]]:
    """Return what was checked, the result, and whether it is essential."""
    from sq_perception.files import provenance

    yield "program", f"sq_perception {__version__}, Python {platform.python_version()}, {_PACKAGE}", False
    yield (
        "cores",
        f"{len(os.sched_getaffinity(0))} of {os.cpu_count()} for this process: {provenance.processor()}",
        False,
    )
    for requirement in _requirements():
        name = re.split(r"[^\w.-]", requirement, maxsplit=1)[0]
        if "extra ==" not in requirement:
            found = provenance.version(name)
            yield name, found or f"missing: pip install '{requirement}'", found is None
    for extra, modules in _EXTRAS.items():
        missing = [name for name in modules if importlib.util.find_spec(name) is None]
        remedy = f"missing {', '.join(missing)}: pip install 'sq_perception[{extra}]'"
        yield f"[{extra}]", remedy if missing else "there", False
    if distro := os.environ.get("ROS_DISTRO"):
        yield "ROS", f"{distro}, sourced", False
    weights = ", ".join(sorted(path.stem for path in (_PACKAGE / "weights").glob("*.safetensors")))
    yield "weights", weights or "missing: install the package again", not weights
    yield "kernels", *_kernels()


def _requirements() -> list[str]:
    try:
        return metadata.requires("sq-perception") or []
    except metadata.PackageNotFoundError:  # run from the sources
        return []


def _kernels() -> tuple[str, bool]:
    """Return whether the kernels of these sources are cached: file names end in a digest of the sources."""
    try:
        from sq_perception.geometry import kernels
    except ImportError as error:
        return f"cannot be loaded: {error}", True
    gauge: Any = kernels.gauge
    folder, changed = Path(gauge.stats.cache_path), Path(kernels.__file__).stat().st_mtime
    kept = list(folder.glob("kernels.gauge_????????????-*.nbi"))
    if any(gauge.py_func.__qualname__ in file.name and file.stat().st_mtime > changed for file in kept):
        return f"compiled, in {folder}", False
    why = "compiled for other sources" if kept else "not compiled yet"
    return f"{why}: sq-perception warm-up; they go to {folder}", False
