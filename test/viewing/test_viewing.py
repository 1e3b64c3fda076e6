"""What the page of ``sq-perception view`` is made of, without ROS and without a browser."""

from __future__ import annotations

import importlib.util
import math
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from sq_perception.commands import view
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.recordings.bag_camera import camera_info_topic
from sq_perception.viewing import controls, drawings, tables
from sq_perception.viewing.drawings import Bodies
from sq_perception.viewing.tables import NodeState

CAMERA = Camera(64, 48, 60.0, 61.0, 31.0, 24.5)
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


def body(size: tuple[float, float, float] = (0.1, 0.07, 0.05), shape: tuple[float, float] = (0.4, 0.9)) -> Superquadric:
    turn = np.array([0.1, -0.2, 0.3, 0.9])
    return Superquadric(np.array(size), np.array(shape), np.array([0.1, 0.2, 0.8]), turn / np.linalg.norm(turn))


def bodies(sigma: float = 0.001, weak: bool = False) -> Bodies:
    one = body()
    return Bodies(Superquadric.stack([one]), np.full((1, 3), sigma), np.ones(1), [7], [weak], np.ones((1, 3)))


# The scene


@pytest.mark.parametrize("most", [1, 7, 100, 64 * 48, 10**6])
def test_the_cloud_is_the_image_thinned(most: int, rng: np.random.Generator) -> None:
    depth = rng.uniform(0.5, 2.0, (48, 64)).astype(np.float32)
    depth[rng.random((48, 64)) < 0.3] = np.nan
    points = drawings.cloud(depth, CAMERA, (0.5, 2.0), most)
    assert len(points.points) <= most
    assert points.points.dtype == np.float32
    assert points.colours.shape == points.points.shape
    pixels = CAMERA.project(points.points)
    columns, rows = np.rint(pixels).astype(int).T
    np.testing.assert_allclose(pixels, np.rint(pixels), atol=1e-3)
    np.testing.assert_allclose(depth[rows, columns], points.points[:, 2], rtol=1e-6)
    if most >= depth.size:
        assert len(points.points) == np.isfinite(depth).sum()


def test_an_image_without_a_reading_has_no_points() -> None:
    depth = np.full((48, 64), np.nan, np.float32)
    assert drawings.depth_span(depth) is None
    points = drawings.cloud(depth, CAMERA, (0.0, 1.0), 100)
    assert points.points.shape == points.colours.shape == (0, 3)
    assert drawings.picture(depth, (0.0, 1.0)).shape == (288, 384, 3)


def test_colours_go_with_depth_and_holes_are_dark() -> None:
    colours = drawings.coloured(np.array([[0.5, 1.0, np.nan, 0.1, 9.0]], np.float32), (0.5, 1.0))[0].astype(int)
    assert colours[0][0] > colours[0][2] + 50, "near is red"
    assert colours[1][2] > colours[1][0] + 50, "far is blue"
    assert colours[2].max() < 50
    np.testing.assert_array_equal(colours[3:], colours[:2])


def test_the_span_is_steady() -> None:
    assert drawings.steady_span(None, (0.5, 1.0)) == (0.5, 1.0)
    assert drawings.steady_span((0.5, 1.0), (0.51, 1.02)) == (0.5, 1.0)
    assert drawings.steady_span((0.5, 1.0), (0.5, 1.2)) == (0.5, 1.2)


@pytest.mark.parametrize("shape", [(0.1, 0.1), (1.0, 1.0), (0.1, 1.0), (1.9, 0.5)])
def test_a_mesh_is_closed_outwards_and_on_the_surface(shape: tuple[float, float]) -> None:
    one = body(shape=shape)
    vertices, faces = drawings.mesh_vertices(one).astype(float), drawings.mesh_faces()
    assert faces.max() == len(vertices) - 1
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert 0.9 * float(one.volume()) < mesh.volume <= float(one.volume())
    centred = Superquadric(one.size, one.shape, np.zeros(3), IDENTITY)
    np.testing.assert_allclose(centred.gauge(vertices), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.abs(vertices).max(axis=0), one.size, rtol=1e-6)


def test_a_shell_is_two_deviations_larger_but_never_huge() -> None:
    one = body()
    around = drawings.shell(one, np.array([0.01, np.nan, 5.0]))
    assert around is not None
    np.testing.assert_allclose(around.size, [0.12, 0.07, 0.15])
    assert drawings.shell(one, np.full(3, np.nan)) is None
    assert drawings.shell(one, np.zeros(3)) is None


def test_a_label_stands_above_its_body() -> None:
    one = body()
    place = drawings.label_position(one)
    vertices = one.to_parent(drawings.mesh_vertices(one).astype(float))
    assert place[1] < vertices[:, 1].min()
    assert place[1] > vertices[:, 1].min() - 0.02


