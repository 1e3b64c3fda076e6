"""``sq-perception demo``: a simulated camera, recover_node and fitter_node, and the accuracy of both methods.

The nodes run in this process and communicate over ROS 2, in their own domain on this machine unless ROS_DOMAIN_ID or
ROS_AUTOMATIC_DISCOVERY_RANGE are set.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sq_perception.commands.console import FAILURE, SUCCESS, folder, number, parser

if TYPE_CHECKING:
    from sq_perception.geometry.superquadric import Superquadric
    from sq_perception.nodes.demo_node import DemoNode, Shot
    from sq_perception.nodes.process import Stoppable

_HELP = """\
Recover superquadrics from a simulated depth camera with real ROS 2 nodes: recover_node (network and fit) and
fitter_node (the classic fit) answer the same images.  Prints how well they did, and writes the last image as demo.png
and its bodies as demo.glb.  Needs the extra 'ros' or a ROS 2 installation.
"""
_METHODS = {"recover_node": "network + fit", "fitter_node": "classic fit"}
_CAMERA = {"scene": "table", "objects": "5", "sensor": "realsense_d435", "hold": "5", "seed": "7"}
_SHOWN = """\
{picture}   the last image: depth, recovered outlines, both methods in space
{mesh}   the recovered bodies, for any glTF viewer
What next: `sq-perception sample table.npz`, then `sq-perception recover table.npz --html page.html`; on a robot
`ros2 run sq_perception recover_node` (docs/nodes.md has the topics)."""


def main(arguments: Sequence[str]) -> int:
    """Run ``sq-perception demo``; return the exit code."""
    command = parser("demo", _HELP)
    add = command.add_argument
    above_0 = number("a number above 0", lambda value: value > 0)
    add("--seconds", type=above_0, default=20.0, help="how long, from the first result (default: %(default)g)")
    add("--output-dir", type=folder, default=".", metavar="DIR", help="for demo.png and demo.glb")
    options = command.parse_args(arguments)

    from sq_perception.nodes import process

    wanted = {"ROS_DOMAIN_ID": str(1 + os.getpid() % 100), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    os.environ.update({name: value for name, value in wanted.items() if not os.environ.get(name)})
    watching: list[DemoNode] = []

    def create() -> Iterator[Stoppable]:
        from sq_perception.nodes import executables
        from sq_perception.nodes.demo_node import DemoNode

        print("starting a camera, recover_node and fitter_node; Ctrl-C ends", flush=True)
        watching.append(process.make(DemoNode, "demo", tuple(_METHODS), options.seconds))
        yield watching[0]
        for name in (*_METHODS, "synthetic_depth_node"):
            yield executables.create_node(name)

    settings = [("-p", f"synthetic_depth_node:{name}:={value}") for name, value in _CAMERA.items()]
    words = ["--ros-args", "--log-level", "warn", *(word for setting in settings for word in setting)]
    code = process.run("demo", create, words)
    if code == SUCCESS and watching and watching[0].shots:
        _report(watching[0].shots, options.output_dir)
    return code and FAILURE


def _report(shots: Sequence[Shot], into: Path) -> None:
    """Print the table, and write picture and mesh of the last image."""
    import numpy as np

    from sq_perception.evaluation.plots import save
    from sq_perception.evaluation.recovery_figure import demo_figure
    from sq_perception.geometry.mesh import export
    from sq_perception.simulation.scenes import TABLE_CAMERA

    count = sum(len(shot.truth) for shot in shots)
    print(f"{len(shots)} images of a simulated RealSense D435, {count} bodies on tables\n")
    print(f"{'':15}{'found':>9}{'IoU mean':>11}{'worst':>8}{'stamp to result':>18}")
    for node, title in _METHODS.items():
        pairs = [pair for shot in shots for pair in match(shot.truth, shot.found[node])]
        overlaps = [100 * overlap for found, overlap in pairs if found is not None] or [0.0]
        delay = np.median([shot.delay[node] for shot in shots])
        share = 100 * len(overlaps) / count
        print(f"{title:15}{share:7.0f} %{np.mean(overlaps):9.1f} %{min(overlaps):6.0f} %{delay:15.0f} ms")
    last = shots[-1]
    methods = {title: list(last.found[node]) for node, title in _METHODS.items()}
    figure = demo_figure(last.depth, TABLE_CAMERA, list(last.truth), methods)
    picture, bodies = save(figure, into / "demo.png"), last.found["recover_node"]
    mesh = export(bodies, into / "demo.glb") if len(bodies) else "(no body)"
    print("\n" + _SHOWN.format(picture=picture, mesh=mesh))


def match(truth: Superquadric, found: Superquadric) -> list[tuple[Superquadric | None, float]]:
    """Return the best overlapping found body (m,) of each true body (n,) and their IoU; None for no overlap."""
    from sq_perception.geometry.metrics import volume_iou

    pairs: list[tuple[Superquadric | None, float]] = []
    for body in truth:
        overlaps = [float(volume_iou(other, body, 32)) for other in found]
        best = max(range(len(overlaps)), key=overlaps.__getitem__, default=None)
        pairs.append((None, 0.0) if best is None or not overlaps[best] else (found[best], overlaps[best]))
    return pairs
