"""Results of recorded frames: JSON and CSV when all is done, or a line of JSON a frame as it goes, to be resumed.

``result.schema.json`` beside this file describes the document, and every field in it.  Coordinates are metres in the
optical frame, or those of the unit cube.  A file of JSON lines has its head without ``frames`` in its first line, and
in each line that follows an element of ``frames``.  A last line that was cut short is taken away when the file is
opened again, and nothing is added to what other options have found.
"""

from __future__ import annotations

import csv
import errno
import io
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sq_perception.files import __version__, output_file
from sq_perception.fitting.fit import Parts, Status
from sq_perception.fitting.quality import undetermined
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.recordings.frame_file import RecordedFrame, Stamp
from sq_perception.recovery.recoverer import FrameRecovery
from sq_perception.tracking.session import Followed
from sq_perception.tracking.tracker import Track

FORMAT = "sq_perception.recovery"
VERSION = 1
UNITS = {"optical": "m", "cube": "1"}  # units of lengths, by a frame's coordinates
LARGEST = 2**30  # bytes of a file of lines that is resumed: some 10^5 frames


class ResumeError(ValueError):
    """A file of lines that cannot be gone on with; the message has the reason."""


def head(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return what both forms begin with; ``options`` are those that decide what is found."""
    program = f"sq_perception {__version__}"
    plain = {name: plain_name(value) if isinstance(value, str) else value for name, value in options.items()}
    return {"format": FORMAT, "version": VERSION, "program": program, "units": UNITS, "options": plain}


def frame_entry(
    file: str, frame: RecordedFrame, recovery: FrameRecovery, tracks: Sequence[Followed] | None
) -> dict[str, Any]:
    """Return the element of ``frames``; ``tracks`` are those of the bodies that did not fail, None without tracking."""
    bodies, left = [], iter(tracks or ())
    for body in recovery.bodies:
        track = None if body.status == Status.FAILED else next(left, None)
        superquadric = in_result_frame(body.superquadric, frame.is_cube)
        bodies.append(
            {
                **_parameters(superquadric),
                "score": body.score,
                "residual": body.residual,
                "sigma_size": body.sigma_size,
                "seen": body.seen,
                "status": body.status.name.lower(),
                "message": body.message,
                "label": body.label if frame.labels is not None else None,
                "pixels": body.pixels,
                "objectness": body.objectness,
                "track": None if track is None else _track_entry(track, frame.is_cube),
                "parts": _part_entries(body.parts, frame.is_cube),
                "cavity": None if body.cavity is None else asdict(body.cavity),
            }
        )
    entry = {
        "file": plain_name(file),
        "ms": recovery.milliseconds["total"],
        "superquadrics": bodies,
        "coordinates": "cube" if frame.is_cube else "optical",
        "camera": {
            "projection": frame.camera.projection,
            "width": frame.camera.width,
            "height": frame.camera.height,
            "K": frame.camera.matrix.ravel(),
        },
        "message": recovery.message,
        "input": "; ".join(filter(None, (frame.warning, frame.notes))),
        "ms_by_stage": recovery.milliseconds,
        "plane": recovery.plane,
        "stamp": None if frame.stamp is None else frame.stamp._asdict(),
        "topic": frame.topic or None,
        "frame_id": frame.frame_id or None,
    }
    return plain_values(entry)


def plain_values(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return plain numbers and lists for those of NumPy, and None for NaN and infinity, which JSON does not know."""
    text = json.dumps(entry, default=lambda value: value.tolist())
    plain: dict[str, Any] = json.loads(text, parse_constant=lambda _: None)
    return plain


def plain_name(file: str) -> str:
    r"""Return the name of a file as text that every program reads: ``\xe9`` for a byte that is no UTF-8."""
    return file.encode(errors="surrogateescape").decode(errors="backslashreplace")


def _track_entry(track: Followed, is_cube: bool) -> dict[str, Any]:
    body = track.superquadric
    if is_cube:
        body = unit_cube.cube_from_optical(body)  # not its canonical form: the track keeps its own
    return {
        "id": track.id,
        "seen": track.seen,
        "fused": track.is_fused,
        **_parameters(body),
        "sigma_size": track.sigma_size,
    }


def _part_entries(parts: Parts | None, is_cube: bool) -> list[dict[str, Any]]:
    """Return the elements of ``parts``: none where one body explains the object."""
    return [
        {
            **_parameters(in_result_frame(fit.superquadric, is_cube)),
            "sigma_size": fit.sigma_size,
            "residual": fit.residual,
            "seen": fit.seen,
            "share": share,
            "status": fit.status.name.lower(),
            "message": fit.message,
        }
        for fit, share in (() if parts is None else zip(parts, parts.shares.tolist(), strict=True))
    ]


def in_result_frame(body: Superquadric, is_cube: bool) -> Superquadric:
    """Return a body in the coordinates that results are given in."""
    return unit_cube.cube_from_optical(body).canonical_form() if is_cube else body


def _parameters(body: Superquadric) -> dict[str, Any]:
    box = body.untapered()
    return {name: getattr(box, name) for name in ("size", "shape", "translation", "rotation")} | {"taper": body.taper}


def scene_entry(track: Track) -> dict[str, Any]:
    """Return the element of ``scene``: a body of the world of the camera poses."""
    weak = undetermined(track.covariance, track.superquadric.size).any()
    about = {"id": track.id, "seen": track.seen, "status": "weak" if weak else "converged"}
    return plain_values({**about, **_parameters(track.superquadric), "sigma_size": track.sigma_size})


def document(
    options: Mapping[str, Any], frames: Sequence[Mapping[str, Any]], scene: Sequence[Mapping[str, Any]] = ()
) -> str:
    """Return the whole document, with ``scene`` where there is one."""
    whole = {**head(options), "frames": frames, **({"scene": scene} if scene else {})}
    return json.dumps(whole, indent=1, allow_nan=False) + "\n"


def table(frames: Sequence[Mapping[str, Any]]) -> str:
    """Return bodies, each before its parts, as CSV, a row each under a line of names; empty where unknown."""
    axes = ("1", "2", "3")
    columns = {
        "size": [f"a{k}" for k in axes],
        "sigma_size": [f"sigma_a{k}" for k in axes],
        "shape": ["e1", "e2"],
        "translation": ["x", "y", "z"],
        "rotation": ["qx", "qy", "qz", "qw"],
        "taper": ["kx", "ky"],
        "seen": [f"seen_a{k}" for k in axes],
    }
    single = ("score", "residual", "pixels", "objectness", "label", "message")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = [name for group in columns.values() for name in group]
    writer.writerow(["file", "stamp", "body", "status", "id", "coordinates", *names, *single, "part"])
    for frame in frames:
        stamp = "" if frame["stamp"] is None else str(Stamp(**frame["stamp"]))
        for number, body in enumerate(frame["superquadrics"]):
            track = body["track"] and body["track"]["id"]
            for part, shown in enumerate([body, *body.get("parts", ())]):
                values = [value for group in columns for value in shown[group]]
                values += [shown.get(name) for name in single] + [part]
                writer.writerow([frame["file"], stamp, number, shown["status"], track, frame["coordinates"], *values])
    return text.getvalue()


class ResultLines:
    """A file of JSON lines that grows frame by frame, or a stream; ``done`` has the elements of ``frames`` that were
    there.  Raises ResumeError for a file of something else or other options, OSError if it cannot be written."""

    def __init__(self, path: str | Path, options: Mapping[str, Any]) -> None:
        self._path = Path(path)
        self.done: list[dict[str, Any]] = []
        is_stream = output_file.is_stream(self._path)
        self._file = self._path.open("ab") if is_stream else os.fdopen(output_file.open_locked(self._path), "r+b")
        try:
            beginning = head(options)
            if is_stream or not self._resume(beginning):
                self.add(beginning)
        except BaseException:
            self.close()
            raise

    def add(self, entry: Mapping[str, Any]) -> None:
        """Write the element of a frame."""
        with output_file.name_in_errors(self._path):
            self._file.write(_line(entry))
            self._file.flush()

    def close(self) -> None:
        """End; more than once does no harm."""
        with suppress(OSError):  # what a full disk did not take
            self._file.close()

    def _resume(self, expected: Mapping[str, Any]) -> bool:
        """Read what is there and go to the end of its last whole line; return whether that is not the beginning."""
        size = os.fstat(self._file.fileno()).st_size
        if size > LARGEST:
            raise OSError(errno.EFBIG, f"expected at most {LARGEST} bytes to go on with", str(self._path))
        data = self._file.read()
        lines = data.split(b"\n")[:-1]
        entries = [self._entry(k, line) for k, line in enumerate(lines, 1)]
        # Of a run that came to no frame; a document in one line has frames too.
        about = ("format", "version")
        if len(entries) == 1 and entries[0].keys() == expected.keys() and all(
            entries[0][name] == expected[name] for name in about
        ):
            lines = []  # it is begun again, with any options
        elif entries:
            self._compare(entries[0], expected)
        elif data.strip() and not _line(expected).startswith(data):
            raise ResumeError(f"{self._path}: expected a file of JSON lines that this command wrote")
        for k, entry in enumerate(entries[1:], 2):
            if not isinstance(entry.get("file"), str) or not isinstance(entry.get("superquadrics"), list):
                raise ResumeError(f"{self._path}: line {k}: expected what was recovered from a frame")
        self.done = entries[1:]
        self._file.seek(sum(len(line) + 1 for line in lines))
        self._file.truncate()
        return bool(lines)

    def _entry(self, number: int, line: bytes) -> dict[str, Any]:
        try:
            entry = json.loads(line, parse_constant=_refuse)
            if not isinstance(entry, dict):
                raise ValueError("a JSON object")
            return entry
        except (ValueError, RecursionError) as error:
            raise ResumeError(f"{self._path}: line {number}: expected JSON: {error}") from error

    def _compare(self, found: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
        theirs, ours = found.get("options"), expected["options"]
        if (found.get("format"), found.get("version")) != (FORMAT, VERSION) or not isinstance(theirs, dict):
            raise ResumeError(f"{self._path}: expected a file of JSON lines that this command wrote")
        other = [
            f"{name} was {theirs.get(name)}, is {value}" for name, value in ours.items() if theirs.get(name) != value
        ]
        if other:
            raise ResumeError(f"{self._path}: found with other options ({'; '.join(other)}); choose another file")


class Recovered:
    """Which frames are done: called for each before it is decoded; equal ones are counted."""

    def __init__(self) -> None:
        self._left: Counter[str] = Counter()

    def add(self, entries: Sequence[Mapping[str, Any]]) -> None:
        """Elements of ``frames`` whose frames are done."""
        self._left.update(_key(entry["file"], entry.get("topic"), entry.get("stamp")) for entry in entries)

    def __call__(self, file: str, topic: str, stamp: Stamp | None) -> bool:
        """Return whether this frame is one of them; it is then ticked off."""
        key = _key(plain_name(file), topic, None if stamp is None else stamp._asdict())
        found = self._left[key] > 0
        if found:
            self._left[key] -= 1
        return found


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no JSON")


def _key(file: str, topic: Any, stamp: Any) -> str:
    return json.dumps([file, topic or None, stamp], sort_keys=True)


def _line(value: Mapping[str, Any]) -> bytes:
    return json.dumps(value, allow_nan=False).encode() + b"\n"