@pytest.mark.parametrize("camera", [CAMERA, unit_cube.camera(32)], ids=["pinhole", "orthographic"])
def test_the_view_volume_ends_at_the_corners_of_the_image(camera: Camera) -> None:
    lines = drawings.view_volume(camera, 0.5)
    assert lines.shape == ((8 if camera.is_pinhole else 12), 2, 3)
    pixels = camera.project(lines[:4, 1])
    np.testing.assert_allclose(pixels.min(axis=0), [-0.5, -0.5], atol=1e-4)
    np.testing.assert_allclose(pixels.max(axis=0), [camera.width - 0.5, camera.height - 0.5], atol=1e-4)


def test_misuse_is_refused() -> None:
    with pytest.raises(ValueError, match="number of points"):
        drawings.cloud(np.ones((48, 64), np.float32), CAMERA, (0, 1), 0)
    with pytest.raises(ValueError, match="does not fit"):
        drawings.cloud(np.ones((4, 6), np.float32), CAMERA, (0, 1), 9)


# Controls


def describing(
    name: str, within: tuple[float, float] | None = None, constraints: str = "", read_only: bool = False
) -> SimpleNamespace:
    """The fields of a rcl_interfaces/ParameterDescriptor; the type of the range is that of its ends."""
    ranges = [] if within is None else [SimpleNamespace(from_value=within[0], to_value=within[1], step=0)]
    is_float = within is not None and isinstance(within[0], float)
    return SimpleNamespace(
        name=name,
        description="",
        additional_constraints=constraints,
        read_only=read_only,
        floating_point_range=ranges if is_float else [],
        integer_range=[] if is_float else ranges,
    )


@pytest.mark.parametrize(
    ("about", "given", "kind", "value"),
    [
        (describing("tracking"), True, "bool", True),
        (describing("method", constraints="one of: auto, network"), "auto", "choice", "auto"),
        (describing("frame"), "map", "text", "map"),
        (describing("s", (0.1, 1000.0)), 117.3, "number", 117.3),
        (describing("alpha", (0.0, 1.0)), 0.7, "number", 0.7),
        (describing("alpha", (0.0, 1.0)), 1, "number", 1.0),
        (describing("objects", (1, 100)), 20, "number", 20),
        (describing("seed", (0, 2**31 - 1)), 0, "number", 0),
        (describing("free"), 2.5, "number", 2.5),
    ],
)
def test_a_control_fits_its_parameter(about: SimpleNamespace, given: object, kind: str, value: object) -> None:
    made = controls.control(about, given)
    assert (made.kind, made.value) == (kind, value)
    assert type(made.value) is type(value)
    again = made.wanted(made.value)
    assert again == given
    assert type(again) is type(value)


@pytest.mark.parametrize(
    ("about", "given"),
    [
        (describing("model", read_only=True), ""),
        (describing("list"), [1, 2]),
        (describing("unset"), None),
        (describing("odd"), float("nan")),
        (describing("use_sim_time"), False),
        (describing("qos_overrides./depth/image.subscription.depth"), 1),
    ],
)
def test_what_cannot_be_changed_in_the_page_has_no_control(about: SimpleNamespace, given: object) -> None:
    assert controls.control(about, given) is None


def test_what_the_node_holds_is_shown_even_outside_of_its_range() -> None:
    made = controls.control(describing("s", (0.0, 1.0)), 5.0)
    assert (made.low, made.high) == (0.0, 5.0)
    made = controls.control(describing("method", constraints="one of: a, b"), "new")
    assert made.choices == ("a", "b", "new")


@pytest.mark.parametrize(
    ("within", "ends"),
    [
        ((0.0, math.inf), (0.0, None)),
        ((-math.inf, math.inf), (None, None)),
        ((-sys.float_info.max, sys.float_info.max), (-sys.float_info.max, sys.float_info.max)),
    ],
)
def test_a_range_may_be_open(within: tuple[float, float], ends: tuple[float | None, float | None]) -> None:
    made = controls.control(describing("gain", within), 1.0)
    assert (made.kind, made.value, (made.low, made.high)) == ("number", 1.0, ends)


def test_half_a_number_is_no_wish() -> None:
    assert controls.control(describing("s"), 1.0).wanted(float("nan")) is None


