"""The files that ``sq-perception recover`` writes: checked before the first frame, and finished after the last one.

Errors of names are returned as sentences; :mod:`sq_perception.files.output_file` replaces files.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sq_perception.commands import console
from sq_perception.files import output_file
from sq_perception.fitting.fit import Status
from sq_perception.geometry import mesh
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.recordings import bag_file, result_json, scene_export
from sq_perception.recordings.frame_file import FrameError, RecordedFrame, Stamp
from sq_perception.recordings.publication import CAMERA_FRAME
from sq_perception.recordings.result_json import in_result_frame
from sq_perception.recovery.recovery import FrameRecovery
from sq_perception.tracking.session import Followed

if TYPE_CHECKING:
    from sq_perception.recordings.html_page import HtmlPage
    from sq_perception.recordings.result_bag import ResultBag

_FILES = ("json", "jsonl", "csv", "mcap", "html")
_DECISIVE = (
    "projection method camera_info camera_info_topic depth_scale depth_kind depth_min depth_max roi masks min_score "
    "max_size workspace distortion topic model ignore_masks track poses time_budget max_objects parts"
)
"""Options that affect the results."""


def replaced_input(options: argparse.Namespace, inputs: Sequence[Path]) -> str:
    """Return which output would replace an input or another output; empty if none."""
    files = {name: getattr(options, name) for name in _FILES}
    taken: dict[Path, str] = {}
    for name, file in files.items():
        if file is None or str(file) == console.STANDARD_OUTPUT or output_file.is_stream(Path(file)):
            continue  # a device takes all of them
        other = taken.setdefault(Path(file).resolve(), name)
        if other != name:
            return f"--{other}, --{name}: {file}: expected a file for each of them"
    folders = {"pictures": (options.pictures, ".png"), "meshes": (options.meshes, f".{options.mesh_format}")}
    if options.export:
        folders["export-folder"] = options.export_folder, scene_export.SUFFIXES[options.export]
    return console.replaced_input(inputs, files, folders)


def _decisive(options: argparse.Namespace) -> dict[str, Any]:
    """Return the options that affect the results, as JSON values; None for no value or no limit."""
    values = {name: getattr(options, name) for name in _DECISIVE.split()}
    sides = values["workspace"]
    values["workspace"] = sides and [side if math.isfinite(side) else None for side in sides]
    for name in ("masks", "poses"):
        values[name] = values[name] and str(values[name])
    return {name: None if value == math.inf else value for name, value in values.items()}


class Outputs:
    """All outputs of a run, open before the first frame.

    ``done``: elements of ``frames`` that the file of lines had at the beginning.  ``results``: elements of ``frames``
    that this run adds.  ``scene``: elements of ``scene``, to be set before the end.  Raises ValueError for a name or
    kind of image that is none, or a file of lines that cannot be gone on with; OSError or ImportError if something
    cannot be written.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self.results: list[dict[str, Any]] = []
        self.scene: list[dict[str, Any]] = []
        self._not_in_bag: list[str] = []  # why frames are not in the bag
        self._bag: ResultBag | None = None
        self._page: HtmlPage | None = None
        self._lines = _lines(options)
        self.done = [] if self._lines is None else self._lines.done
        try:
            self._bag = _bag(options)
            if options.html:
                from sq_perception.recordings.html_page import HtmlPage

                self._page = HtmlPage(options.html)
        except BaseException:  # nothing is left of those that were begun
            for output in (self._lines, self._bag, self._page):
                if output is not None:
                    output.close()
            raise
        self._stems: set[str] = set()
        for entry in self.done:
            output_file.free_name(_stem(entry), self._stems)

    def add(
        self, frame: RecordedFrame, recovery: FrameRecovery, tracks: Sequence[Followed] | None, entry: dict[str, Any]
    ) -> None:
        """Write a frame, its recovery, and its element of ``frames``; raises OSError on failure."""
        options = self._options
        self.results.append(entry)
        stem = output_file.free_name(_stem(entry), self._stems)
        if options.pictures:
            _draw(options.pictures / f"{stem}.png", frame, recovery)
        if options.meshes:
            _write_mesh(options.meshes / f"{stem}.{options.mesh_format}", frame, recovery)
        if options.export:
            suffix = scene_export.SUFFIXES[options.export]
            _write_scene(options.export_folder / f"{stem}{suffix}", frame, recovery, options)
        if self._bag is not None:
            try:
                self._bag.add(frame, recovery, tracks)
            except FrameError as error:  # of a name that no message takes; the other files have the frame
                self._not_in_bag.append(str(error))
        if self._page is not None:
            self._page.add(frame, recovery)
        if self._lines is not None:  # last: what has a line has all its files
            self._lines.add(entry)

    def finish(self, whole: bool) -> Iterator[str]:
        """Close growing files and write the documents, ``whole`` if all frames were tried; return a sentence per
        failure or other destination."""
        if self._lines is not None:
            self._lines.close()
        for name, output in (("mcap", self._bag), ("html", self._page)):
            try:
                path = getattr(self._options, name)
                if output is not None and (found := output.close(whole)) is not None and found != path:
                    yield f"--{name}: unfinished, so {path} stays as it is: see {found}"
            except OSError as error:
                yield f"--{name}: {error}"
        if self._not_in_bag:
            yield f"--mcap: {len(self._not_in_bag)} of the frames are not in it: {self._not_in_bag[0]}"
        entries = [*self.done, *self.results]
        for name, text in (
            ("json", lambda: result_json.document(_decisive(self._options), entries, self.scene)),
            ("csv", lambda: result_json.table(entries)),
        ):
            path = getattr(self._options, name)
            try:
                if path and not entries and Path(path).is_file() and Path(path).stat().st_size:
                    yield f"--{name}: no frame was read, so {path} stays as it is"
                elif path and (problem := console.write_document(name, path, text(), whole)):
                    yield problem
            except OSError as error:
                yield f"--{name}: {error}"


