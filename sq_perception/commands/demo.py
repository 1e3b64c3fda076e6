"""``sq-perception demo``: the options of :mod:`sq_perception.commands.demonstration`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sq_perception.commands.console import failed, folder, number, parser

_HELP = """\
Watch superquadrics being recovered: a camera, recover_node (CNN + fit) and fitter_node (classic fit) run as real ROS 2
processes; a table compares them, demo.png and demo.glb keep the last image.
"""
_EPILOG = """\
examples:
  sq-perception demo
  sq-perception demo --frame table.npz --seconds 10
  sq-perception demo --frame depth.png --camera-info camera.yaml
"""


def main(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception demo``; the exit code."""
    command = parser("demo", _HELP, _EPILOG)
    add = command.add_argument
    add("--frame", type=Path, help="recorded frame: NPZ, 16 bit PNG, or grey image of the unit cube")
    add("--camera-info", type=Path, metavar="YAML", help="intrinsics of a 16 bit PNG")
    add(
        "--projection",
        choices=("pinhole", "orthographic"),
        help="of the frame; 8 bit images are orthographic, NPZs what they say, others pinhole",
    )
    above_0 = number("a number above 0", lambda value: value > 0)
    add("--seconds", type=above_0, default=20.0, help="how long (default: %(default)g)")
    add("--output-dir", type=folder, default=".", metavar="DIR", help="for demo.png and demo.glb")
    options = command.parse_args(arguments)
    try:
        from sq_perception.commands import demonstration
    except ModuleNotFoundError as error:
        return failed(
            f"the demonstration needs ROS 2 in Python, and the module {error.name!r} is missing: "
            "pip install 'sq_perception[ros]', or source a ROS 2 Jazzy installation"
        )
    return demonstration.show(options)
