"""Another node through its services: parameters, answers; and the command as a process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")
pytest.importorskip("lifecycle_msgs", reason="needs lifecycle_msgs")
pytest.importorskip("viser", reason="needs the extra 'view'")

from rcl_interfaces.msg import ParameterEvent
from rclpy.context import Context
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from spun_nodes import PATIENCE, SpunNodes

from sq_perception.nodes.live_parameters import LiveParameters
from sq_perception.nodes.parameters import FitterParameters
from sq_perception.nodes.remote_node import RemoteNode
from sq_perception.viewing.controls import Control

NAME = "/somewhere/fitter_node"


class Managed(LifecycleNode):
    """Declares one more parameter when it is configured."""

    def __init__(self, context: Context) -> None:
        super().__init__("fitter_node", namespace="/somewhere", context=context, enable_communication_interface=True)
        self.settings = LiveParameters(self, FitterParameters)

    def on_configure(self, state: Any) -> TransitionCallbackReturn:
        self.declare_parameter("late", "value")
        return TransitionCallbackReturn.SUCCESS


class Page:
    """Keeps what it is told to show."""

    def __init__(self) -> None:
        self.controls: list[Control] = []
        self.values: dict[str, Any] = {}
        self.answers: list[tuple[str, bool]] = []

    def show_controls(self, node: str, controls: list[Control]) -> None:
        self.controls = controls
        self.values = {one.name: one.value for one in controls}

    def show_answer(self, node: str, text: str, good: bool) -> None:
        self.answers.append((text, good))


class Bench(SpunNodes):
    """The peer asks, as the viewer does."""

    def __init__(self) -> None:
        super().__init__()
        self.remote = RemoteNode(self.peer, NAME)
        self.page: Any = Page()
        self.peer.create_subscription(ParameterEvent, "/parameter_events", self._on_event, 100)
        self.peer.create_timer(0.02, self.remote.tick)
        self.spin([])

    def _on_event(self, event: ParameterEvent) -> None:
        if event.node == NAME:
            self.remote.reload()

    def start(self) -> Managed:
        node = Managed(self.context)
        self.add(node)
        return node

    def shows(self, condition: Callable[[], Any]) -> None:
        """Wait until the page that is shown fulfils that."""

        def shown() -> Any:
            self.remote.show(self.page)
            return condition()

        self.until(shown)

    def asked(self, action: Callable[..., Any], *arguments: Any) -> None:
        """Calls of services belong into the executor's thread."""
        self.executor.create_task(action, *arguments)


@pytest.fixture
def bench() -> Iterator[Bench]:
    with Bench() as made:
        yield made


def test_a_node_that_is_not_there_says_so(bench: Bench) -> None:
    bench.asked(bench.remote.change, "s", 1.0)
    bench.shows(lambda: bench.page.answers == [(f"s: {NAME} is not there", False)])
    assert not bench.remote.is_there


def test_parameters_are_followed(bench: Bench) -> None:
    node = bench.start()
    bench.shows(lambda: bench.page.values.get("s") == 117.3)
    bench.asked(node.trigger_configure)
    # Declared by the transition: an event says so, and all controls are read anew.
    bench.shows(lambda: "late" in bench.page.values)

    bench.asked(bench.remote.change, "s", 3.5)
    bench.shows(lambda: ("s is now 3.5", True) in bench.page.answers)
    assert node.settings.current.s == 3.5
    bench.asked(bench.remote.change, "tau", 1e6)
    bench.shows(lambda: not bench.page.answers[-1][1] and "tau out of range" in bench.page.answers[-1][0])
    bench.shows(lambda: bench.page.values["tau"] == 4.82)
    bench.asked(bench.remote.change, "projection", "orthographic")
    bench.shows(lambda: not bench.page.answers[-1][1] and "read-only" in bench.page.answers[-1][0])
    bench.asked(bench.remote.change, "no_such_parameter", 1)
    bench.shows(lambda: not bench.page.answers[-1][1] and "no_such_parameter" in bench.page.answers[-1][0])
    assert node.get_parameter("projection").value == "pinhole"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_command_serves_and_ends_cleanly(number: int) -> None:
    """With a client that is connected and never takes anything, as a browser that is busy."""
    from websockets.sync.client import connect

    root = str(Path(__file__).resolve().parents[2])
    code = (
        f"import sys; sys.path[:1] = [{root!r}]; from sq_perception.commands.main import main; "
        "sys.exit(main(['view', '--port', '0', '--node', 'here', '--ros-args', '-r', 'depth/image:=/elsewhere']))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=dict(os.environ)
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("http://127.0.0.1:"), line
        assert "shows /here; Ctrl-C ends" in line
        address = line.split()[0].removeprefix("http://")
        client = connect(f"ws://{address}", origin=f"http://{address}", proxy=None)
        time.sleep(0.2)
        process.send_signal(number)
        out, err = process.communicate(timeout=PATIENCE)
        client.socket.close()
    finally:
        process.kill()
        process.wait()
    assert (process.returncode, out, err) == (0, "", "")
