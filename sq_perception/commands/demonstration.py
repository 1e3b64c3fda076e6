"""The demonstration: a synthetic or recorded camera, recover_node and fitter_node as processes, and a live table.

The processes talk in a ROS domain of their own on this machine only, unless ROS_DOMAIN_ID or
ROS_AUTOMATIC_DISCOVERY_RANGE are set, and use the shipped Fast DDS profile.  At the end the last complete image
is drawn to demo.png and its bodies are written to demo.glb.

Exit codes: 0 shown, or stopped with Ctrl-C; 1 a node failed or nothing came; 2 wrong usage or an unreadable frame.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from sq_perception.commands.children import Children, parameter_arguments
from sq_perception.evaluation.demo_table import TITLES, delays, demo_table, pair
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.imaging.camera import Projection
from sq_perception.nodes import fast_dds
from sq_perception.nodes.watch import CAMERA, Shot, Watch
from sq_perception.recordings.frame_file import FrameError, read

_RATE = 10.0
_START_PATIENCE = 120.0
"""The first start compiles."""
_TABLE_PERIOD = 0.25
_LINE_PERIOD = 2.0
_SHOWN_LATENCIES = 50
_FILE_WIDTH = 120
"""Columns: the table, unbroken."""
_HINTS = """\
What next
  {picture}    the last image: depth, recovered outlines, both methods in space
  {mesh}    the recovered bodies, for any glTF viewer
  sq-perception recover FRAME --json out.json    the same from files, without ROS
  ros2 run sq_perception recover_node    on your camera; README.md has the topics, docs/parameters.md the parameters
  sq-perception demo --frame recording.npz    this with a frame of yours"""


class DemoError(RuntimeError):
    """The demonstration cannot go on; the message has the reason."""


def show(options: argparse.Namespace) -> int:
    """What ``sq-perception demo`` does with these options; the exit code."""
    try:
        camera = _camera(options.frame, options.camera_info, options.projection)
    except FrameError as error:
        print(error, file=sys.stderr)
        return 2
    try:
        return run(camera, options.seconds, options.output_dir)
    except DemoError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 0


def run(camera: dict[str, Any], seconds: float, folder: Path) -> int:
    """Start the nodes, show what they do for some seconds, write the pictures, and stop the nodes.

    Parameters
    ----------
    camera
        Parameters of synthetic_depth_node.
    seconds
        Counted from the first result.
    folder
        For demo.png and demo.glb.

    Raises
    ------
    DemoError
        If a node ends, or no result comes.
    """
    os.environ.update(_own_domain())
    console = Console(width=None if sys.stdout.isatty() else _FILE_WIDTH)
    with Children() as children:
        for name in TITLES:
            children.start(name, parameter_arguments({"projection": camera["projection"]}))
        children.start(CAMERA, parameter_arguments(camera))
        with Watch(tuple(TITLES), has_truth=camera["scene"] != "replay") as watch:
            _wait_for_results(watch, children, console)
            _show(watch, children, console, seconds, camera["projection"])
    if children.killed:
        console.print(f"had to kill: {', '.join(children.killed)}", highlight=False)
    _summary(watch, console, folder)
    return 0


def _camera(frame: Path | None, camera_info: Path | None, projection: Projection | None) -> dict[str, Any]:
    """Parameters of the synthetic camera; a frame is read once, so that what is wrong with it is reported at once."""
    if frame is None:
        scene = "thesis" if projection == "orthographic" else "table"
        own = {"scene": scene, "projection": projection or "pinhole", "objects": 3, "hold": int(3 * _RATE), "seed": 7}
        return {"rate": _RATE, **own}
    if projection is None:
        projection = "orthographic" if _is_grey(frame) else "pinhole"
    # An NPZ may be of the unit cube, whatever was expected of it.
    is_cube = read(frame, camera_info, projection).is_cube
    files = {"path": str(frame.resolve())}
    if camera_info is not None:
        files["camera_info_file"] = str(camera_info.resolve() if camera_info.exists() else camera_info)
    return {"rate": _RATE, "scene": "replay", "projection": "orthographic" if is_cube else "pinhole", **files}


def _is_grey(frame: Path) -> bool:
    if frame.suffix.lower() not in (".png", ".bmp"):
        return False
    image = cv2.imread(str(frame), cv2.IMREAD_UNCHANGED)
    return image is not None and image.dtype == np.uint8


def _own_domain() -> dict[str, str]:
    """Keeps the demonstration to itself, as far as the user has not decided."""
    wanted = {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "RCUTILS_COLORIZED_OUTPUT": "0",
    }
    return {**{name: value for name, value in wanted.items() if not os.environ.get(name)}, **fast_dds.additions()}


def _wait_for_results(watch: Watch, children: Children, console: Console) -> None:
    deadline = time.monotonic() + _START_PATIENCE
    with console.status("starting three nodes (the first time, they compile) ..."):
        while watch.latest is None:
            watch.listen(0.1)
            _check(children)
            if time.monotonic() > deadline:
                came = ", ".join(f"{name} {len(times)}" for name, times in watch.latencies.items())
                raise DemoError(
                    f"no complete result within {_START_PATIENCE:g} s; {watch.images} images came, results: {came}"
                )


def _show(watch: Watch, children: Children, console: Console, seconds: float, projection: str) -> None:
    unit = "mm" if projection == "pinhole" else ""
    started = due = time.monotonic()
    period, shown = _TABLE_PERIOD if console.is_terminal else _LINE_PERIOD, -1
    with Live(console=console, auto_refresh=False) if console.is_terminal else nullcontext() as screen:
        while (passed := time.monotonic() - started) < seconds:
            watch.listen(0.05)
            _check(children)
            shot = watch.latest
            if shot is None or time.monotonic() < due or shot.stamp == shown:
                continue
            due, shown = time.monotonic() + period, shot.stamp
            heading = f"image {watch.images}, {passed:.0f} of {seconds:.0f} s, half sizes" + f" in {unit}" * bool(unit)
            latest = {name: times[-_SHOWN_LATENCIES:] for name, times in watch.latencies.items()}
            results = {name: (shot.results[name].bodies, shot.results[name].residual) for name in TITLES}
            table = demo_table(shot.truth, results, unit, heading, latest)
            if screen is None:
                console.print(table)
            else:
                note = Text("Ctrl-C ends the demonstration", style="dim")
                screen.update(Group(table, note), refresh=True)


def _check(children: Children) -> None:
    ended = children.dead()
    if ended is not None:
        raise DemoError(
            f"{ended.name} has ended with exit code {ended.exit_code}; its last lines:\n  "
            + "\n  ".join(ended.last_lines())
        )


def _summary(watch: Watch, console: Console, folder: Path) -> None:
    shot = watch.latest
    assert shot is not None
    picture, mesh = draw(watch, shot, folder)
    counts = ", ".join(f"{title} {len(watch.latencies[name])}" for name, title in TITLES.items())
    console.out(f"{watch.images} images seen, answered: {counts}; {delays(watch.latencies)}")
    console.out(_HINTS.format(picture=picture, mesh=mesh or "(no body, no mesh)"), highlight=False)


def draw(watch: Watch, shot: Shot, folder: Path) -> tuple[Path, Path | None]:
    """Write demo.png and demo.glb of one image; their paths, None for a mesh of nothing.

    What draws is imported here: it takes seconds, which the nodes need not wait for at the start.
    """
    from sq_perception.evaluation.demo_figure import demo_figure
    from sq_perception.evaluation.plots import save
    from sq_perception.geometry.mesh import export
    from sq_perception.segmentation.segments import segment

    frame = watch.frame(shot)
    unit = "" if frame.is_cube else "m"

    def optical(found: Superquadric) -> Superquadric:
        return unit_cube.optical_from_cube(found) if frame.is_cube else found

    truth = Superquadric.stack([]) if shot.truth is None else optical(shot.truth)
    methods = []
    model = truth
    for name, title in TITLES.items():
        found = optical(shot.results[name].bodies)
        if not len(model):
            model = found
        pairs = pair(model, found)
        ordered = [found[match.recovered] for match in pairs if match.recovered is not None]
        overlaps = [match.iou or 0.0 for match in pairs[: len(truth)]]
        remark = f"mean IoU {100 * np.mean(overlaps):.1f} %, " if overlaps else ""
        methods.append((title, ordered, f"{remark}{shot.results[name].latency:.0f} ms after the stamp"))
    plane = None if frame.is_cube else segment(frame.depth, frame.camera).plane
    heading = "Superquadrics recovered from one depth image"
    picture = save(
        demo_figure(frame.depth, frame.camera, list(truth), methods, plane, heading, unit), folder / "demo.png"
    )
    recovered = methods[0][1]
    return picture, export(recovered, folder / "demo.glb") if recovered else None
