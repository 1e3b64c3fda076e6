"""An MCAP file of messages that can be closed properly at any moment, on a full disk and after Ctrl-C too.

The package ``mcap`` writes it.  Two things are added:

- Its Writer cannot take back what it failed to write.  So room on the disk is set aside before a group of messages is
  given to it, for all that then waits in memory, and for the index; where there is none, the group is refused and the
  file can still be finished.  (A file system that cannot set room aside is written to until it fails.)
- It runs in a thread of its own, so that an interrupt of the main thread finds no group half added.

Profile, encodings and names are those of rosbag2, so that ROS 2, Foxglove and rosbags all read the file.

Times are nanoseconds.  Reference: MCAP, https://mcap.dev/spec
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from io import BufferedWriter

from mcap.writer import Writer

CHUNK_BYTES = 4 * 2**20
"""Bytes of messages in a chunk: enough to pack well, little to lose."""
LATEST = 2**63 - 1
"""Nanoseconds: ROS counts them with a sign."""

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_MESSAGE, _CHANNEL, _CHUNK = 50, 500, 300
"""Bytes, at most, of a message's head and its line in an index, of a channel and of a chunk in all indexes."""
_PACKED = 1.01
"""Bytes of a chunk that zstd cannot make smaller, over those of its messages."""


class McapFile:
    """Writes to ``file``, which stays open.

    Parameters
    ----------
    file, library
        Where to write, and who does.
    definition
        Gives the text that defines a type ``package/msg/Name``.

    Attributes
    ----------
    groups : int
        How many groups of messages a reader of the finished file will find.

    Raises
    ------
    OSError
        From :meth:`add`, if there is no room; what was added before can still be finished.
    """

    def __init__(self, file: BufferedWriter, library: str, definition: Callable[[str], str]) -> None:
        self.groups = 0
        self._file, self._definition = file, definition
        self._writer = Writer(file, CHUNK_BYTES)
        self._writer.start("ros2", library)
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._fixed = _CHUNK
        """Bytes of schemas and channels, which stand in the file twice."""
        self._chunks = self._waiting = 0
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="mcap")

    def add(self, messages: Sequence[tuple[str, str, bytes]], time: int) -> None:
        """Add a group: topic, type ``package/msg/Name`` and CDR of messages, all received at ``time``, 0 to LATEST."""
        if not messages or not 0 <= time <= LATEST:
            raise ValueError(f"expected messages and a time from 0 to {LATEST}, got {len(messages)} at {time}")
        self._thread.submit(self._add, messages, time).result()

    def finish(self) -> None:
        """Write what waits, the index and the end; nothing may be added any more."""
        with self._thread:
            self._thread.submit(self._finish).result()

    def _add(self, messages: Sequence[tuple[str, str, bytes]], time: int) -> None:
        group = [(self._channel(topic, kind), data) for topic, kind, data in messages]
        size = self._waiting + sum(len(data) + _MESSAGE for _, data in group)
        index = self._fixed + (self._chunks + 2) * (_CHUNK + 10 * len(self._channels))
        self._set_aside(int(_PACKED * size) + index)
        for channel, data in group:
            end = self._file.tell()
            self._writer.add_message(channel, time, data, time)
            self._waiting += len(data) + _MESSAGE
            if self._file.tell() != end:  # a chunk was full
                self._waiting, self._chunks = 0, self._chunks + 1
        self.groups += 1

    def _channel(self, topic: str, kind: str) -> int:
        """The number of the channel of a topic and a type."""
        if kind not in self._schemas:
            definition = self._definition(kind).encode()
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", definition)
            self._fixed += 2 * (len(definition) + _CHANNEL)
        if (topic, kind) not in self._channels:
            self._channels[topic, kind] = self._writer.register_channel(topic, "cdr", self._schemas[kind])
            self._fixed += 2 * (len(topic.encode()) + _CHANNEL)
        return self._channels[topic, kind]

    def _finish(self) -> None:
        self._writer.finish()
        self._file.flush()
        self._file.truncate()

    def _set_aside(self, size: int) -> None:
        try:
            os.posix_fallocate(self._file.fileno(), self._file.tell(), size)
        except OSError as error:  # others: of files and file systems that do not know it
            if error.errno in _FULL:
                raise
