"""One recorded frame, read as the commands read it."""

from __future__ import annotations

from pathlib import Path

from sq_perception.imaging.calibration import Treatment
from sq_perception.imaging.camera import Projection
from sq_perception.recordings import frame_file
from sq_perception.recordings.frame_file import Reading, RecordedFrame
from sq_perception.recordings.inputs import camera_beside


def read_frame(
    path: str | Path,
    camera_info: str | Path | None = None,
    projection: Projection = "pinhole",
    distortion: Treatment = "auto",
    reading: Reading | None = None,
) -> RecordedFrame:
    """Read one frame; of an image without ``camera_info`` the camera is the file beside it, as for ``recover``.

    Parameters and errors are those of :func:`sq_perception.recordings.frame_file.read`.
    """
    return frame_file.read(path, camera_info or camera_beside(Path(path)), projection, distortion, reading)
