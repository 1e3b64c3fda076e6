"""Results never destroy: what was there stays until something better is whole, and streams are written through."""

import os
import subprocess
import sys
import threading

import pytest

from sq_perception.files import output_file
from sq_perception.files.output_file import OutputFile

OLD, NEW = b"old and good", b"new"


@pytest.fixture
def old(tmp_path):
    path = tmp_path / "out.json"
    path.write_bytes(OLD)
    return path


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_an_old_file_stays_until_the_new_one_is_whole(tmp_path, old):
    old.chmod(0o640)
    with output_file.writing(old) as partial:
        partial.write_bytes(NEW)
        assert partial.suffix == old.suffix
        assert old.read_bytes() == OLD
    assert old.read_bytes() == NEW
    assert old.stat().st_mode & 0o777 == 0o640
    assert names(tmp_path) == ["out.json"]
    (tmp_path / "other").touch()
    output_file.write(tmp_path / "new", NEW)
    assert (tmp_path / "new").stat().st_mode == (tmp_path / "other").stat().st_mode, "a new one's is that of any other"


@pytest.mark.parametrize("reason", [KeyboardInterrupt, ValueError])
def test_what_fails_changes_nothing(tmp_path, old, reason):
    def fail(partial):
        partial.write_bytes(b"half")
        raise reason

    with pytest.raises(reason), output_file.writing(old) as partial:
        fail(partial)
    assert old.read_bytes() == OLD
    assert names(tmp_path) == ["out.json"]


def test_an_unfinished_result_stands_beside_a_good_one(tmp_path, old):
    assert output_file.write(old, NEW, whole=False) == tmp_path / "out.partial.json"
    assert old.read_bytes() == OLD
    assert (tmp_path / "out.partial.json").read_bytes() == NEW
    assert names(tmp_path) == ["out.json", "out.partial.json"]
    old.write_bytes(b"")
    assert output_file.write(old, NEW, whole=False) == old, "nothing is lost with an empty file"
    assert old.read_bytes() == NEW


def test_links_stay_and_their_ends_are_written(tmp_path, old):
    (tmp_path / "to").mkdir()
    (tmp_path / "far").symlink_to("out.json")
    (tmp_path / "to" / "link").symlink_to("../far")
    (tmp_path / "dangling").symlink_to("to/new.json")
    output_file.write(tmp_path / "to" / "link", NEW)
    output_file.write(tmp_path / "dangling", NEW)
    assert old.read_bytes() == (tmp_path / "to" / "new.json").read_bytes() == NEW
    assert (tmp_path / "to" / "link").is_symlink()
    assert (tmp_path / "dangling").is_symlink()


def test_devices_and_fifos_are_written_through(tmp_path):
    device, fifo = tmp_path / "null.json", tmp_path / "fifo.json"
    device.symlink_to("/dev/null")
    os.mkfifo(fifo)
    assert output_file.write(device, NEW) == device
    assert device.is_char_device()
    output_file.check(fifo)
    read = []
    reader = threading.Thread(target=lambda: read.append(fifo.read_bytes()))
    reader.start()
    assert output_file.write(fifo, NEW, whole=False) == fifo
    reader.join(10)
    assert read == [NEW]
    assert fifo.is_fifo()


def test_an_open_descriptor_keeps_what_was_written_to_it(tmp_path):
    """What a shell makes of ``program --json /dev/stdout >> log``: the log grows."""
    log = tmp_path / "log"
    log.write_bytes(OLD)
    code = "from sq_perception.files import output_file; output_file.write('/dev/stdout', b'new')"
    with log.open("ab") as file:
        subprocess.run([sys.executable, "-c", code], stdout=file, check=True, timeout=60)
    assert log.read_bytes() == OLD + NEW
    assert names(tmp_path) == ["log"]


def test_the_error_of_a_full_disk_or_device_names_the_file(old, file_size_limit):
    with pytest.raises(OSError, match="No space left on device: '/dev/full'"):
        output_file.write("/dev/full", NEW)

    def grow():
        with output_file.writing(old) as partial:
            partial.write_bytes(NEW)

    for way in (grow, lambda: output_file.write(old, NEW)):
        with file_size_limit(1), pytest.raises(OSError, match=r"too large: '.*/out\.json'"):
            way()
        assert old.read_bytes() == OLD


@pytest.mark.parametrize("name", ["missing/out.json", ".", "/proc/out.json", "x" * 256])
def test_what_cannot_be_written_is_known_at_once(tmp_path, name):
    with pytest.raises(OSError, match=r"\w"):
        output_file.check(tmp_path / name)
    assert names(tmp_path) == []


def test_two_writers_of_one_file_do_not_mix(tmp_path, old):
    first = OutputFile(old)
    with pytest.raises(OSError, match="another program is writing it"):
        OutputFile(old)
    first.partial.write_bytes(b"half of something long")
    first.keep()  # as a program that was killed leaves it
    output_file.write(old, NEW)
    assert old.read_bytes() == NEW
    assert names(tmp_path) == ["out.json"]


def test_a_file_mounted_by_itself_is_written_in_place(tmp_path, old, monkeypatch):
    """As in a container: it cannot be replaced."""

    def busy(self, target):
        raise OSError(16, "Device or resource busy")

    inode = old.stat().st_ino
    monkeypatch.setattr(type(old), "replace", busy)
    output_file.write(old, NEW)
    assert (old.read_bytes(), old.stat().st_ino) == (NEW, inode)
    assert names(tmp_path) == ["out.json"]
