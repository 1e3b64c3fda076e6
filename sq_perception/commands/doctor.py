"""``sq-perception doctor``: versions, extras, kernels, weights and cores, and how to install what is missing."""

from __future__ import annotations

import importlib.util
import os
import platform
import re
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from sq_perception.commands.console import FAILURE, SUCCESS, parser
from sq_perception.files.version import __version__

_HELP = "Show what is installed, what is missing, and how to get it; the exit code is 1 where the core cannot work."
_PACKAGE = Path(__file__).parents[1]
_EXTRAS = {
    "bags": ("rosbags", "mcap"),
    "exr": ("OpenEXR",),
    "train": ("torch",),
    "ros": ("rclpy", "sensor_msgs", "visualization_msgs"),
}
"""The modules of each extra."""


def main(arguments: Sequence[str]) -> int:
    """Run ``sq-perception doctor``; return the exit code."""
    parser("doctor", _HELP).parse_args(arguments)
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
    yield "weights", *_weights()
    yield "kernels", *_kernels()


def _requirements() -> list[str]:
    try:
        return metadata.requires("sq-perception") or []
    except metadata.PackageNotFoundError:  # run from the sources
        return []


def _weights() -> tuple[str, bool]:
    found = sorted((_PACKAGE / "weights").glob("*.safetensors"))
    return (", ".join(path.stem for path in found) or "missing: install the package again", not found)


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
