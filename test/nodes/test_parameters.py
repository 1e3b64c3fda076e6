"""Parameters: descriptors say what the checks do, and the shipped YAML files hold the defaults."""

import importlib
import json
from collections.abc import Iterator
from dataclasses import asdict, fields, replace
from typing import Any

import pytest
import yaml

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

from rclpy.context import Context
from rclpy.exceptions import InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from sq_perception.nodes.grasp_node import GraspParameters
from sq_perception.nodes.parameters import FitterParameters, LiveParameters, ParameterError, RecoverParameters, describe
from sq_perception.nodes.synthetic_depth_node import SyntheticParameters

KINDS = {
    "recover_node": RecoverParameters,
    "fitter_node": FitterParameters,
    "grasp_node": GraspParameters,
    "synthetic_depth_node": SyntheticParameters,
}


@pytest.fixture(scope="module")
def context() -> Iterator[Context]:
    one = Context()
    one.init()
    yield one
    one.try_shutdown()


@pytest.fixture
def make_node(context: Context) -> Iterator[Any]:
    nodes = []

    def make(**overrides: Any) -> Node:
        node = Node(
            f"parameters_{len(nodes)}", context=context, start_parameter_services=False,
            parameter_overrides=[Parameter(name, value=value) for name, value in overrides.items()],
        )
        nodes.append(node)
        return node

    yield make
    for node in nodes:
        node.destroy_node()


@pytest.mark.parametrize("name", KINDS)
def test_the_shipped_file_holds_every_parameter_with_its_default(name, repository):
    with open(repository / "config" / f"{name}.yaml", encoding="utf-8") as file:
        content = yaml.safe_load(file)
    assert content == {"/**": {"ros__parameters": json.loads(json.dumps(asdict(KINDS[name]())))}}


def test_the_reference_is_what_the_generator_writes(repository, monkeypatch):
    monkeypatch.syspath_prepend(repository / "docs_build")
    reference: Any = importlib.import_module("parameter_reference")
    assert reference.KINDS == KINDS
    for name in KINDS:
        written = (repository / "config" / f"{name}.yaml").read_text(encoding="utf-8")
        assert written == reference.yaml_text(name), "run python docs_build/parameter_reference.py"


@pytest.mark.parametrize("kind", KINDS.values())
def test_every_parameter_explains_itself_and_keeps_its_range(make_node, kind):
    node = make_node()
    live = LiveParameters(node, kind, locked=lambda: "")
    assert live.current == kind()
    for one in fields(kind):
        descriptor = node.describe_parameter(one.name)
        assert len(descriptor.description) > 10
        assert not descriptor.read_only
        assert describe(one).read_only != one.metadata["live"]
        if one.metadata["within"]:
            low, high = one.metadata["within"]
            kept = type(one.default)
            for outside in (kept(low) - 1, kept(high) + 1):
                result = node.set_parameters([Parameter(one.name, value=outside)])[0]
                assert not result.successful
                assert f"{one.name} out of range" in result.reason
    assert live.current == kind()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0, 0, 1e9, "3", True, None, [1.0]])
def test_s_refuses_what_is_no_sharpness(make_node, value):
    node = make_node()
    live = LiveParameters(node, RecoverParameters)
    assert not node.set_parameters([Parameter("s", value=value)])[0].successful
    assert live.current == RecoverParameters()
    if value is not None:
        with pytest.raises(InvalidParameterValueException, match=r": s$"):
            LiveParameters(make_node(s=value), RecoverParameters)


def test_changes_arrive_as_a_whole_and_integers_pass_as_floats(make_node):
    """Given at the start or set: who reads them later expects what the description says."""
    node = make_node(tau=2, model="weights.safetensors", workspace=[0, 0, 0, 1, 1, 1])
    live = LiveParameters(node, RecoverParameters)
    before = live.current
    assert (before.s, before.tau, before.model) == (117.3, 2.0, "weights.safetensors")
    assert node.get_parameter("tau").type_ == Parameter.Type.DOUBLE
    assert node.set_parameters_atomically([Parameter("s", value=3), Parameter("tau", value=1.5)]).successful
    assert (live.current.s, live.current.tau) == (3.0, 1.5)
    assert isinstance(live.current.s, float)
    assert (before.s, before.tau) == (117.3, 2.0)
    assert node.get_parameter("s").type_ == Parameter.Type.DOUBLE
    assert node.get_parameter("workspace").type_ == Parameter.Type.DOUBLE_ARRAY
    assert node.get_parameter("max_objects").type_ == Parameter.Type.INTEGER


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"s": "sharp"}, "expected 'Type.DOUBLE' got 'Type.STRING'"),
        ({"method": "maybe"}, "auto, network, symmetry, classic"),
        ({"max_objects": 0}, "out of range"),
        ({"depth_max": 0.5, "depth_min": 0.6}, "depth_min < depth_max"),
        ({"projection": "orthographic"}, "read-only"),
        ({"s": 5.0, "tau": -1}, "tau"),
    ],
)
def test_a_refused_change_changes_nothing_and_says_why(make_node, changes, words):
    node = make_node()
    live = LiveParameters(node, RecoverParameters)
    result = node.set_parameters_atomically([Parameter(name, value=value) for name, value in changes.items()])
    assert not result.successful
    assert words in result.reason
    assert live.current == RecoverParameters()


