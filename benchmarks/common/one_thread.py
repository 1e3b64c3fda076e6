"""Imported before NumPy and torch: this process computes in one thread.

Only a script does so, for itself: a process that imports a benchmark has threads already, and numba refuses to compile
once they run and their number is named anew.
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"