def test_every_live_parameter_of_the_nodes_has_a_control() -> None:
    """Through the descriptors that the nodes really declare."""
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    from dataclasses import fields

    from sq_perception.nodes.live_parameters import describe
    from sq_perception.nodes.parameters import RecoverParameters

    for one in fields(RecoverParameters):
        made = controls.control(describe(one), one.default)
        assert (made is not None) == (one.metadata["live"] and not isinstance(one.default, tuple)), one.name
        if made is None:
            continue
        if one.metadata["choices"]:
            assert made.choices == one.metadata["choices"]
        if one.metadata["within"]:
            assert (made.low, made.high) == one.metadata["within"]
        assert one.metadata["description"] in made.hint


# Words


def test_a_table_has_a_row_for_every_body_and_says_what_failed() -> None:
    state = NodeState("/recover_node", 0.1)
    text = tables.bodies_table(bodies(np.nan, weak=True), state)
    assert text.count("<tr") == 2
    assert "± ?" in text
    assert ">weak<" in text
    none = Bodies(
        Superquadric.stack([]), np.empty((0, 3)), np.empty(0), [], [], np.empty((0, 3)), failed=list(range(1, 9))
    )
    text = tables.bodies_table(none, state)
    assert "no bodies" in text
    assert "no fit: 1, 2, 3, 4, 5 and 3 more" in text
    assert "No result" in tables.bodies_table(None, state)


@pytest.mark.parametrize(
    ("state", "words"),
    [
        (NodeState("/n"), "not there"),
        (NodeState("/n", is_there=True), "no result yet"),
        (NodeState("/n", is_there=True, diagnostics={"state": "inactive"}), "inactive, no result yet"),
        (NodeState("/n", age=0.2, is_there=True, diagnostics={"state": "active"}), "active, alive"),
        (NodeState("/n", age=65.0), "silent for 65 s"),
        (NodeState("/n", age=600.0), "silent for 10 min"),
        (NodeState("/n", age=9000.0), "silent for 2 h"),
    ],
)
def test_a_state_in_words(state: NodeState, words: str) -> None:
    assert words in tables.node_status(state)


def test_words_from_outside_are_escaped() -> None:
    evil = "<script>alert(1)</script>"
    values = dict.fromkeys(
        ("state", "rate [Hz]", "stamp to result: median [ms]", "dropped", "tracks", "last error"), evil
    )
    state = NodeState(evil, 0.1, values, True, evil)
    texts = [
        tables.node_status(state),
        tables.bodies_table(bodies(), state),
        tables.source_status(evil, (1, 1), 1.0, evil, ""),
        tables.source_status(evil, None, 1.0, evil, evil),
        tables.answer(evil, False),
    ]
    for text in texts:
        assert "<script" not in text
        assert "alert(1)" in text or "data-node" in text


# The server


@pytest.fixture
def taken() -> Iterator[int]:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        one.listen()
        yield one.getsockname()[1]


def test_requests_of_strangers_are_refused() -> None:
    pytest.importorskip("viser", reason="needs the extra 'view'")
    from sq_perception.viewing.server import refusal

    names = frozenset({"robot", "robot.local"})
    for host in ("localhost:8080", "127.0.0.1:8080", "[::1]:8080", "192.168.1.7:9000", "robot.local:8080", "Robot"):
        assert refusal({"Host": host}, names) == ""
        assert refusal({"Host": host, "Origin": f"http://{host}"}, names) == ""
        assert "must not talk" in refusal({"Host": host, "Origin": "https://evil.example"}, names)
        for other in ("null", "http://[", f"http://{host}/", host, ""):
            assert "must not talk" in refusal({"Host": host, "Origin": other}, names)
    for host in ("evil.example", "evil.example:8080", "", "localhost.evil.example", "localhost@evil.example", "a b"):
        assert "no name of this machine" in refusal({"Host": host, "Origin": f"http://{host}"}, names)


def test_the_running_server_refuses_strangers_and_opens_no_tunnel() -> None:
    pytest.importorskip("viser", reason="needs the extra 'view'")
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    from sq_perception.viewing import server

    bound = server.listening_socket("127.0.0.1", 0)
    made = server.serve(bound)
    try:
        address = f"127.0.0.1:{bound.getsockname()[1]}"
        assert made.get_port() == bound.getsockname()[1]
        assert made.request_share_url() is None
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://{address}", origin="http://evil.example", proxy=None)
        connect(f"ws://{address}", origin=f"http://{address}", proxy=None).close()
    finally:
        made.stop()


def test_a_port_that_is_taken_is_an_error_in_words(taken: int) -> None:
    pytest.importorskip("viser", reason="needs the extra 'view'")
    from sq_perception.viewing.server import ServerError, listening_socket

    with pytest.raises(ServerError, match=f"--port: {taken} of 127.0.0.1 cannot be used.*in use.*another --port"):
        listening_socket("127.0.0.1", taken)
    with pytest.raises(ServerError, match="--host: expected an address of this machine"):
        listening_socket("203.0.113.1", 0)
    with listening_socket("127.0.0.1", 0) as free:
        assert free.getsockname()[1] > 0


