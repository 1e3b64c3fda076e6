"""The nodes as processes of their own: a client beside them sends good and bad messages, parameters and signals."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from sq_msgs_py.depth_image import Intrinsics, depth_to_message, intrinsics_to_message
from sq_msgs_py.superquadrics import SuperquadricArray, from_message
from sq_perception.commands.children import command
from sq_perception.geometry.metrics import thesis_iou, volume_iou
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera
from sq_perception.simulation.scenes import Scene

PATIENCE = 90.0
"""Seconds; a loaded machine compiles on the first start."""
CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
BODY = Superquadric(
    np.array([[0.06, 0.05, 0.08]]),
    np.array([[0.4, 0.6]]),
    np.array([[0.02, 0.01, 0.6]]),
    np.array([[0.4, 0.3, 0.1, 0.85]]),
)


def until(condition: Callable[[], Any], alive: Process | None = None) -> Any:
    deadline = time.monotonic() + PATIENCE
    while not (result := condition()):
        assert alive is None or alive.handle.poll() is None, alive.output()
        assert time.monotonic() < deadline, "waited in vain\n" + (alive.output() if alive else "")
        time.sleep(0.01)
    return result


class Process:
    """A node, started as a user starts it."""

    def __init__(self, node: str, log: Path, *parameters: str) -> None:
        self.name, self.log = node, log
        arguments = [part for parameter in parameters for part in ("-p", parameter)]
        root = str(Path(__file__).resolve().parents[2])
        with log.open("wb") as sink:
            self.handle = subprocess.Popen(
                command(node, ["--ros-args", *arguments]),
                stdin=subprocess.DEVNULL,
                stdout=sink,
                stderr=subprocess.STDOUT,
                cwd=root,
                env={**os.environ, "PYTHONPATH": root, "PYTHONUNBUFFERED": "1", "RCUTILS_COLORIZED_OUTPUT": "0"},
            )

    def output(self) -> str:
        return self.log.read_text(errors="replace")

    def says(self, words: str) -> None:
        until(lambda: words in self.output(), self)

    def stop(self, number: int = signal.SIGINT, times: int = 1) -> int:
        for _ in range(times):
            self.handle.send_signal(number)
        return self.handle.wait(PATIENCE)


class Client:
    """A publisher and listener in this process, spun in the background."""

    def __init__(self) -> None:
        self.context = Context()
        self.context.init(args=[])
        self.node = Node("client", context=self.context)
        self.images = self.node.create_publisher(Image, "depth/image", 5)
        self.infos = self.node.create_publisher(CameraInfo, "depth/camera_info", 5)
        self.heard: dict[str, list[PointCloud2]] = {}
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.thread = threading.Thread(target=self._spin, daemon=True)
        self.thread.start()

    def _spin(self) -> None:
        try:
            while self.context.ok():
                self.executor.spin_once(timeout_sec=0.2)
        except ExternalShutdownException:
            return

    def close(self) -> None:
        self.context.try_shutdown()
        self.thread.join(PATIENCE)
        self.node.destroy_node()

    def listen(self, topic: str) -> list[PointCloud2]:
        if topic not in self.heard:
            self.heard[topic] = []
            self.node.create_subscription(PointCloud2, topic, self.heard[topic].append, 50)
            self.executor.wake()
        return self.heard[topic]

    def header(self) -> Header:
        return Header(stamp=self.node.get_clock().now().to_msg(), frame_id="a_camera")

    def image(self, camera: Camera = CAMERA) -> Image:
        return depth_to_message(Scene(BODY, camera, None).render()[0], self.header())

    def info(self, camera: Camera = CAMERA) -> CameraInfo:
        known = Intrinsics(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        return intrinsics_to_message(known, self.header())

    def answer(self, process: Process, image: Image, info: CameraInfo) -> SuperquadricArray:
        """Publish the frame, again and again since best effort may lose it, until the node has answered it."""
        heard = self.listen(f"/{process.name}/superquadrics")
        sent = []

        def answered() -> PointCloud2 | None:
            if not sent or time.monotonic() - sent[-1] > 1.0:
                self.infos.publish(info)
                self.images.publish(image)
                sent.append(time.monotonic())
            return next((one for one in heard if one.header == image.header), None)

        return from_message(until(answered, process))

    def call(self, process: Process, kind: Any, name: str, request: Any) -> Any:
        client = self.node.create_client(kind, f"/{process.name}/{name}")
        until(client.service_is_ready, process)
        future = client.call_async(request)
        until(future.done, process)
        self.node.destroy_client(client)
        return future.result()

    def set(self, process: Process, name: str, value: Any) -> Any:
        kind, field = {
            int: (ParameterType.PARAMETER_INTEGER, "integer_value"),
            float: (ParameterType.PARAMETER_DOUBLE, "double_value"),
            str: (ParameterType.PARAMETER_STRING, "string_value"),
        }[type(value)]
        change = ParameterMessage(name=name, value=ParameterValue(type=kind, **{field: value}))
        request = SetParameters.Request(parameters=[change])
        return self.call(process, SetParameters, "set_parameters", request).results[0]


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    one = Client()
    yield one
    one.close()


@pytest.fixture(scope="module")
def start(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Process]]:
    """Starts nodes; whatever a test leaves running is killed at the end."""
    folder = tmp_path_factory.mktemp("logs")
    processes: list[Process] = []

    def begin(node: str, *parameters: str) -> Process:
        processes.append(Process(node, folder / f"{len(processes)}.log", *parameters))
        return processes[-1]

    yield begin
    for process in processes:
        if process.handle.poll() is None:
            process.handle.kill()
            process.handle.wait()


@pytest.fixture(scope="module")
def recover_node(start: Callable[..., Process]) -> Iterator[Process]:
    """One node for all tests of what a running node lives through; it must end as if nothing had happened."""
    process = start("recover_node")
    process.says("ready")
    yield process
    assert process.stop(times=2) == 0, process.output()
    assert "Traceback" not in process.output()


def bad_frames(client: Client) -> Iterator[tuple[str, Image]]:
    """Frames of every bad kind, with what the node says about each."""

    def changed(**fields: Any) -> Image:
        image = client.image()
        for name, value in fields.items():
            setattr(image, name, value)
        return image

    sound = client.image()
    yield "encoding", changed(encoding="nonsense")
    yield "step", changed(step=sound.step - 4)
    yield "data: expected", changed(step=sound.step + 4)
    yield "data: expected", changed(height=sound.height + 1)
    yield "data: expected", changed(data=sound.data[:-2])
    yield "step: expected", changed(width=2**31)
    yield "image size", changed(width=0, height=0, step=0, data=[])
    yield "projection = orthographic", changed(encoding="mono8", step=160, data=bytes(160 * 120))


def test_bad_frames_are_refused_with_a_reason_and_good_ones_answered_after_each(recover_node, client):
    found = client.answer(recover_node, client.image(), client.info())
    recovered = Superquadric(found.size, found.shape, found.translation, found.rotation)
    assert volume_iou(recovered, BODY)[0] > 0.8
    for words, image in bad_frames(client):
        seen = len(recover_node.output())
        trigger = client.node.create_client(Trigger, "/recover_node/trigger")
        until(trigger.service_is_ready, recover_node)
        verdict = trigger.call_async(Trigger.Request())

        def refused(image=image, verdict=verdict) -> bool:
            client.images.publish(image)
            time.sleep(0.2)
            return verdict.done()

        until(refused, recover_node)
        assert not verdict.result().success
        assert words in verdict.result().message
        assert "Traceback" not in recover_node.output()[seen:]
    assert len(client.answer(recover_node, client.image(), client.info())) == 1


def test_empty_tiny_and_swapped_frames_are_answered(recover_node, client):
    for value in (float("nan"), 0.0, float("inf"), -1.0):
        image = depth_to_message(np.full((120, 160), value), client.header())
        assert len(client.answer(recover_node, image, client.info())) == 0
    zeros = depth_to_message(np.zeros((120, 160)), client.header(), "16UC1")
    assert len(client.answer(recover_node, zeros, client.info())) == 0

    one = Camera(1, 1, 100.0, 100.0, 0.0, 0.0)
    for value in (float("nan"), 0.5):
        image = depth_to_message(np.full((1, 1), value), client.header())
        assert len(client.answer(recover_node, image, client.info(one))) <= 1

    native = client.image()
    swapped = client.image()
    swapped.is_bigendian = 1
    swapped.data = np.frombuffer(native.data, "<f4").astype(">f4").tobytes()
    first = client.answer(recover_node, native, client.info())
    second = client.answer(recover_node, swapped, client.info())
    np.testing.assert_allclose(second.size, first.size, rtol=1e-4)


def test_camera_info_that_is_missing_or_zero_is_named_and_recovered_from(recover_node, client):
    for size, info in ((50, None), (54, CameraInfo()), (58, CameraInfo(width=58, height=58))):
        camera = Camera(size, size, 50.0, 50.0, size / 2, size / 2)
        pending = client.node.create_client(Trigger, "/recover_node/trigger")
        until(pending.service_is_ready, recover_node)
        verdict = pending.call_async(Trigger.Request())

        def refused(camera=camera, info=info, verdict=verdict) -> bool:
            if info is not None:
                client.infos.publish(info)
            client.images.publish(client.image(camera))
            time.sleep(0.5)
            return verdict.done()

        until(refused, recover_node)
        assert not verdict.result().success
        assert "/depth/camera_info" in verdict.result().message
        assert len(client.answer(recover_node, client.image(camera), client.info(camera))) <= 1


def test_frames_change_their_size_from_one_moment_to_the_next(recover_node, client):
    for camera in (CAMERA, Camera(96, 72, 84.0, 84.0, 47.5, 35.5), Camera(200, 60, 140.0, 140.0, 99.5, 29.5), CAMERA):
        assert len(client.answer(recover_node, client.image(camera), client.info(camera))) == 1


def test_parameters_change_from_another_process(recover_node, client):
    image = client.image()
    before = client.answer(recover_node, image, client.info())
    for value in (3, 3.5):
        result = client.set(recover_node, "s", value)
        assert result.successful, result.reason
        names = GetParameters.Request(names=["s"])
        got = client.call(recover_node, GetParameters, "get_parameters", names).values[0]
        assert value in (got.integer_value, got.double_value)
    after = client.answer(recover_node, client.image(), client.info())
    assert abs(after.score[0] - before.score[0]) > 0.01
    for name, value, words in (
        ("s", -1, "out of range"),
        ("s", -1.0, "out of range"),
        ("s", float("nan"), "s"),
        ("s", "high", "expected 'Type.DOUBLE' got 'Type.STRING'"),
        ("tau", 0, "tau out of range"),
        ("method", "perhaps", "auto, network, symmetry, classic"),
        ("model", "other.safetensors", "no such model file"),
        ("device", "cuda:77", "device"),
        ("projection", "orthographic", "lifecycle set /recover_node deactivate"),
        ("max_objects", 0, "max_objects"),
        ("nonsense", 1, "undeclared"),
    ):
        result = client.set(recover_node, name, value)
        assert not result.successful, name
        assert words in result.reason
    assert client.set(recover_node, "s", 117.3).successful
    again = client.answer(recover_node, client.image(), client.info())
    assert again.score[0] == pytest.approx(before.score[0], abs=1e-3)
    request = DescribeParameters.Request(names=["s", "model"])
    s, model = client.call(recover_node, DescribeParameters, "describe_parameters", request).descriptors
    assert (s.floating_point_range[0].to_value, s.read_only, model.read_only) == (1000.0, False, False)


def test_publishers_come_and_go(recover_node, client, start):
    assert client.call(recover_node, SetBool, "enable", SetBool.Request(data=True)).success
    truth = client.listen("/synthetic_depth_node/truth")
    heard = client.listen("/recover_node/superquadrics")
    for parameters in (("objects:=1", "seed:=1"), ("objects:=2", "seed:=2", "encoding:=16UC1", "masks:=always")):
        source = start("synthetic_depth_node", "scene:=table", "rate:=5.0", *parameters)
        known, seen = len(truth), len(heard)

        def pair(known: int = known, seen: int = seen) -> tuple[PointCloud2, PointCloud2] | None:
            stamps = {(one.header.stamp.sec, one.header.stamp.nanosec): one for one in truth[known:]}
            for one in heard[seen:]:
                match = stamps.get((one.header.stamp.sec, one.header.stamp.nanosec))
                if match is not None:
                    return match, one
            return None

        expected, got = until(pair, recover_node)
        assert expected.header == got.header
        assert got.header.frame_id == "camera_depth_optical_frame"
        assert len(from_message(expected)) == int(parameters[0][-1])
        assert source.stop() == 0, source.output()
        assert "Traceback" not in source.output()
    image = client.image()
    assert len(client.answer(recover_node, image, client.info())) == 1


def test_a_deaf_subscription_names_the_publisher(client, start):
    process = start(
        "fitter_node",
        "qos_overrides./depth/image.subscription.reliability:=reliable",
        "no_frame_warning:=1.0",
    )
    deaf = client.node.create_publisher(
        Image, "depth/image", QoSProfile(depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT)
    )
    process.says("no depth image on /depth/image")
    until(lambda: "INCOMPATIBLE" in process.output(), process)
    client.node.destroy_publisher(deaf)
    assert len(client.answer(process, client.image(), client.info())) == 1
    assert process.stop(signal.SIGTERM) == 0, process.output()
    assert "Traceback" not in process.output()


def test_thesis_frames_are_recovered_in_the_cube_frame(client, start):
    source = start("synthetic_depth_node", "scene:=thesis", "rate:=5.0", "hold:=1000", "seed:=3")
    process = start("fitter_node", "projection:=orthographic", "s:=20")
    truth = client.listen("/synthetic_depth_node/truth")
    heard = client.listen("/fitter_node/superquadrics")
    answer = until(lambda: next((one for one in heard if one.header.frame_id == "unit_cube"), None), process)
    known = until(lambda: next((one for one in truth if one.header.frame_id == "unit_cube"), None), source)
    bodies = [
        Superquadric(one.size, one.shape, one.translation, one.rotation)
        for one in (from_message(known), from_message(answer))
    ]
    assert thesis_iou(*bodies)[0] > 0.3
    assert np.linalg.norm(bodies[0].translation - bodies[1].translation) < 0.2
    for one in (source, process):
        assert one.stop(times=2) == 0, one.output()
        assert "Traceback" not in one.output()


def test_recordings_are_replayed_with_their_masks(client, start, shared_data):
    frame = shared_data / "frames" / "felix_0.npz"
    with np.load(frame) as archive:
        shape, count = archive["depth"].shape, len(np.unique(archive["labels"])) - 1
    infos: list[CameraInfo] = []
    listener = client.node.create_subscription(CameraInfo, "depth/camera_info", infos.append, 5)
    process = start("recover_node", "method:=symmetry", "use_masks:=always")
    source = start("synthetic_depth_node", "scene:=replay", f"path:={frame}", "rate:=2.0", "loop:=false", "hold:=1000")
    heard = client.listen("/recover_node/superquadrics")
    seen = len(heard)
    message = until(lambda: next((one for one in heard[seen:] if one.width), None), process)
    assert len(from_message(message)) == count
    until(lambda: any((one.height, one.width) == shape for one in infos), process)
    client.node.destroy_subscription(listener)
    for one in (source, process):
        assert one.stop() == 0, one.output()


@pytest.mark.parametrize("content", [None, b"no safetensors at all"])
def test_a_missing_or_corrupt_model_ends_the_start_with_a_reason(start, tmp_path, content):
    path = tmp_path / "model.safetensors"
    if content is not None:
        path.write_bytes(content)
    process = start("recover_node", f"model:={path}")
    assert process.handle.wait(PATIENCE) == 1
    assert "cannot start" in process.output()
    assert str(path) in process.output()
    assert "Traceback" not in process.output()


@pytest.mark.parametrize(
    ("node", "parameter", "words"),
    [
        ("recover_node", "s:=1e9", "out of range"),
        ("synthetic_depth_node", "scene:=replay", "path"),
        ("recover_node", "qos_overrides./depth/image.subscription.reliability:=perhaps", "perhaps"),
    ],
)
def test_a_bad_parameter_ends_the_start_with_a_reason(start, node, parameter, words):
    process = start(node, parameter)
    assert process.handle.wait(PATIENCE) == 1
    assert words in process.output()
    assert "Traceback" not in process.output()


def test_cameras_that_would_have_one_name_are_refused(tmp_path):
    done = subprocess.run(
        command("recover_cameras", ["front", "wrist", "--ros-args", "-r", "__ns:=/arm"]),
        cwd=Path(__file__).resolve().parents[2],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 1
    assert "front and wrist are both /arm/recover_node" in done.stderr
    assert "Traceback" not in done.stderr


def test_ctrl_c_during_the_start_leaves_no_traceback(start):
    process = start("recover_node")
    process.says("warming up")
    assert process.stop(times=2) == 0, process.output()
    assert "Traceback" not in process.output()
