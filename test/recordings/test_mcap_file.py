"""MCAP files: an independent reader finds what was added, and only whole groups of it, whatever went wrong when."""

from __future__ import annotations

import threading
import time

import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")
pytest.importorskip("mcap", reason="needs the extra 'bags'")

from mcap.reader import NonSeekingReader, make_reader

from sq_perception.recordings import mcap_file
from sq_perception.recordings.mcap_file import LATEST, McapFile

STRING = "std_msgs/msg/String"
TOPICS = ("/topic_0", "/topic_1")
GROUP = 9000
"""Bytes."""


def empty(file):
    return McapFile(file, "test", {STRING: "string data\n"}.__getitem__)


def pair(data):
    """A message on each of two topics."""
    return [(topic, STRING, one) for topic, one in zip(TOPICS, data, strict=True)]


def filled(file, groups, rng, size=3000):
    """A file with groups of two messages on two topics; the groups that were added."""
    mcap = empty(file)
    added = []
    for k in range(groups):
        data = [rng.bytes(size) for _ in TOPICS]
        mcap.add(pair(data), 100 + k)
        added.append((100 + k, data))
    return mcap, added


def read(file):
    """Time and data of every message, through the index and the checksums."""
    file.seek(0)
    reader = make_reader(file, validate_crcs=True)
    summary = reader.get_summary()
    return summary, [(message.log_time, message.data) for _, _, message in reader.iter_messages()]


def expected(added):
    return [(at, data) for at, pair in added for data in pair]


@pytest.fixture
def file(tmp_path):
    with (tmp_path / "test.mcap").open("w+b") as file:
        yield file


@pytest.mark.filterwarnings("ignore:.*_time is deprecated")
def test_an_independent_reader_finds_everything(file, rng, monkeypatch):
    monkeypatch.setattr(mcap_file, "CHUNK_BYTES", 6000)
    mcap, added = filled(file, 5, rng)
    mcap.finish()
    summary, found = read(file)
    assert found == expected(added)
    statistics = summary.statistics
    assert (statistics.message_count, statistics.chunk_count) == (10, 5)
    assert statistics.channel_message_counts == {1: 5, 2: 5}
    assert (statistics.message_start_time, statistics.message_end_time) == (100, 104)
    assert (statistics.schema_count, statistics.channel_count) == (1, 2)
    assert {one.topic for one in summary.channels.values()} == set(TOPICS)
    assert {(one.name, one.encoding, one.data) for one in summary.schemas.values()} == {
        ("std_msgs/msg/String", "ros2msg", b"string data\n")
    }
    assert {one.compression for one in summary.chunk_indexes} == {"zstd"}
    file.seek(0)
    reader = make_reader(file)
    assert reader.get_header().profile == "ros2"
    # One topic in one span of time: what a player asks for when it seeks.
    part = reader.iter_messages(topics=["/topic_1"], start_time=102, end_time=104)
    assert [(message.log_time, message.data) for _, _, message in part] == [(t, d[1]) for t, d in added[2:4]]
    file.seek(0)
    assert len(list(NonSeekingReader(file, validate_crcs=True).iter_messages())) == 10


def test_times_that_a_bag_cannot_hold_are_refused_and_a_file_without_messages_is_whole(file):
    mcap = empty(file)
    for bad in (-1, LATEST + 1):
        with pytest.raises(ValueError, match="time"):
            mcap.add([("/topic", STRING, b"")], bad)
    with pytest.raises(ValueError, match="messages"):
        mcap.add([], 0)
    mcap.finish()
    summary, found = read(file)
    assert (found, summary.statistics.message_count) == ([], 0)


@pytest.mark.parametrize("chunk", [1000, 2**30])
def test_at_whatever_size_the_disk_ends_there_is_room_for_the_index(tmp_path, rng, file_size_limit, monkeypatch, chunk):
    """A limit that the kernel enforces: the file is whole, has all groups that were taken, and no room for another."""
    monkeypatch.setattr(mcap_file, "CHUNK_BYTES", chunk)
    path = tmp_path / "limited.mcap"
    for limit in range(30_000, 48_000, 1900):
        with path.open("wb") as file:
            mcap = empty(file)
            with file_size_limit(limit):
                added = as_many_as_fit(mcap, rng)
                mcap.finish()
        with path.open("rb") as file:
            assert len(read(file)[1]) == mcap.groups == added >= 2
        assert limit - GROUP - 4000 < path.stat().st_size <= limit


def as_many_as_fit(mcap, rng):
    for k in range(20):
        try:
            mcap.add([("/topic", STRING, rng.bytes(GROUP))], k)
        except OSError:
            return k
    return 20


def test_an_interrupt_finds_no_half_group(file, rng, monkeypatch):
    """The main thread is interrupted while a chunk is written: what was begun is finished."""
    writer = mcap_file.Writer
    begun = threading.Event()

    class Slow(writer):
        def add_message(self, *arguments, **options):
            begun.set()
            time.sleep(0.05)
            super().add_message(*arguments, **options)

    def interrupted(self, timeout=None):
        begun.wait()
        raise KeyboardInterrupt

    monkeypatch.setattr(mcap_file, "Writer", Slow)
    mcap, added = filled(file, 1, rng)
    more = [rng.bytes(3000), rng.bytes(3000)]
    begun.clear()
    with monkeypatch.context() as patched:
        patched.setattr("concurrent.futures.Future.result", interrupted)
        with pytest.raises(KeyboardInterrupt):
            mcap.add(pair(more), 200)
    mcap.finish()
    assert read(file)[1] == expected([*added, (200, more)])
    assert mcap.groups == 2


def test_where_no_room_can_be_set_aside_it_is_written_to(file, rng, monkeypatch):
    def unknown(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(mcap_file.os, "posix_fallocate", unknown)
    mcap, added = filled(file, 3, rng)
    mcap.finish()
    assert read(file)[1] == expected(added)