def test_decimals_may_be_typed_whatever_the_value_at_the_beginning() -> None:
    pytest.importorskip("viser", reason="needs the extra 'view'")
    from sq_perception.viewing.page import Page
    from sq_perception.viewing.server import listening_socket

    given = [controls.control(describing("depth_min", (0.0, 100.0)), 0.0), controls.control(describing("free"), 2.5)]
    with listening_socket("127.0.0.1", 0) as bound:
        page = Page(bound, ["/a"])
        try:
            page.show_controls("/a", given)
            for handle in page._nodes["/a"].handles.values():
                assert handle.precision >= 3  # what a browser keeps of 0.125
        finally:
            page.close()


def test_the_page_draws_what_is_there_and_takes_away_what_is_not() -> None:
    """Without a browser: what viser is told to show of two nodes, frame by frame."""
    pytest.importorskip("viser", reason="needs the extra 'view'")
    from sq_perception.viewing.page import Page
    from sq_perception.viewing.server import listening_socket

    with listening_socket("127.0.0.1", 0) as bound:
        page = Page(bound, ["/a", "/a/b"])
        try:
            cube = unit_cube.camera(64, 48)
            for camera, depth, lines, far in ((CAMERA, np.nan, 8, 1e-3), (CAMERA, 0.8, 8, 0.32), (cube, 0.8, 12, 1.0)):
                page.show_depth(np.full((48, 64), depth, np.float32), camera)
                volume = page._scene._handles["", "/camera"].points
                assert volume.shape == (lines, 2, 3)
                assert volume[..., 2].max() == pytest.approx(far)
            page.show_bodies(bodies(), NodeState("/a/b", age=99.0))
            for found, parts in (
                (bodies(), {"surface", "id", "shell"}),
                (bodies(np.nan), {"surface", "id"}),
                (None, set()),
                (bodies(), {"surface", "id", "shell"}),
            ):
                page.show_bodies(found, NodeState("/a", age=0.0))
                assert {path for node, path in page._scene._handles if node == "/a"} == {
                    f"/bodies/a/7/{x}" for x in parts
                }
            fresh, silent = (page._scene._handles[node, f"/bodies{node}/7/surface"].opacity for node in ("/a", "/a/b"))
            assert silent < fresh
            assert page._scene._handles["/a/b", "/bodies/a/b/7/id"].text == "b 7"
            page._wanted["Shells"].value = False
            page.show_bodies(bodies(), NodeState("/a", age=0.0))
            assert ("/a", "/bodies/a/7/shell") not in page._scene._handles
        finally:
            page.close()


# The command


def test_the_command_says_what_is_wrong(taken: int, capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    for arguments, words in (
        (["--node", "no node!"], "--node: expected a name like /recover_node"),
        (["--max-points", "0"], "--max-points: expected at least 1"),
        (["--rate", "nan"], "--rate: expected"),
        (["--port", "70000"], "--port: expected 0 to 65535"),
    ):
        with pytest.raises(SystemExit) as stop:
            view.main(arguments)
        assert stop.value.code == 2
        assert words in capsys.readouterr().err
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    pytest.importorskip("viser", reason="needs the extra 'view'")
    assert view.main(["--port", str(taken)]) == 1
    said = capsys.readouterr().err
    assert said.startswith("sq-perception: --port: ")
    assert said.count("\n") == 1
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert view.main([]) == 1
    remedy = "pip install 'sq_perception[ros]', or source a ROS 2 Jazzy installation"
    assert capsys.readouterr().err == f"sq-perception: view needs ROS 2 in Python: {remedy}\n"


def test_without_the_viewer_s_library_the_command_says_how_to_get_it() -> None:
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    code = "import sys; sys.modules['viser'] = None; from sq_perception.commands import view; sys.exit(view.main([]))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert done.returncode == 1
    assert done.stderr.startswith("sq-perception: view: viser cannot be imported, ")
    assert "pip install '.[view]'" in done.stderr
    assert done.stderr.count("\n") == 1


def test_the_camera_info_is_beside_the_image() -> None:
    assert camera_info_topic("depth/image") == "depth/camera_info"
    assert camera_info_topic("/camera/depth/image_rect_raw") == "/camera/depth/camera_info"
    assert camera_info_topic("image") == "camera_info"


def test_the_help_names_every_option() -> None:
    text = view._parser().format_help()
    for option in ("--node", "--depth", "--camera-info", "--host", "--port", "--max-points", "--rate"):
        assert re.search(rf"^  {option}\b", text, re.MULTILINE)
