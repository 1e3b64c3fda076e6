"""The page of ``sq-perception view`` in a real browser: what it draws, what it asks for, and what its controls do."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")
pytest.importorskip("viser", reason="needs the extra 'view'")

from browser import Browser, executable
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from spun_nodes import SpunNodes
from std_msgs.msg import Header

from sq_msgs_py.depth_image import Intrinsics, depth_to_message, intrinsics_to_message
from sq_msgs_py.markers import PALETTE
from sq_msgs_py.superquadrics import CONVERGED, WEAK, SuperquadricArray, to_message
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.nodes.live_parameters import LiveParameters
from sq_perception.nodes.parameters import RecoverParameters
from sq_perception.nodes.view_node import ViewNode
from sq_perception.viewing import server
from sq_perception.viewing.page import Page

pytestmark = pytest.mark.skipif(executable() is None, reason="no Chromium or Chrome is installed")

NODE = "/bench/recover_node"
CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
IDS = (1, 8, 3)
BODIES = Superquadric(
    np.array([[0.10, 0.10, 0.10], [0.09, 0.07, 0.10], [0.12, 0.08, 0.06]]),
    np.array([[1.0, 1.0], [0.2, 0.2], [0.3, 1.0]]),
    np.array([[-0.25, -0.12, 1.0], [0.24, -0.1, 1.1], [0.0, 0.2, 0.9]]),
    np.array([[0, 0, 0, 1.0], [0.2, 0.3, 0.1, 0.9], [0.1, 0.0, 0.2, 0.95]]),
)


class FrameNode(Node):
    """What the page looks at: the parameters of the real node, and results that the test makes."""

    def __init__(self, context: Context) -> None:
        super().__init__("recover_node", namespace="/bench", context=context)
        self.settings = LiveParameters(self, RecoverParameters)
        self.results = self.create_publisher(PointCloud2, "~/superquadrics", 10)
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_timer(0.2, self._report)

    def _report(self) -> None:
        values = {
            "state": "active",
            "rate [Hz]": "28.25",
            "dropped": "4",
            "lost": "0",
            "last error": "<b>no & camera</b>",
        }
        pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
        status = DiagnosticStatus(name="bench/recover_node: frames", hardware_id=NODE, values=pairs)
        self.diagnostics.publish(DiagnosticArray(status=[status]))


class Bench(SpunNodes):
    """A camera (the peer), a frame node and the viewer in one process, a browser beside it."""

    def __init__(self, browser: Browser) -> None:
        super().__init__()
        self.browser = browser
        self.images = self.peer.create_publisher(Image, "depth/image", 1)
        self.infos = self.peer.create_publisher(CameraInfo, "depth/camera_info", 1)
        self.frames: FrameNode | None = None
        bound = server.listening_socket("127.0.0.1", 0)
        self.address = f"http://127.0.0.1:{bound.getsockname()[1]}"
        self.page = Page(bound, [NODE], 5000)
        self.view = ViewNode("sq_view", self.page, "depth/image", "depth/camera_info", [NODE], 10.0, self.context)
        self.kept = list(range(len(IDS)))
        self.speaks = True
        depth, _ = raycast.render(BODIES, CAMERA)
        self.depth = np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)
        self.peer.create_timer(0.1, self.publish)
        self.spin([self.view])
        self.start_frames()

    def start_frames(self) -> None:
        self.frames = FrameNode(self.context)
        self.add(self.frames)

    def stop_frames(self) -> None:
        frames, self.frames = self.frames, None
        assert frames is not None
        self.remove(frames)
        time.sleep(0.3)
        frames.destroy_node()

    def publish(self) -> None:
        header = Header(stamp=self.peer.get_clock().now().to_msg(), frame_id="camera_depth_optical_frame")
        known = Intrinsics(CAMERA.width, CAMERA.height, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
        self.infos.publish(intrinsics_to_message(known, header))
        self.images.publish(depth_to_message(self.depth, header))
        frames = self.frames
        if frames is not None and self.speaks:
            kept = np.array(self.kept, dtype=int)
            frames.results.publish(
                to_message(
                    SuperquadricArray(
                        size=BODIES.size[kept],
                        shape=BODIES.shape[kept],
                        translation=BODIES.translation[kept],
                        rotation=BODIES.rotation[kept],
                        score=np.full(len(kept), 0.875),
                        residual=np.zeros(len(kept)),
                        sigma_size=np.tile([0.001, np.nan, 0.0132], (len(kept), 1)),
                        id=np.array(IDS, dtype=np.uint32)[kept],
                        status=np.array([CONVERGED, CONVERGED, WEAK], dtype=np.uint32)[kept],
                    ),
                    header,
                )
            )

    def parameter(self, name: str) -> Any:
        assert self.frames is not None
        return self.frames.get_parameter(name).value

    def close(self) -> None:
        self.view.close()
        super().close()


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    with Browser(960, 640) as browser, Bench(browser) as made:
        yield made


def input_of(browser: Browser, name: str) -> str:
    """A JavaScript expression of the input field that belongs to a label."""
    return (
        "document.getElementById([...document.querySelectorAll('label[for]')]"
        f".filter(one => one.innerText.trim() === '{name}')[0].htmlFor)"
    )


def shown(browser: Browser, name: str) -> str:
    return str(browser.evaluate(f"{input_of(browser, name)}.value"))


def type_in(browser: Browser, name: str, text: str) -> None:
    browser.evaluate(f"{input_of(browser, name)}.focus(); {input_of(browser, name)}.select()")
    browser.call("Input.insertText", text=text)


def colours_at(bench: Bench, points: np.ndarray) -> np.ndarray:
    """Colours (n, 3) of the picture where points of the optical frame must be, seen through the camera."""
    box = bench.browser.evaluate(
        "(() => { const b = document.querySelector('canvas').getBoundingClientRect();"
        "return [b.x, b.y, b.width, b.height]; })()"
    )
    zoom = box[3] / CAMERA.height
    offset = CAMERA.project(points) - [0.5 * (CAMERA.width - 1), 0.5 * (CAMERA.height - 1)]
    pixels = np.rint(np.array([box[0] + box[2] / 2, box[1] + box[3] / 2]) + zoom * offset).astype(int)
    picture = bench.browser.picture()
    around = [picture[v - 2 : v + 3, u - 2 : u + 3].reshape(-1, 3).mean(axis=0) for u, v in pixels]
    return np.array(around)


def hues(colours: np.ndarray) -> np.ndarray:
    """Degrees."""
    pixels = np.asarray(colours, dtype=np.float32).reshape(1, -1, 3) / 255
    return cv2.cvtColor(pixels, cv2.COLOR_RGB2HSV)[0, :, 0]


def apart(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    return np.abs((left - right + 180) % 360 - 180)


def test_nothing_is_subscribed_to_until_somebody_looks(bench: Bench) -> None:
    time.sleep(0.5)
    assert bench.images.get_subscription_count() == 0
    bench.browser.open(bench.address)
    bench.browser.until(lambda: bench.page.watched)
    bench.browser.until(lambda: bench.images.get_subscription_count() == 1)


def test_the_table_says_what_the_message_says(bench: Bench) -> None:
    browser = bench.browser
    browser.until(lambda: "3 bodies" in browser.text() and "28.2 Hz" in browser.text())
    rows = browser.evaluate(
        f"[...document.querySelectorAll('[data-node=\"{NODE}\"] tbody tr')].map(row => row.innerText)"
    )
    words = [row.split() for row in rows]
    assert [row[0] for row in words] == ["1", "8", "3"]
    assert words[1] == ["8", "90.0", "±1.0", "70.0", "±", "?", "100.0", "±13", "0.20", "0.20", "0.88", "good"]
    assert words[2][-1] == "weak"
    # What others say is text, never a part of the page.
    assert "<b>no & camera</b>" in browser.text()
    assert "4 dropped" in browser.text()
    assert "active, alive" in browser.text()
    browser.until(lambda: "160 × 120" in browser.text())  # the image comes on its own


def test_bodies_are_drawn_where_and_as_they_are(bench: Bench) -> None:
    """Through the camera: its pixel of every body's centre has the hue of that body's id."""
    browser = bench.browser
    browser.click("View")
    for label in ("Points", "Ids", "Shells"):
        browser.click(label)
    browser.click("camera")
    expected = hues(255 * PALETTE[np.array(IDS) % len(PALETTE)])
    assert min(apart(expected[0], expected[1]), apart(expected[1], expected[2]), apart(expected[0], expected[2])) > 40

    def alike() -> bool:
        return bool((apart(hues(colours_at(bench, BODIES.translation)), expected) < 15).all())

    browser.until(alike)
    # And beside them there is nothing: the view is no larger than that of the camera.
    beside = np.array([[-0.25, 0.25, 1.0], [0.25, 0.25, 1.0]])
    assert (np.ptp(colours_at(bench, beside), axis=1) < 12).all()

    bench.kept = [0, 2]
    browser.until(lambda: np.ptp(colours_at(bench, BODIES.translation)[1]) < 12)
    assert apart(hues(colours_at(bench, BODIES.translation)), expected)[[0, 2]].max() < 15
    browser.click("Bodies")
    browser.until(lambda: "2 bodies" in browser.text())


def test_a_parameter_is_changed_and_a_refusal_is_shown(bench: Bench) -> None:
    browser = bench.browser
    browser.click("Parameters")
    browser.until(lambda: "tau" in browser.text())
    assert shown(browser, "s") == "117.3"
    type_in(browser, "s", "42.125")
    browser.until(lambda: bench.parameter("s") == 42.125)
    browser.until(lambda: "s is now 42.125" in browser.text())

    assert bench.frames is not None
    bench.frames.set_parameters([Parameter("depth_max", value=10.0)])
    browser.until(lambda: shown(browser, "depth_max") == "10")
    type_in(browser, "depth_min", "20")
    browser.until(lambda: "expected depth_min < depth_max, got 20 and 10" in browser.text())
    assert bench.parameter("depth_min") == 0.0
    browser.until(lambda: shown(browser, "depth_min") == "0")


def test_a_node_that_dies_is_silent_and_comes_back(bench: Bench) -> None:
    browser = bench.browser
    bench.stop_frames()
    browser.until(lambda: "silent for" in browser.text())
    bench.start_frames()
    browser.until(lambda: "alive" in browser.text())
    # The parameters are those of the new node.
    browser.until(lambda: shown(browser, "s") == "117.3")
    type_in(browser, "tau", "5.5")
    browser.until(lambda: bench.parameter("tau") == 5.5)


def test_the_page_asks_this_machine_alone(bench: Bench) -> None:
    asked = bench.browser.requested()
    assert asked
    own = bench.address.removeprefix("http://")
    assert {one.split("/")[2] for one in asked} == {own}


def test_with_the_last_browser_the_subscriptions_go(bench: Bench) -> None:
    bench.browser.open("about:blank")
    bench.browser.until(lambda: not bench.page.watched)
    bench.browser.until(lambda: bench.images.get_subscription_count() == 0)
