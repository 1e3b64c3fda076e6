"""The nodes as processes of their own: a peer beside them sends images, parameters and signals."""

import signal
from collections.abc import Callable, Iterator, Sequence

import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

from rcl_interfaces.srv import DescribeParameters
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from running_nodes import BODIES, PATIENCE, Peer, arguments, environment, until
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from started_nodes import Child
from std_srvs.srv import SetBool

from sq_msgs_py.superquadrics import SuperquadricArray, from_message
from sq_perception.geometry.metrics import volume_iou
from sq_perception.nodes.frame import stamp_of
from sq_perception.recordings.publication import superquadrics

BODY = BODIES[:1]


class Process(Child):
    def says(self, words: str) -> None:
        until(lambda: words in self.output(), (self,))

    def stop(self, number: int = signal.SIGINT, times: int = 1) -> int:
        for _ in range(times):
            self.send_signal(number)
        return self.wait(PATIENCE)


def answer(peer: Peer, process: Process, image: Image, info: CameraInfo) -> SuperquadricArray:
    return from_message(peer.ask(f"/{process.name}", image, info, (process,)).message)


def stopped(process: Process, *, number: int = signal.SIGINT, times: int = 1) -> None:
    """Ask a process to end, which must do so as if nothing had happened."""
    assert process.stop(number, times) == 0, process.output()
    assert "Traceback" not in process.output()


@pytest.fixture(scope="module")
def peer() -> Iterator[Peer]:
    with Peer() as one:
        yield one


@pytest.fixture(scope="module")
def start() -> Iterator[Callable[..., Process]]:
    """Starts nodes; whatever a test leaves running is killed at the end."""
    processes: list[Process] = []

    def begin(node: str, *parameters: str, before: Sequence[str] = ()) -> Process:
        processes.append(Process(node, [*before, *arguments(*parameters)], environment()))
        return processes[-1]

    yield begin
    for process in processes:
        process.kill()
        process.close()


@pytest.fixture(scope="module")
def recover_node(start: Callable[..., Process]) -> Iterator[Process]:
    """One node for all tests of what a running node lives through; it must end as if nothing had happened."""
    process = start("recover_node")
    process.says("ready")
    yield process
    stopped(process, times=2)


def test_parameters_change_from_another_process(recover_node, peer):
    node, alive = "/recover_node", (recover_node,)
    before = answer(peer, recover_node, *peer.frame(BODY))
    for value in (3, 3.5):
        (result,) = peer.set(node, alive, s=value)
        assert result.successful, result.reason
        assert peer.get(node, "s", alive=alive) == [value]
    after = answer(peer, recover_node, *peer.frame(BODY))
    assert abs(after.score[0] - before.score[0]) > 0.01
    for name, value, words in (
        ("s", -1.0, "out of range"),
        ("model", "other.safetensors", "no such model file"),
        ("device", "cuda:77", "device"),
        ("projection", "orthographic", "lifecycle set /recover_node deactivate"),
        ("nonsense", 1, "undeclared"),
    ):
        (result,) = peer.set(node, alive, **{name: value})
        assert not result.successful, name
        assert words in result.reason
    assert peer.set(node, alive, s=117.3)[0].successful
    again = answer(peer, recover_node, *peer.frame(BODY))
    assert again.score[0] == pytest.approx(before.score[0], abs=1e-3)
    request = DescribeParameters.Request(names=["s", "model"])
    s, model = peer.call(DescribeParameters, f"{node}/describe_parameters", request, alive).response.descriptors
    assert (s.floating_point_range[0].to_value, s.read_only, model.read_only) == (1000.0, False, False)


def test_publishers_come_and_go(recover_node, peer, start):
    assert peer.call(SetBool, "/recover_node/enable", SetBool.Request(data=True)).response.success
    truth: list[PointCloud2] = []
    peer.listen(PointCloud2, "/synthetic_depth_node/truth", truth.append)
    heard = peer.answers("/recover_node")
    for parameters, number in (
        (("objects:=1", "seed:=1"), signal.SIGINT),
        (("objects:=2", "seed:=2", "encoding:=16UC1", "masks:=always"), signal.SIGHUP),  # the end of a terminal
    ):
        source = start("synthetic_depth_node", "scene:=table", "rate:=5.0", *parameters)
        known, seen = len(truth), len(heard)

        def pair(known: int = known, seen: int = seen) -> tuple[PointCloud2, PointCloud2] | None:
            stamps = {stamp_of(one): one for one in truth[known:]}
            return next(((stamps[one.stamp], one.message) for one in heard[seen:] if one.stamp in stamps), None)

        expected, got = until(pair, (recover_node,))
        assert expected.header == got.header
        assert got.header.frame_id == "camera_depth_optical_frame"
        assert len(from_message(expected)) == int(parameters[0][-1])
        stopped(source, number=number)
    found = answer(peer, recover_node, *peer.frame(BODY))
    assert volume_iou(superquadrics(found), BODY)[0] > 0.8


def test_a_deaf_subscription_names_the_publisher(peer, start):
    reliable = "qos_overrides./depth/image.subscription.reliability:=reliable"
    process = start("fitter_node", reliable, "no_frame_warning:=1.0")
    best_effort = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT)
    deaf = peer.node.create_publisher(Image, "depth/image", best_effort)
    process.says("no depth image on /depth/image")
    process.says("best effort, volatile; INCOMPATIBLE")
    peer.node.destroy_publisher(deaf)
    assert len(answer(peer, process, *peer.frame(BODY))) == 1
    stopped(process, number=signal.SIGTERM)


@pytest.mark.parametrize(
    ("node", "parameter", "before", "words"),
    [
        ("recover_node", "qos_overrides./depth/image.subscription.reliability:=perhaps", (), "perhaps"),
        ("recover_node", "device:=tpu", (), "expected cpu, cuda or cuda:N"),
        ("recover_node", f"model:={__file__}", (), __file__),
        ("recover_cameras", "autostart:=false", ("front", "wrist", "--ros-args", "-r", "__ns:=/arm"),
         "front and wrist are both /arm/recover_node"),
    ],
)  # fmt: skip
def test_what_cannot_be_started_ends_with_a_reason(start, node, parameter, before, words):
    process = start(node, parameter, before=before)
    assert process.wait(PATIENCE) == 1
    assert words in process.output()
    assert "cannot start" in process.output() or node == "recover_cameras"
    assert "Traceback" not in process.output()


def test_bodies_of_two_cameras_have_names_of_their_own(peer, start):
    """Also said: what nodes that do not start themselves wait for."""
    process = start("recover_cameras", "autostart:=false", before=["front", "arm/wrist"])
    process.says("waiting for a lifecycle manager, or for ros2 lifecycle set /arm/wrist/recover_node configure")
    prefixes = [peer.get(f"/{one}/recover_node", "tf_prefix", alive=(process,)) for one in ("front", "arm/wrist")]
    assert prefixes == [["front_superquadric_"], ["arm_wrist_superquadric_"]]
    stopped(process)


def test_ctrl_c_during_the_start_leaves_no_traceback(start):
    process = start("recover_node")
    process.says("warming up")
    stopped(process, times=2)
