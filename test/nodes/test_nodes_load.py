"""Nodes under load: two on a camera, a storm of parameters, busy services, a changing model, and kill -9."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

from hostile_messages import difference
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter
from respawned_nodes import CAMERA as CAMERA_PROCESS
from respawned_nodes import NODE, VIEWER, Robot
from running_nodes import BODIES, CAMERA, Peer, arguments, environment, until
from started_nodes import Child, Children
from std_srvs.srv import SetBool

from sq_msgs_py.superquadrics import from_message
from sq_perception.imaging.camera import Camera
from sq_perception.learning import checkpoint

QUIET = ("no_frame_warning:=0.0", "tracking:=false")
STORM_SECONDS, STORM_RATE = 3.0, 200.0
WAITING = 8
"""Calls without an answer yet; a service of ROS keeps ten requests, and an eleventh replaces the oldest unheard."""
ANSWER = 50.0
"""Milliseconds in which a service answers."""


@pytest.fixture(scope="module")
def peer() -> Iterator[Peer]:
    with Peer() as one:
        yield one


@pytest.fixture
def children() -> Iterator[Children]:
    with Children(environment()) as some:
        yield some


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copy(checkpoint.resolve(), tmp_path_factory.mktemp("weights") / "model.safetensors"))


@pytest.fixture(scope="module")
def recover_node(peer: Peer, model: Path) -> Iterator[Child]:
    """One for all that a node alone lives through."""
    with Children(environment()) as some:
        node = some.start("recover_node", arguments(*QUIET, "method:=network", f"model:={model}"))
        peer.ask("/recover_node", *peer.frame(), alive=(node,))
        yield node


def test_two_nodes_on_one_camera_find_the_same_bodies(peer, children):
    first = children.start("recover_node", arguments(*QUIET, remap=("__node:=one",)))
    alive = first, children.start("recover_node", arguments(*QUIET, remap=("__node:=two",)))
    for node in ("/one", "/two"):
        peer.ask(node, *peer.frame(), alive=alive)
    image, info = peer.frame()
    answers = peer.answers("/one"), peer.answers("/two")
    sent = [0.0]

    def both() -> list[object]:
        if time.monotonic() - sent[0] > 1.0:
            peer.publisher(type(info), "/depth/camera_info").publish(info)
            peer.publisher(type(image), "/depth/image").publish(image)
            sent[0] = time.monotonic()
        found = [next((one for one in heard if one.message.header == image.header), None) for heard in answers]
        return found if all(found) else []

    one, two = (from_message(answer.message) for answer in until(both, alive))
    assert len(one) == len(BODIES)
    assert difference(one, two) < 1e-6
    np.testing.assert_allclose(one.shape, two.shape, atol=1e-6)


class Stream:
    """Frames of two bodies at a rate, from a thread of its own, as long as a ``with`` block lasts."""

    def __init__(self, peer: Peer, rate: float, camera: Camera = CAMERA) -> None:
        self._peer, self._period, self._camera = peer, 1 / rate, camera
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Stream:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._end.wait(self._period):
            image, info = self._peer.frame(camera=self._camera)
            self._peer.publisher(type(info), "/depth/camera_info").publish(info)
            self._peer.publisher(type(image), "/depth/image").publish(image)


def test_a_storm_of_parameters_changes_what_it_says_and_stops_nothing(peer, recover_node):
    alive, name = (recover_node,), "/recover_node"
    heard, rng, futures = peer.answers(name), np.random.default_rng(3), []
    expected = {"s": 117.3, "tau": 4.82, "max_objects": 20}
    with Stream(peer, 30.0):
        seen, began = len(heard), time.monotonic()
        for k in range(int(STORM_SECONDS * STORM_RATE)):
            what = ("s", "tau", "max_objects")[k % 3]
            value = int(rng.integers(2, 20)) if what == "max_objects" else float(rng.uniform(1.0, 99.0))
            is_bad = k % 7 == 0
            change = Parameter(what, value=-value if is_bad else value).to_parameter_msg()
            request = SetParameters.Request(parameters=[change])
            futures.append((is_bad, peer.start_call(SetParameters, f"{name}/set_parameters", request, alive)))
            if not is_bad:
                expected[what] = value
            until(lambda: sum(not future.done() for _, future in futures[-2 * WAITING :]) < WAITING, alive)
            time.sleep(max(0.0, began + k / STORM_RATE - time.monotonic()))
        until(lambda: all(future.done() for _, future in futures), alive)
        during = len(heard) - seen
    for is_bad, future in futures:
        (result,) = future.result().results
        assert result.successful != is_bad, result.reason
        assert bool(result.reason) == is_bad
    assert during >= 3
    assert peer.get(name, *expected, alive=alive) == list(expected.values())
    assert len(from_message(peer.ask(name, *peer.frame(), alive=alive).message)) == 2
    assert peer.diagnoses(name)[-1].is_balanced
    assert peer.diagnoses(name)[-1].count("refused") == 0


def test_services_answer_while_more_frames_come_than_anybody_could_answer(peer, recover_node):
    alive, name, took = (recover_node,), "/recover_node", []
    with Stream(peer, 60.0, Camera(320, 240, 280.0, 280.0, 159.5, 119.5)):
        time.sleep(0.5)
        for _ in range(60):
            for kind, service, request in (
                (GetParameters, "get_parameters", GetParameters.Request(names=["s"])),
                (SetBool, "enable", SetBool.Request(data=True)),
            ):
                took.append(peer.call(kind, f"{name}/{service}", request, alive).milliseconds)
    # The peer renders nothing but publishes 18 MB a second on the same cores: its own share is in these times.
    assert np.median(took) < ANSWER
    assert peer.diagnoses(name)[-1].is_balanced


def test_a_model_file_that_changes_under_a_node_changes_nothing(peer, recover_node, model):
    alive, name = (recover_node,), "/recover_node"
    known = from_message(peer.ask(name, *peer.frame(), alive=alive).message)
    content = model.read_bytes()
    other, noise = checkpoint.shipped_weights()["supervised"].read_bytes(), np.random.default_rng(0).bytes(len(content))
    for changed in (other, content[: len(content) // 2], noise, b"", None):
        if changed is None:
            model.unlink()
        else:
            model.write_bytes(changed)  # in place, as a careless copy does
        found = from_message(peer.ask(name, *peer.frame(), alive=alive).message)
        assert difference(found, known) < 1e-6, changed and changed[:40]
        assert peer.set(name, alive, tau=4.82)[0].successful
    # Other threads are no other weights, but a recoverer that is made anew reads them, and that of before goes on.
    assert peer.set(name, alive, threads=2)[0].successful
    found = from_message(peer.ask(name, *peer.frame(), alive=alive).message)
    assert difference(found, known) < 1e-6
    until(lambda: "cannot change to method network" in peer.diagnoses(name)[-1].message, alive)
    for wanted in ({"model": str(model)}, {"method": "auto"}):
        assert "no such model file" in peer.set(name, alive, **wanted)[0].reason
    assert peer.diagnoses(name)[-1].count("refused") == 0


def test_each_of_three_is_killed_and_comes_back_while_the_others_go_on(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(
        "image_width: 160\nimage_height: 120\ncamera_name: small\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [140, 0, 79.5, 0, 140, 59.5, 0, 0, 1]\n"
    )
    camera = ("objects:=1", "rate:=10.0", f"camera_info_file:={path}")
    with Peer() as peer, Robot(peer, camera) as robot:
        for member in np.random.default_rng(5).permutation([CAMERA_PROCESS, NODE, VIEWER]):
            kill = robot.kill(str(member))
            assert kill.back < 30.0, kill  # the benchmark asks for 5, on a machine that does nothing else
            assert kill.silence < 5.0, kill
        assert robot.diagnoses[-1].count("refused") == 0
    assert len(set(robot.pids)) == 6
    assert robot.left() == []
