"""A place for compiled kernels where numba finds none: a read-only installation and a user without a home.

numba keeps machine code where ``NUMBA_CACHE_DIR`` says, beside the modules, or in the user's cache folder, and
otherwise refuses to compile at all.  Service users and containers often have none of these.  For them there is a folder
of the user's own among the temporary files: numba reads machine code with pickle, so that nobody else may write there.
"""

from __future__ import annotations

import logging
import os
import stat
import tempfile
from functools import cache
from pathlib import Path

_log = logging.getLogger(__name__)


@cache
def temporary_folder() -> Path | None:
    """A folder that belongs to this user alone and outlives the process, or None; says once what that means."""
    try:
        path = Path(tempfile.gettempdir()) / f"sq_perception-kernels-{os.geteuid()}"
        path.mkdir(mode=0o700, exist_ok=True)
        found = path.lstat()
        if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & 0o077:
            raise PermissionError(f"{path}: expected a folder of this user alone")
        tempfile.TemporaryFile(dir=path).close()
    except OSError as error:
        _log.warning("kernels are compiled at every start (minutes), NUMBA_CACHE_DIR names a place for them: %s", error)
        return None
    _log.warning("compiled kernels are kept in %s; NUMBA_CACHE_DIR names a place that lasts", path)
    return path
