"""The files that ``sq-perception recover`` writes: looked at before the first frame, and finished after the last one.

What is wrong with a name comes back as a sentence; :mod:`sq_perception.files.output_file` says how files are replaced.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sq_perception.files import output_file

if TYPE_CHECKING:
    from sq_perception.recordings.frame_file import RecordedFrame
    from sq_perception.recordings.result_bag import ResultBag
    from sq_perception.recordings.still_page import StillPage
    from sq_perception.recovery.recoverer import FrameRecovery

STANDARD_OUTPUT = "-"
_FILES, _FOLDERS = ("json", "jsonl", "csv", "mcap", "html"), ("pictures", "meshes")
_BINARY = ("mcap", "html")
"""Never on the standard output."""
_DECISIVE = (
    "projection",
    "method",
    "refine",
    "camera_info",
    "depth_scale",
    "depth_min",
    "depth_max",
    "roi",
    "masks",
    "min_score",
    "max_size",
    "distortion",
    "topic",
    "model",
    "consensus",
    "ignore_masks",
    "track",
    "time_budget",
    "max_objects",
)
"""Options that decide what is found in a frame."""


def misuse(options: argparse.Namespace) -> str:
    """What is wrong with the names of the outputs; empty if nothing.  Folders that are missing are made."""
    if [options.json, options.jsonl, options.csv].count(STANDARD_OUTPUT) > 1:
        return "--json, --jsonl, --csv: only one of them can be the standard output"
    for name in _FILES:
        path = getattr(options, name)
        if not path or (path == STANDARD_OUTPUT and name not in _BINARY):
            continue
        if not Path(path).resolve().parent.is_dir():
            return f"--{name}: {path}: its folder does not exist"
        if name == "mcap" and Path(path).is_dir():
            return f"--{name}: {path}: expected the name of a file that ends in .mcap"
        try:
            output_file.check(path)
        except OSError as error:
            return f"--{name}: {error}"
    for name in _FOLDERS:
        if folder := getattr(options, name):
            try:
                output_file.check_folder(folder)
            except OSError as error:
                return f"--{name}: {error}"
    return ""


def replaced_input(options: argparse.Namespace, inputs: Sequence[Path]) -> str:
    """Which output would take the place of an input; empty if none."""
    for name in _FILES:
        path = Path(getattr(options, name) or STANDARD_OUTPUT)
        if path.exists() and any(one.exists() and path.samefile(one) for one in inputs):
            return f"--{name}: {path}: this is an input"
    for name, suffix in (("pictures", ".png"), ("meshes", f".{options.mesh_format}")):
        folder = getattr(options, name)
        if folder and any(one.suffix.lower() == suffix and one.parent.samefile(folder) for one in inputs):
            return f"--{name}: {folder}: the {suffix} files in this folder are inputs; choose another one"
    return ""


def place(name: str) -> str:
    """The path that an output's name means."""
    return "/dev/stdout" if name == STANDARD_OUTPUT else name


def decisive(options: argparse.Namespace) -> dict[str, Any]:
    """Options that decide what is found in a frame, as JSON values; what was not given is None."""
    values = {name: getattr(options, name) for name in _DECISIVE}
    values = {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}
    return {name: None if value == math.inf else value for name, value in values.items()}


def bag(options: argparse.Namespace) -> ResultBag | None:
    """The bag that was asked for, open.

    Raises
    ------
    ValueError
        For a name or kind of image that is none.
    OSError, ImportError
        If it cannot be written.
    """
    if not options.mcap:
        return None
    try:
        from sq_perception.recordings.result_bag import ResultBag

        images: list[Any] = [one.strip() for one in options.mcap_images.split(",")]
        return ResultBag(options.mcap, [] if images == ["none"] else images)
    except ValueError as error:
        raise ValueError(f"--mcap: {error}") from error
    except ImportError as error:
        raise ImportError(f"--mcap: {error}") from error


def page(options: argparse.Namespace) -> StillPage | None:
    """The page that was asked for, open; raises OSError if it cannot be written."""
    if not options.html:
        return None
    from sq_perception.recordings.still_page import StillPage

    return StillPage(options.html)


def finish(
    options: argparse.Namespace,
    entries: Sequence[Mapping[str, Any]],
    growing: Mapping[str, ResultBag | StillPage | None],
    whole: bool,
) -> Iterator[str]:
    """Close what grew and write the documents; what could not be done, or went elsewhere, one sentence each.

    ``whole`` says whether all frames were tried.
    """
    for name, output in growing.items():
        try:
            if output is not None and (found := output.close(whole)) is not None:
                yield from _elsewhere(name, Path(getattr(options, name)), found)
        except OSError as error:
            yield f"--{name}: {error}"
    from sq_perception.recordings import result_json

    for name, text in (
        ("json", lambda: result_json.document(decisive(options), entries)),
        ("csv", lambda: result_json.table(entries)),
    ):
        if getattr(options, name) == STANDARD_OUTPUT:
            sys.stdout.write(text())
        elif getattr(options, name):
            path = Path(getattr(options, name))
            try:
                if not entries and path.is_file() and path.stat().st_size:
                    yield f"--{name}: no frame was read, so {path} stays as it is"
                else:
                    yield from _elsewhere(name, path, output_file.write(path, text().encode(), whole))
            except OSError as error:
                yield f"--{name}: {error}"


def _elsewhere(name: str, path: Path, found: Path) -> Iterator[str]:
    if found != path:
        yield f"--{name}: unfinished, so {path} stays as it is: see {found}"


def draw(path: Path, frame: RecordedFrame, recovery: FrameRecovery) -> None:
    """The picture of a frame."""
    from sq_perception.evaluation import plots

    unit = "of the cube" if frame.is_cube else "m"
    with output_file.writing(path) as partial:
        plots.save(plots.recovery_figure(frame.depth, frame.camera, recovery, frame.name, unit), partial)


def write_mesh(path: Path, frame: RecordedFrame, recovery: FrameRecovery) -> None:
    """The bodies of a frame; no file where there is none."""
    from sq_perception.fitting.fit import Status
    from sq_perception.geometry import mesh
    from sq_perception.recordings.frame_entry import in_result_frame

    shown = [k for k, body in enumerate(recovery.bodies) if body.status != Status.FAILED]
    if not shown:
        return
    with output_file.writing(path) as partial:
        mesh.export(
            [in_result_frame(recovery.bodies[k].superquadric, frame.is_cube) for k in shown],
            partial,
            colours=mesh.COLOURS[[k % len(mesh.COLOURS) for k in shown]],
            names=[f"body_{k}" for k in shown],
            optical=not frame.is_cube,
        )
