"""An MCAP file that grows chunk by chunk and can be closed properly at any moment.

What was added between two moments is one group: a reader finds all of it or nothing.  Groups wait in memory until they
fill a chunk.  A chunk that could not be written whole, because the disk is full or Ctrl-C came, is as if it had never
been begun: its groups still wait, what lies behind the last whole chunk is cut off, and ``flush`` may be tried again.
``finish`` writes the index of what is there; room for it is set aside before each chunk, where the file system can.

The package ``mcap`` lays out the records.  Its Writer is not used, because it cannot take back a chunk that failed, and
its file could then not be closed; the writer of ``rosbags`` writes folders, without checksums, and cannot either.

Profile, encodings and names are those of rosbag2, so that ROS 2, Foxglove and rosbags all read the file.  Chunks are
packed with zstd and have checksums.

Times are nanoseconds.  Reference: MCAP, https://mcap.dev/spec
"""

from __future__ import annotations

import errno
import os
import sys
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from io import SEEK_END, RawIOBase

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

CHUNK_BYTES, CHUNK_GROUPS = 4 * 2**20, 100
"""Bytes of messages, or groups, from which on a chunk is written: enough to pack well, little to lose."""
LATEST = 2**63 - 1
"""Nanoseconds: ROS counts them with a sign."""

if sys.version_info >= (3, 14):
    from compression.zstd import compress
else:
    from backports.zstd import compress

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_MAGIC = b"\x89MCAP0\r\n"


@dataclass(frozen=True)
class _State:
    """What lies in the file and what waits; replaced as a whole, so that no interruption finds half a change.

    Attributes
    ----------
    end
        Bytes of the file that count.
    schemas, channels, chunks, groups
        So many of them lie in the file.
    counts
        Messages in the file by channel id.
    start, stop
        Their first and last time.
    waiting, waiting_bytes
        Groups that are not in the file, and the bytes of their messages.
    """

    end: int
    schemas: int = 0
    channels: int = 0
    chunks: int = 0
    groups: int = 0
    counts: dict[int, int] = field(default_factory=dict)
    start: int = LATEST
    stop: int = 0
    waiting: tuple[tuple[Message, ...], ...] = ()
    waiting_bytes: int = 0


