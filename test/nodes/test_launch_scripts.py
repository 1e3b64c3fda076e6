"""Launch files, run against a stand-in for the launch package (not on PyPI)."""

from __future__ import annotations

import importlib.util
import sys
import types
from pathlib import Path
from typing import Any

import pytest

from sq_perception.nodes import fast_dds


class Recorded:
    """Any class of the launch packages: keeps what it was made of."""

    def __init__(self, *positional: Any, **named: Any) -> None:
        self.positional, self.named = positional, named


class Argument(Recorded):
    """LaunchConfiguration: looks its name up."""

    def perform(self, context: dict[str, str]) -> str:
        return context[self.positional[0]]


@pytest.fixture
def launch(monkeypatch: pytest.MonkeyPatch) -> dict[str, type]:
    names = {
        "launch": ["LaunchContext", "LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument", "OpaqueFunction", "SetEnvironmentVariable"],
        "launch.substitutions": ["LaunchConfiguration", "PathJoinSubstitution"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
        "launch_ros.substitutions": ["FindPackageShare"],
    }
    made: dict[str, type] = {}
    for module, classes in names.items():
        stand_in = types.ModuleType(module)
        for name in classes:
            base = Argument if name == "LaunchConfiguration" else Recorded
            made[name] = type(name, (base,), {})
            setattr(stand_in, name, made[name])
        monkeypatch.setitem(sys.modules, module, stand_in)
    monkeypatch.delenv(fast_dds.VARIABLE, raising=False)
    return made


def load(path: Path) -> types.ModuleType:
    spec = importlib.util.spec_from_file_location(path.name.replace(".", "_"), path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def nodes_of(path: Path, made: dict[str, type], **given: str) -> list[Any]:
    """The nodes that a launch file starts with arguments ``given`` and its defaults otherwise."""
    entities = load(path).generate_launch_description().positional[0]
    declared = {
        e.positional[0]: e.named["default_value"] for e in entities if isinstance(e, made["DeclareLaunchArgument"])
    }
    assert set(given) <= set(declared)
    variables = [e.positional for e in entities if isinstance(e, made["SetEnvironmentVariable"])]
    assert variables == [(fast_dds.VARIABLE, str(fast_dds.profile_path()))]
    (opaque,) = (e for e in entities if isinstance(e, made["OpaqueFunction"]))
    return opaque.named["function"]({**declared, **given})


def test_recover_is_wired_to_the_camera(repository: Path, launch: dict[str, type]) -> None:
    path = repository / "launch_scripts" / "recover.launch.py"
    (node,) = nodes_of(path, launch, depth="/camera/depth", camera_info="/camera/info")
    assert (node.named["package"], node.named["executable"]) == ("sq_perception", "recover_node")
    assert dict(node.named["remappings"]) == {
        "depth/image": "/camera/depth",
        "depth/camera_info": "/camera/info",
        "depth/points": "depth/points",
        "mask/image": "mask/image",
    }
    both = nodes_of(path, launch, fitter="true", params_file="mine.yaml")
    assert [node.named["executable"] for node in both] == ["recover_node", "fitter_node"]
    assert both[0].named["parameters"] == ["mine.yaml"], "an argument that is not given overrides nothing"
    assert both[1].named["parameters"] == ["mine.yaml", {"method": "classic"}], "recover_node.yaml has another method"
    assert both[0].named["respawn"]
    (managed,) = nodes_of(path, launch, namespace="wrist", autostart="false", respawn="false")
    assert (managed.named["namespace"], managed.named["respawn"]) == ("wrist", False)
    assert managed.named["parameters"] == [{"autostart": False}]
    assert managed.named["arguments"] == []
    given = {"model": "supervised", "target_frame": "map", "use_sim_time": "true", "log_level": "debug"}
    (node,) = nodes_of(path, launch, params_file="mine.yaml", **given)
    assert node.named["parameters"] == [
        "mine.yaml",
        {"model": "supervised"},
        {"target_frame": "map"},
        {"use_sim_time": True},
    ]
    assert node.named["arguments"] == ["--ros-args", "--log-level", "debug"]
    (node,) = nodes_of(path, launch, points="/camera/points")
    assert node.named["parameters"] == [{"image_transport": "points"}]
    assert dict(node.named["remappings"])["depth/points"] == "/camera/points"


def test_several_cameras_are_one_process_with_names_of_their_own(repository: Path, launch: dict[str, type]) -> None:
    path = repository / "launch_scripts" / "recover.launch.py"
    given = {"cameras": "front arm/wrist", "depth": "camera/depth", "params_file": "mine.yaml", "log_level": "warn"}
    (process,) = nodes_of(path, launch, namespace="robot", **given)
    assert process.named["executable"] == "recover_cameras"
    assert process.named["arguments"] == ["robot/front", "robot/arm/wrist", "--ros-args", "--log-level", "warn"]
    assert not {"name", "namespace"} & set(process.named), "they would replace those of all cameras"
    assert dict(process.named["remappings"])["depth/image"] == "camera/depth"
    assert process.named["parameters"] == ["mine.yaml"]
    two = nodes_of(path, launch, cameras="front", fitter="true")
    assert [(one.named["executable"], one.named["arguments"]) for one in two] == [
        *(("recover_cameras", ["front"]), ("fitter_node", [])),
    ]


def rviz_of(nodes: list[Any]) -> Any:
    """The one RViz2 among nodes; its configuration is looked up where the package installs it."""
    (rviz,) = (node for node in nodes if node.named["package"] == "rviz2")
    flag, share, *frame = rviz.named["arguments"]
    package, *path = share.positional[0]
    assert (rviz.named["executable"], flag, frame[0]) == ("rviz2", "-d", "-f")
    assert (package.positional[0], path) == ("sq_perception", ["config", "superquadrics.rviz"])
    return rviz


def test_rviz_looks_at_the_topics_of_the_camera(repository: Path, launch: dict[str, type]) -> None:
    path = repository / "launch_scripts" / "recover.launch.py"
    nodes = nodes_of(path, launch, rviz="true", depth="/zed/depth", camera_info="/zed/info", rviz_frame="zed_optical")
    rviz = rviz_of(nodes)
    assert [node.named["executable"] for node in nodes] == ["recover_node", "rviz2"]
    assert dict(rviz.named["remappings"]) == {"/depth/image": "/zed/depth", "/depth/camera_info": "/zed/info"}
    assert rviz.named["arguments"][-1] == "zed_optical"
    assert rviz.named["parameters"] == [{"use_sim_time": False}]


def test_rviz_has_the_time_of_the_nodes(repository: Path, launch: dict[str, type]) -> None:
    """By another one it takes every tf2 frame for one that has not been sent for long."""
    path = repository / "launch_scripts" / "recover.launch.py"
    assert rviz_of(nodes_of(path, launch, rviz="true", use_sim_time="true")).named["parameters"] == [
        {"use_sim_time": True}
    ]


def test_of_several_cameras_rviz_and_the_classic_method_see_the_first(
    repository: Path, launch: dict[str, type]
) -> None:
    path = repository / "launch_scripts" / "recover.launch.py"
    given = {"cameras": "front wrist", "depth": "depth/raw", "rviz": "true", "fitter": "true", "namespace": "robot"}
    nodes = nodes_of(path, launch, **given)
    assert nodes[1].named["namespace"] == "robot/front"
    remapped = dict(rviz_of(nodes).named["remappings"])
    assert remapped["/depth/image"] == "/robot/front/depth/raw"
    assert remapped["/depth/camera_info"] == "/robot/front/depth/camera_info"
    assert remapped["/recover_node/markers"] == "/robot/front/recover_node/markers"
    assert remapped["/fitter_node/markers"] == "/robot/front/fitter_node/markers"
