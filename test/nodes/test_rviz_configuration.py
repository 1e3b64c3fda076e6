"""The RViz2 configuration: classes that RViz has, topics that the nodes have, and a view that stands upright.

RViz2 itself is no part of the tests.  Class names, property names and their spelling were read in ros2/rviz, branch
jazzy; what is listed here is that reading.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from sq_perception.recordings.publication import CAMERA_FRAME

PROPERTIES = {
    f"rviz_default_plugins/{display}": set(properties.split(", "))
    for display, properties in {
        "Axes": "Length, Radius, Reference Frame",
        "DepthCloud": "Alpha, Auto Size, Color, Color Image Topic, Color Transformer, Color Transport Hint, Decay "
        "Time, Depth Map Topic, Depth Map Transport Hint, Occlusion Compensation, Queue Size, Reliability Policy, "
        "Selectable, Style, Topic Filter",
        "MarkerArray": "Namespaces, Topic",
        "TF": "Filter (blacklist), Filter (whitelist), Frame Timeout, Frames, Marker Scale, Show Arrows, Show Axes, "
        "Show Names, Tree, Update Interval",
        "Image": "Max Value, Median window, Min Value, Normalize Range, Topic",
    }.items()
}
"""What each display has beside Class, Enabled, Name and Value."""
TOPIC = {"Depth", "Durability Policy", "History Policy", "Reliability Policy", "Value"}
RELIABLE_TOPICS = {"/recover_node/markers", "/fitter_node/markers", "/grasp_node/markers"}
"""Few and small, and a lost deletion would leave a body on the screen; images are best effort, as cameras are."""


@pytest.fixture
def configuration(repository: Path) -> dict[str, Any]:
    return yaml.safe_load((repository / "config" / "superquadrics.rviz").read_text(encoding="utf-8"))


@pytest.fixture
def displays(configuration: dict[str, Any]) -> list[dict[str, Any]]:
    return configuration["Visualization Manager"]["Displays"]


def test_displays_have_the_properties_of_their_classes_and_hear_their_publishers(displays) -> None:
    for one in displays:
        assert set(one) - {"Class", "Enabled", "Name", "Value"} == PROPERTIES[one["Class"]], one["Name"]
        assert one["Value"] == one["Enabled"]
    names = [one["Name"] for one in displays]
    assert len(set(names)) == len(names)
    for one in displays:
        if "Topic" not in one:
            continue
        topic = one["Topic"]
        assert set(topic) == TOPIC
        reliability = "Reliable" if topic["Value"] in RELIABLE_TOPICS else "Best Effort"
        assert (topic["Reliability Policy"], topic["Durability Policy"]) == (reliability, "Volatile")
    (cloud,) = (one for one in displays if one["Class"].endswith("/DepthCloud"))
    assert cloud["Reliability Policy"] == "Best effort"  # this one display spells it so


def test_topics_and_frame_are_those_of_the_nodes(configuration, displays, repository) -> None:
    """Every name stands as a literal in the nodes' code, private ones with their ~."""
    code = "".join(path.read_text(encoding="utf-8") for path in (repository / "sq_perception" / "nodes").glob("*.py"))
    named = [one["Topic"]["Value"] for one in displays if "Topic" in one]
    named += [one["Depth Map Topic"] for one in displays if "Depth Map Topic" in one]
    for topic in named:
        node, _, name = topic.removeprefix("/").partition("/")
        literal = f'"~/{name}"' if node in ("recover_node", "fitter_node", "grasp_node") else f'"{node}/{name}"'
        assert literal in code, topic
    assert configuration["Visualization Manager"]["Global Options"]["Fixed Frame"] == CAMERA_FRAME


def test_the_view_looks_along_the_camera_and_stands_upright(configuration: dict[str, Any]) -> None:
    """Orbit, as RViz computes it: the eye at focal point + distance (cy cp, sy cp, sp), z of the fixed frame up."""
    views = configuration["Visualization Manager"]["Views"]
    for view in (views["Current"], *views["Saved"]):
        yaw, pitch = view["Yaw"], view["Pitch"]
        assert abs(pitch) < math.pi / 2 - 0.001  # the limit of RViz
        outwards = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)])
        forwards = -outwards
        right = np.cross(forwards, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        up = np.cross(right, forwards)
        assert forwards[2] > 0  # away from the camera
        assert up[1] < 0  # optical y points down
        np.testing.assert_allclose(right, [1, 0, 0], atol=1e-5)
    assert 0.3 < views["Current"]["Focal Point"]["Z"] < 2.0  # where the things on the synthetic table are


def test_what_rviz_does_not_forgive_is_there(configuration, displays) -> None:
    """RViz reads these two into variables without a value of their own, and lets panels float without a state."""
    window = configuration["Window Geometry"]
    assert (window["Hide Left Dock"], window["Hide Right Dock"]) == (False, False)
    state = bytes.fromhex(window["QMainWindow State"])
    panels = {one["Name"] for one in configuration["Panels"]}
    images = {one["Name"] for one in displays if one["Class"] == "rviz_default_plugins/Image"}
    for name in panels | images:
        assert name.encode("utf-16-be") in state, name
    assert all(one["Class"].startswith("rviz_common/") for one in configuration["Panels"])
