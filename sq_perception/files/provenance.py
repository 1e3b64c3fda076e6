"""Where figures come from: command, date, processor, versions and, where it is known, the commit."""

from __future__ import annotations

import os
import platform
import subprocess
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_info

_PACKAGES = ("sq-perception", "numpy", "numba", "torch", "ros-jazzy-rclpy")


def facts(command: str, file: str | Path = __file__) -> dict[str, Any]:
    """JSON values that belong beside every figure, for code in ``file``; what is not known is None."""
    known = commit(file)
    return {
        "command": command,
        "date": datetime.now(timezone.utc).strftime("%Y-%m-%d"),
        "commit": known,
        "modified": bool(_git(file, "status", "--porcelain", "--untracked-files=no")) if known else None,
        "processor": processor(),
        "blas": blas(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {package: version(package) for package in _PACKAGES},
    }


def version(package: str) -> str | None:
    """Return the version of a package; None where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def commit(file: str | Path = __file__) -> str | None:
    """Return the short hash of the checkout that a file belongs to; None for an installed package."""
    # An installation may lie inside of some checkout without being part of it.
    if _git(file, "ls-files", "--error-unmatch", Path(file).name) is None:
        return None
    return _git(file, "rev-parse", "--short", "HEAD")


def processor() -> str:
    """Name of the processor."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor()


def blas() -> list[str]:
    """Versions and kernels of NumPy's BLAS and of others that are loaded: OPENBLAS_CORETYPE may forbid the best."""
    found = [library for library in threadpool_info() if library["user_api"] == "blas"]
    return sorted(" ".join(str(each.get(k)) for k in ("internal_api", "version", "architecture")) for each in found)


def _git(file: str | Path, *arguments: str) -> str | None:
    folder = Path(file).resolve().parent
    try:
        done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=False, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
