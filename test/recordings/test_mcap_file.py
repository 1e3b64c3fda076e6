"""MCAP files: an independent reader finds what was added, and only whole chunks of it, whatever went wrong when."""

from __future__ import annotations

import errno
import io
import os
import tracemalloc

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")
pytest.importorskip("mcap", reason="needs the extra 'bags'")

from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

from sq_perception.recordings import mcap_file
from sq_perception.recordings.mcap_file import LATEST, McapFile

STRING = ("std_msgs/msg/String", "string data\n")


class Disk(io.BytesIO):
    """A file on a disk with ``room`` bytes, of which a failing write takes what is left; ``fault`` is raised."""

    def __init__(self, room: int, fault: type[BaseException] | None = None) -> None:
        super().__init__()
        self.room, self.fault = room, fault

    def write(self, data) -> int:
        free = self.room - self.tell()
        if free <= 0:
            raise self.fault() if self.fault else OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(memoryview(data)[:free])


def filled(file, groups, rng, size=3000):
    """A file with groups of two messages on two topics, flushed one by one; the groups that were added."""
    mcap = McapFile(file, "test")
    channels = [mcap.channel(f"/topic_{k}", *STRING) for k in range(2)]
    added = []
    for k in range(groups):
        data = [rng.bytes(size) for _ in channels]
        added.append((100 + k, data))
        mcap.add(list(zip(channels, data, strict=True)), 100 + k)
        mcap.flush()
    return mcap, added


def read(file):
    """Time and data of every message, through the index and the checksums."""
    file.seek(0)
    reader = make_reader(file, validate_crcs=True)
    summary = reader.get_summary()
    return summary, [(message.log_time, message.data) for _, _, message in reader.iter_messages()]


def expected(added):
    return [(time, data) for time, pair in added for data in pair]


@pytest.mark.filterwarnings("ignore:.*_time is deprecated")
def test_an_independent_reader_finds_everything(rng):
    file = io.BytesIO()
    mcap, added = filled(file, 5, rng)
    mcap.finish()
    summary, found = read(file)
    assert found == expected(added)
    statistics = summary.statistics
    assert (statistics.message_count, statistics.chunk_count) == (10, 5)
    assert statistics.channel_message_counts == {1: 5, 2: 5}
    assert (statistics.message_start_time, statistics.message_end_time) == (100, 104)
    assert (statistics.schema_count, statistics.channel_count) == (1, 2)
    assert {one.topic for one in summary.channels.values()} == {"/topic_0", "/topic_1"}
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


def test_a_file_without_messages_is_whole():
    file = io.BytesIO()
    mcap = McapFile(file, "test")
    mcap.channel("/topic", *STRING)
    mcap.finish()
    summary, found = read(file)
    assert found == []
    assert (summary.statistics.message_count, summary.channels) == (0, {})


def test_groups_wait_until_they_fill_a_chunk(rng):
    file = io.BytesIO()
    mcap = McapFile(file, "test")
    channel = mcap.channel("/topic", *STRING)
    for k in range(mcap_file.CHUNK_GROUPS - 1):
        mcap.add([(channel, b"data")], k)
    assert mcap.groups == 0
    mcap.add([(channel, b"data")], 0)
    assert mcap.groups == mcap_file.CHUNK_GROUPS
    mcap.add([(channel, bytes(mcap_file.CHUNK_BYTES))], LATEST)
    assert mcap.groups == mcap_file.CHUNK_GROUPS + 1
    for bad in (-1, LATEST + 1):
        with pytest.raises(ValueError, match="time"):
            mcap.add([(channel, b"")], bad)
    with pytest.raises(ValueError, match="messages"):
        mcap.add([], 0)


def whole_chunks(file):
    """Of a file that ends somewhere."""
    file.seek(0)
    count = 0
    try:
        for record in StreamReader(file, emit_chunks=True, validate_crcs=True).records:
            count += isinstance(record, Chunk)
    except EndOfFile:
        return count
    raise AssertionError("the file has an end")


def whole_size(groups):
    file = io.BytesIO()
    filled(file, groups, np.random.default_rng(0))[0].finish()
    return len(file.getvalue())


@pytest.mark.parametrize("fault", [None, KeyboardInterrupt])
def test_wherever_it_is_cut_short_the_file_closes(fault):
    """The disk ends, or Ctrl-C comes, at each of many places: with the index there are the groups of whole chunks."""
    size = whole_size(4)
    kept = []
    for room in range(1000, size, 331):
        disk = Disk(room, fault)
        mcap = McapFile(disk, "test")
        channels = [mcap.channel(f"/topic_{k}", *STRING) for k in range(2)]
        rng, added = np.random.default_rng(0), []
        try:
            for k in range(4):
                data = [rng.bytes(3000) for _ in channels]
                mcap.add(list(zip(channels, data, strict=True)), 100 + k)
                mcap.flush()
                added.append((100 + k, data))
        except (OSError, KeyboardInterrupt):
            pass
        try:
            mcap.finish()
        except (OSError, KeyboardInterrupt):  # no room for the index either: whole chunks are left
            mcap.cut()
            assert whole_chunks(disk) == mcap.groups == len(added)
            continue
        summary, found = read(disk)
        assert found == expected(added)
        assert summary.statistics.chunk_count == mcap.groups == len(added)
        kept.append(len(added))
    assert set(kept) == {0, 1, 2, 3}


def test_a_chunk_that_failed_is_written_when_there_is_room(rng):
    disk = Disk(8000)
    mcap, added = filled(disk, 1, rng)
    more = [rng.bytes(3000), rng.bytes(3000)]
    mcap.add([(1, more[0]), (2, more[1])], 200)
    with pytest.raises(OSError, match="No space"):
        mcap.flush()
    assert mcap.groups == 1
    disk.room = 10**6
    mcap.flush()
    mcap.finish()
    assert read(disk)[1] == expected([*added, (200, more)])


def test_a_full_device_says_so():
    with open("/dev/full", "wb", buffering=0) as full, pytest.raises(OSError, match="No space left"):
        McapFile(full, "test")


def test_at_whatever_size_the_disk_ends_there_is_room_for_the_index(tmp_path, rng, file_size_limit):
    """A limit that the kernel enforces in the middle of a write: the file is whole, and as full as it can be."""
    path, data = tmp_path / "limited.mcap", rng.bytes(9000)
    for limit in range(30_000, 48_000, 700):
        with path.open("wb", buffering=0) as file:
            mcap = McapFile(file, "test")
            channel = mcap.channel("/topic", *STRING)
            with file_size_limit(limit), pytest.raises(OSError, match="File too large"):
                write_all(mcap, channel, data)
            with file_size_limit(limit):
                mcap.finish()
        assert limit - 12_500 < path.stat().st_size <= limit
        with path.open("rb") as file:
            assert len(read(file)[1]) == mcap.groups >= 2


def write_all(mcap, channel, data):
    for k in range(9):
        mcap.add([(channel, data)], k)
        mcap.flush()


def test_memory_holds_a_chunk_and_not_the_file(rng):
    """300 chunks of 40 kB leave less than 500 bytes each, which is their line in the index."""
    data = rng.bytes(40_000)

    def peak(groups):
        with open(os.devnull, "r+b", buffering=0) as nowhere:
            mcap = McapFile(nowhere, "test")
            channel = mcap.channel("/topic", *STRING)
            tracemalloc.start()
            for k in range(groups):
                mcap.add([(channel, data)], k)
                mcap.flush()
            found = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        return found

    assert peak(350) - peak(50) < 300 * 500