def _stem(entry: Mapping[str, Any]) -> str:
    """Return the file stem of a frame's picture and meshes by its element, unless another frame has it."""
    path = Path(entry["file"])
    return bag_file.frame_name(path, Stamp(**entry["stamp"])) if entry.get("topic") else path.stem


def _lines(options: argparse.Namespace) -> result_json.ResultLines | None:
    if not options.jsonl:
        return None
    path = "/dev/stdout" if options.jsonl == console.STANDARD_OUTPUT else options.jsonl
    lines = result_json.ResultLines(path, _decisive(options))
    needing = [name for name in ("track", "poses", "mcap", "html") if getattr(options, name)]
    if lines.done and needing:
        lines.close()
        raise ValueError(f"--jsonl: {path} has {len(lines.done)} frames already, and --{needing[0]} needs all")
    return lines


def _bag(options: argparse.Namespace) -> ResultBag | None:
    if not options.mcap:
        return None
    try:
        from sq_perception.recordings.result_bag import ResultBag

        images: list[Any] = [name.strip() for name in options.mcap_images.split(",")]
        return ResultBag(options.mcap, [] if images == ["none"] else images)
    except (ValueError, ImportError) as error:
        raise type(error)(f"--mcap: {error}") from error


def _draw(path: Path, frame: RecordedFrame, recovery: FrameRecovery) -> None:
    """Draw the picture of a frame."""
    from sq_perception.evaluation.plots import save
    from sq_perception.evaluation.recovery_figure import recovery_figure

    save(recovery_figure(frame.depth, frame.camera, recovery, console.replace_unprintable(frame.name)), path)


def _write_mesh(path: Path, frame: RecordedFrame, recovery: FrameRecovery) -> None:
    """Write the bodies of a frame, or their parts; no file if there are none."""
    solids, names, colours = [], [], []
    for k, body in enumerate(recovery.bodies):
        if body.status == Status.FAILED:
            continue
        for part, solid in enumerate(body.solids, 1):
            solids.append(in_result_frame(solid, frame.is_cube))
            names.append(f"body_{k}" + f"_part_{part}" * (len(body.solids) > 1))
            colours.append(k % len(mesh.COLOURS))
    if solids:
        with output_file.writing(path) as partial:
            mesh.export(solids, partial, colours=mesh.COLOURS[colours], names=names, optical=not frame.is_cube)


def _write_scene(path: Path, frame: RecordedFrame, recovery: FrameRecovery, options: argparse.Namespace) -> None:
    """Write the bodies of a frame as obstacles, no file if there are none; FrameError for a frame without metres."""
    shown = [k for k, body in enumerate(recovery.bodies) if body.status != Status.FAILED]
    if not shown:
        return
    try:
        if frame.is_cube:
            raise ValueError("frames of the unit cube have no metres")
        bodies = [recovery.bodies[k] for k in shown]
        covariances = np.array([body.covariance for body in bodies])
        stack = Superquadric.stack([body.superquadric for body in bodies])
        scene_export.write(
            scene_export.inflate(stack, covariances, options.inflate), path, options.export,
            names=[f"body_{k}" for k in shown], frame=CAMERA_FRAME, meshes=options.export_meshes,
        )
    except ValueError as error:
        raise FrameError(f"{frame.name}: --export: {error}") from error