@pytest.mark.parametrize(
    ("kind", "overrides", "words"),
    [
        (RecoverParameters, {"s": 1e6}, "Parameter s out of range"),
        (RecoverParameters, {"projection": "fisheye"}, "pinhole, orthographic"),
        (RecoverParameters, {"model": 3}, "model"),
        (RecoverParameters, {"tf_prefix": ""}, "expected something before the ids"),
        *((RecoverParameters, {"tf_prefix": prefix}, "tf_prefix: expected") for prefix in ("/body", "my body")),
        *((RecoverParameters, {"target_frame": name}, "target_frame: expected") for name in ("/map", "a//b", "a b")),
        (RecoverParameters, {"fixed_frame": "/map"}, "fixed_frame: expected"),
        (RecoverParameters, {"target_frame": "map", "projection": "orthographic"}, "target_frame: expected"),
        (RecoverParameters, {"fixed_frame": "map", "projection": "orthographic"}, "fixed_frame: expected"),
        (RecoverParameters, {"depth_min": 2.0, "depth_max": 1.0}, "depth_min < depth_max"),
        (SyntheticParameters, {"scene": "replay"}, "path"),
        (SyntheticParameters, {"scene": "thesis", "encoding": "32FC1"}, "mono8 or mono16"),
        (SyntheticParameters, {"scene": "table", "encoding": "mono8"}, "16UC1 or 32FC1"),
        (SyntheticParameters, {"sensor": "lidar"}, "ideal, kinect_v1, azure_kinect, realsense_d435, zed"),
        (SyntheticParameters, {"scene": "thesis", "sensor": "zed"}, "sensor: expected ideal for scene = thesis"),
        (SyntheticParameters, {"sensor": "zed", "noise": 0.001}, "noise: expected 0 for sensor = zed"),
        (SyntheticParameters, {"rate": 0}, "Parameter rate out of range Min: 0.1, Max: 200.0"),
    ],
)
def test_a_bad_start_is_refused_with_a_reason(make_node, kind, overrides, words):
    with pytest.raises((ParameterError, InvalidParameterValueException), match=words):
        LiveParameters(make_node(**overrides), kind)


def test_what_is_not_live_changes_while_it_is_not_locked(make_node):
    node, reason = make_node(), [""]
    live = LiveParameters(node, RecoverParameters, locked=lambda: reason[0])
    assert node.set_parameters([Parameter("projection", value="orthographic")])[0].successful
    reason[0] = "is read when the node is configured"
    refused = node.set_parameters([Parameter("projection", value="pinhole")])[0]
    assert (refused.successful, refused.reason) == (False, "projection: is read when the node is configured")
    assert node.set_parameters([Parameter("s", value=3)])[0].successful
    assert (live.current.projection, live.current.s) == ("orthographic", 3.0)


def test_a_check_may_refuse_and_a_listener_hears_what_was_set(make_node):
    heard = []

    def check(candidate, names):
        if "model" in names and candidate.model == "bad":
            raise ValueError("model: no such file")
        if candidate.model == "secret":
            raise PermissionError(13, "Permission denied", candidate.model)

    node = make_node()
    live = LiveParameters(node, RecoverParameters, check=check, changed=lambda new, names: heard.append((new, names)))
    refused = node.set_parameters_atomically([Parameter("model", value="bad"), Parameter("s", value=3.0)])
    assert (refused.successful, refused.reason) == (False, "model: no such file")
    assert "Permission denied" in node.set_parameters([Parameter("model", value="secret")])[0].reason
    assert (live.current, heard) == (RecoverParameters(), [])
    assert node.set_parameters_atomically([Parameter("model", value="good"), Parameter("s", value=3.0)]).successful
    assert heard == [(live.current, frozenset({"model", "s"}))]
    kept = live.current
    assert node.set_parameters([Parameter("use_sim_time", value=False)])[0].successful
    node.declare_parameter("qos_overrides.somewhere", "reliable")
    assert live.current is kept, "parameters of others"
    assert len(heard) == 1


def test_fitter_node_asks_for_the_classic_method_and_nothing_else():
    one, other = FitterParameters().recovery_options(), RecoverParameters().recovery_options()
    assert one == replace(other, method="classic")


@pytest.mark.parametrize("given", [[0, -1, 0, 1, 1, 2], [0.0, -1.0, 0.0, 1.0, 1.0, 2.0]])
def test_a_workspace_is_six_numbers_integers_or_not(make_node, given):
    assert LiveParameters(make_node(workspace=given), RecoverParameters).current.box == (0, -1, 0, 1, 1, 2)
    node = make_node()
    live = LiveParameters(node, RecoverParameters)
    assert live.current.box is None
    assert node.set_parameters([Parameter("workspace", value=given)])[0].successful
    assert live.current.box == (0.0, -1.0, 0.0, 1.0, 1.0, 2.0)
    for wrong in ([0.0, 1.0], [0.0, 0.0, 0.0, 1.0, 1.0, -1.0], [float("nan")] * 6, "all"):
        result = node.set_parameters([Parameter("workspace", value=wrong)])[0]
        assert not result.successful
        assert ("expected 'Type.DOUBLE_ARRAY'" if wrong == "all" else "workspace: expected") in result.reason
    assert live.current.box == (0.0, -1.0, 0.0, 1.0, 1.0, 2.0)


def test_a_file_of_the_values_in_force_can_be_loaded(make_node):
    """As `ros2 param load` of a `ros2 param dump` does, one by one, whether or not they may change now."""
    node = make_node()
    live = LiveParameters(node, RecoverParameters, locked=lambda: "is read when the node is configured")
    for name, value in asdict(live.current).items():
        assert node.set_parameters([Parameter(name, value=value)])[0].successful, name