class McapFile:
    """Writes to ``file``, which is binary, unbuffered, seekable, and stays open.

    Raises
    ------
    OSError
        From everything that writes; the object can still be used.
    """

    def __init__(self, file: RawIOBase, library: str) -> None:
        self._file = file
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._indexes: list[bytes] = []
        """A record for each chunk; those behind ``_state.chunks`` do not count."""
        self._state = _State(end=0)
        self._state = _State(end=self._put(_MAGIC + _records([Header(profile="ros2", library=library)])))

    @property
    def groups(self) -> int:
        """How many groups a reader of the finished file will find."""
        return self._state.groups

    @property
    def waiting(self) -> int:
        """How many groups are not in the file."""
        return len(self._state.waiting)

    def channel(self, topic: str, type_name: str, definition: str) -> int:
        """The id of a new channel: a topic, the name of its type ``package/msg/Name``, and the text that defines it."""
        schema = next((one for one in self._schemas if one.name == type_name), None)
        if schema is None:
            schema = Schema(len(self._schemas) + 1, definition.encode(), "ros2msg", type_name)
            self._schemas.append(schema)
        self._channels.append(Channel(len(self._channels) + 1, topic, "cdr", {}, schema.id))
        return self._channels[-1].id

    def add(self, messages: Sequence[tuple[int, bytes]], time: int) -> None:
        """Add a group: pairs of a channel's id and a message as CDR, all received at ``time``, 0 to LATEST."""
        if not messages or not 0 <= time <= LATEST:
            raise ValueError(f"expected messages and a time from 0 to {LATEST}, got {len(messages)} at {time}")
        group = tuple(Message(channel, time, data, publish_time=time, sequence=0) for channel, data in messages)
        now = self._state
        size = now.waiting_bytes + sum(len(one.data) for one in group)
        self._state = replace(now, waiting=(*now.waiting, group), waiting_bytes=size)
        if size >= CHUNK_BYTES or self.waiting >= CHUNK_GROUPS:
            self.flush()

    def flush(self, most: int | None = None) -> None:
        """Write what waits as a chunk: all of it, or at most so many groups."""
        now = self._state
        if not now.waiting:
            return
        groups, rest = now.waiting[:most], now.waiting[len(now.waiting[:most]) :]
        messages = [message for group in groups for message in group]
        content, places = self._content(messages)
        packed = compress(content)
        times = [message.log_time for message in messages]
        chunk = _records(
            [
                Chunk(
                    compression="zstd",
                    data=packed,
                    message_start_time=min(times),
                    message_end_time=max(times),
                    uncompressed_crc=zlib.crc32(content),
                    uncompressed_size=len(content),
                )
            ]
        )
        offsets: dict[int, int] = {}
        tail = RecordBuilder()
        for channel, entries in places.items():
            offsets[channel] = now.end + len(chunk) + tail.count
            MessageIndex(channel, entries).write(tail)
        index = ChunkIndex(
            chunk_length=len(chunk),
            chunk_start_offset=now.end,
            compression="zstd",
            compressed_size=len(packed),
            message_end_time=max(times),
            message_index_length=tail.count,
            message_index_offsets=offsets,
            message_start_time=min(times),
            uncompressed_size=len(content),
        )
        end = self._put(chunk + tail.end(), self._index_room())
        self._indexes[now.chunks :] = [_records([index])]
        self._state = _State(
            end=end,
            schemas=len(self._schemas),
            channels=len(self._channels),
            chunks=now.chunks + 1,
            groups=now.groups + len(groups),
            counts=now.counts | {one: now.counts.get(one, 0) + len(entries) for one, entries in places.items()},
            start=min(now.start, *times),
            stop=max(now.stop, *times),
            waiting=rest,
            waiting_bytes=sum(len(message.data) for group in rest for message in group),
        )

    def finish(self) -> None:
        """Write the index and the end; what still waits is left out, and nothing may be added any more."""
        now = self._state
        data_end = _records([DataEnd(data_section_crc=0)])
        begin = now.end + len(data_end)
        groups: list[tuple[int, bytes]] = [
            (Opcode.SCHEMA, _records(self._schemas[: now.schemas])),
            (Opcode.CHANNEL, _records(self._channels[: now.channels])),
            (Opcode.STATISTICS, _records([self._statistics()])),
            (Opcode.CHUNK_INDEX, b"".join(self._indexes[: now.chunks])),
        ]
        summary, offsets = b"", []
        for opcode, records in groups:
            if records:
                offsets.append(SummaryOffset(opcode, begin + len(summary), len(records)))
                summary += records
        at = begin + len(summary)
        summary += _records(offsets)
        # The checksum covers the summary and the footer up to the checksum itself.
        open_footer = _records([Footer(begin, at, summary_crc=0)])[:-4]
        footer = Footer(begin, at, summary_crc=zlib.crc32(summary + open_footer))
        self._put(data_end + summary + _records([footer]) + _MAGIC)

    def cut(self) -> None:
        """Leave whole chunks alone, after a ``finish`` that failed."""
        self._file.truncate(self._state.end)

    def _content(self, messages: Iterable[Message]) -> tuple[bytes, dict[int, list[tuple[int, int]]]]:
        """The bytes of a chunk, and for each channel the times and places of its messages in them."""
        builder = RecordBuilder()
        for record in (*self._schemas[self._state.schemas :], *self._channels[self._state.channels :]):
            record.write(builder)
        places: dict[int, list[tuple[int, int]]] = {}
        for message in messages:
            places.setdefault(message.channel_id, []).append((message.log_time, builder.count))
            message.write(builder)
        return builder.end(), places

    def _statistics(self) -> Statistics:
        now = self._state
        return Statistics(
            attachment_count=0,
            channel_count=now.channels,
            channel_message_counts=now.counts,
            chunk_count=now.chunks,
            message_count=sum(now.counts.values()),
            message_end_time=now.stop,
            message_start_time=now.start if now.counts else 0,
            metadata_count=0,
            schema_count=now.schemas,
        )

    def _index_room(self) -> int:
        """Bytes that suffice for the index with another chunk."""
        channels = len(self._channels)
        names = sum(len(one.data) + 500 for one in self._schemas) + sum(4 * len(one.topic) for one in self._channels)
        return 1000 + names + 500 * channels + (self._state.chunks + 1) * (200 + 10 * channels)

    def _put(self, data: bytes, room: int = 0) -> int:
        """Write behind what counts, over whatever an attempt before left there; the end of the file.

        Fails before anything is written if there is no ``room`` for so many bytes more.
        """
        end = self._state.end
        if self._file.seek(0, SEEK_END) > end:
            self._file.truncate(end)
        try:
            os.posix_fallocate(self._file.fileno(), end, len(data) + room)
        except OSError as error:  # others: of files and file systems that do not know it
            if error.errno in _FULL:
                raise
        self._file.seek(end)
        rest = memoryview(data)
        while rest:
            written = self._file.write(rest)
            if not written:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            rest = rest[written:]
        return end + len(data)


def _records(records: Iterable[McapRecord]) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    data: bytes = builder.end()
    return data
