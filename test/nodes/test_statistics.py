"""What /diagnostics says is of the last seconds, and names what a look at the robot needs."""

import re
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

from diagnostic_msgs.msg import DiagnosticStatus

from sq_perception.nodes.statistics import SECONDS, WITHOUT_MASK, Statistics


@pytest.fixture
def clock() -> SimpleNamespace:
    """Seconds that pass when the test says so."""
    return SimpleNamespace(now=1000.0)


@pytest.fixture
def statistics(clock: SimpleNamespace) -> Statistics:
    return Statistics(lambda: clock.now)


def said(statistics: Statistics) -> tuple[DiagnosticStatus, dict[str, str]]:
    one = statistics.status("/recover_node", None, {})
    return one, {pair.key: pair.value for pair in one.values}


def frames(statistics: Statistics, clock: SimpleNamespace, count: int, every: float, took: float) -> None:
    for _ in range(count):
        statistics.count("received")
        clock.now += every
        statistics.answer({"stamp to result": took}, "1 body")


def test_latencies_of_long_ago_are_forgotten(statistics, clock):
    """78 ms from 25 minutes ago must not stand for a node that needs 6 s a frame now."""
    frames(statistics, clock, 300, 0.1, 78.0)
    one, values = said(statistics)
    assert (one.level, values["stamp to result: median [ms]"]) == (DiagnosticStatus.OK, "78.00")
    assert float(values["rate [Hz]"]) == pytest.approx(10.0, abs=0.2)
    frames(statistics, clock, 5, 6.0, 6000.0)
    one, values = said(statistics)
    assert values["stamp to result: median [ms]"] == "6000.00"
    assert 0.1 <= float(values["rate [Hz]"]) <= 0.2
    clock.now += 2 * SECONDS
    _, values = said(statistics)
    assert "stamp to result: median [ms]" not in values
    assert (values["rate [Hz]"], values["answered"]) == ("0.00", "305")


def test_frames_that_come_and_are_not_answered_are_a_warning(statistics, clock):
    """But not the first one of a start."""
    statistics.count("received")
    clock.now += 1.0
    assert said(statistics)[0].level == DiagnosticStatus.OK
    frames(statistics, clock, 10, 0.1, 50.0)
    for _ in range(int(2 * SECONDS)):
        clock.now += 1.0
        statistics.count("received")
        statistics.count("dropped")
    one, _ = said(statistics)
    assert one.level == DiagnosticStatus.WARN
    assert re.fullmatch(r"1\d frames came within (9|10) s, none was answered", one.message)
    statistics.answer({}, "")
    assert said(statistics)[0].level == DiagnosticStatus.OK


def test_frames_that_nobody_wanted_are_no_warning_once_they_are_wanted(statistics, clock):
    """Disabled for a while, then enabled; the first frame is still at work when the next status is due."""
    for _ in range(8):
        clock.now += 1.0
        statistics.count("received")
        statistics.count("dropped")
        statistics.status("/recover_node", (DiagnosticStatus.OK, "disabled"), {})
    clock.now += 0.5
    statistics.count("received")
    clock.now += 0.5
    assert said(statistics)[0].level == DiagnosticStatus.OK
    for _ in range(4):
        clock.now += 1.0
        statistics.count("received")
    assert said(statistics)[0].message == "5 frames came within 4 s, none was answered"


def test_the_last_error_has_a_time_and_no_bodies_a_reason(statistics):
    statistics.refuse("encoding: expected 16UC1")
    statistics.answer({}, "no bodies in 5 ms: nothing is nearer than depth_max")
    _, values = said(statistics)
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ encoding: expected 16UC1", values["last error"])
    assert values["last answer"] == "no bodies in 5 ms: nothing is nearer than depth_max"


def test_lost_messages_are_counted_by_topic(statistics):
    statistics.lose("/depth/image", 3)
    said(statistics)
    statistics.lose("/depth/camera_info", 2)
    statistics.lose("/depth/image", 1)
    one, values = said(statistics)
    assert one.message == "messages lost before they arrived: 1 of /depth/image, 2 of /depth/camera_info"
    assert (values["lost"], values["lost of /depth/image"], values["lost of /depth/camera_info"]) == ("6", "4", "2")


def test_frames_without_a_mask_where_masks_are_published_are_a_warning(statistics):
    statistics.count(WITHOUT_MASK, 3)
    one, values = said(statistics)
    assert one.message == "no mask came for 3 frames: their objects are the node's own segments"
    assert values["without mask"] == "3"
    one, _ = said(statistics)
    assert one.level == DiagnosticStatus.OK
