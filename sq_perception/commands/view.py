"""The command ``sq-perception view``: a page in the browser with what a camera and the frame nodes publish.

Exit codes: 0 ended with Ctrl-C, 1 something is missing or the port is taken, 2 wrong usage.
"""

from __future__ import annotations

import argparse
import importlib.util
import re
import socket
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sq_perception.commands import console
from sq_perception.nodes import process

if TYPE_CHECKING:
    from sq_perception.nodes.view_node import ViewNode

NAME = "sq_view"
DEFAULT_NODE = "/recover_node"
DEFAULT_DEPTH = "depth/image"
_HELP = """\
A page in the browser: depth as points, superquadrics with their uncertainty, rates, latencies, and parameters to change
while the nodes run. Everything comes from this machine, nothing from the internet.
"""
_EPILOG = """\
recordings, without ROS:
  sq-perception view FRAME ...    # sq-perception view FRAME --help

examples:
  sq-perception view
  sq-perception view --depth /camera/camera/depth/image_rect_raw --node /recover_node --node /fitter_node
  sq-perception view --ros-args -r depth/image:=/camera/depth/image_raw
  ssh -L 8080:localhost:8080 robot    # on the machine with the screen; then http://localhost:8080
"""
_NODE_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_ROS = "--ros-args"


def main(given: Sequence[str]) -> int:
    """Entry point of ``sq-perception view``; the exit code."""
    cut = given.index(_ROS) if _ROS in given else len(given)
    parser = _parser()
    if _names_frames(parser, given[:cut]):
        from sq_perception.commands import view_recording

        return view_recording.main(given)
    options = parser.parse_args(given[:cut])
    nodes = list(dict.fromkeys(f"/{name.strip('/')}" for name in options.node or [DEFAULT_NODE]))
    for name in nodes:
        if not _NODE_NAME.fullmatch(name):
            parser.error(f"--node: expected a name like {DEFAULT_NODE}, got {name!r}")
    if importlib.util.find_spec("rclpy") is None:
        return console.failed(f"view needs ROS 2 in Python: {process.REMEDY}")
    try:
        from sq_perception.viewing import server
    except ImportError as error:
        return console.failed(f"view: viser cannot be imported, {error}: pip install '.[view]' in a checkout")
    try:
        bound = server.listening_socket(options.host, options.port)
    except server.ServerError as error:
        return console.failed(str(error))
    try:
        return process.run(NAME, lambda: [_node(bound, nodes, options)], given[cut:])
    finally:
        bound.close()


def _names_frames(parser: argparse.ArgumentParser, given: Sequence[str]) -> bool:
    """Whether recorded frames are to be shown: something was given that is no option of the live page."""
    others = given[:1]
    if not others or others[0].startswith("-"):  # of `FRAME --help` the help is the recordings' own
        _, others = parser.parse_known_args(given)
    return any(not other.startswith("-") for other in others)


def _node(bound: socket.socket, nodes: Sequence[str], options: argparse.Namespace) -> ViewNode:
    from sq_perception.nodes.view_node import ViewNode
    from sq_perception.viewing.page import Page
    from sq_perception.viewing.server import is_local, url

    host, port = bound.getsockname()[:2]
    page = Page(bound, nodes, options.max_points)
    try:
        node = ViewNode(NAME, page, options.depth, options.camera_info, nodes, options.rate)
    except BaseException:
        page.close()
        raise
    if not is_local(host):
        console.complain(
            f"warning: there is no password: whoever reaches port {port} of this machine sees the page and changes "
            "parameters; without --host, `ssh -L` brings the page to another machine"
        )
    print(f"{url(bound)}  shows {', '.join(nodes)}; Ctrl-C ends", flush=True)
    return node


def _parser() -> argparse.ArgumentParser:
    parser = console.parser("view", _HELP, _EPILOG)
    add = parser.add_argument
    add("--node", action="append", metavar="NAME", help=f"a frame node; may be given more than once ({DEFAULT_NODE})")
    add("--depth", default=DEFAULT_DEPTH, metavar="TOPIC", help="depth image (%(default)s)")
    add("--camera-info", metavar="TOPIC", help="its camera_info (the one in its name space)")
    console.add_address(parser)
    add("--max-points", type=console.at_least(1), default=40000, metavar="N", help="points of the cloud (%(default)s)")
    rate = console.number("a number above 0, at most 60", lambda value: 0 < value <= 60)
    add("--rate", type=rate, default=10.0, metavar="HZ", help="pictures per second (%(default)g)")
    return parser
