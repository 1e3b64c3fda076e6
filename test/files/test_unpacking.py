"""Files that lie about their size: what is whole is read, what would fill the memory is refused before it does."""

import io
import struct
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from sq_perception.files import unpacking
from sq_perception.files.unpacking import UnpackingError, grey_image, npz_arrays
from sq_perception.recordings.frame_file import FrameError, read


def npy(array: np.ndarray, version: tuple[int, int] = (1, 0)) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, array, version)
    return file.getvalue()


def header(shape: tuple[int, ...], dtype: str = "<f8") -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
    return file.getvalue()


def archive(tmp_path: Path, **members: bytes) -> Path:
    path = tmp_path / "frame.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(f"{name}.npy", data)
    return path


def png(width: int, height: int, rows: bytes) -> bytes:
    """A PNG whose header says what it is told, 8 bit grey."""
    parts, head = b"\x89PNG\r\n\x1a\n", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    for name, data in ((b"IHDR", head), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")):
        parts += struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
    return parts


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_what_numpy_saves_is_read(tmp_path, save):
    rng = np.random.default_rng(0)
    arrays = {"depth": rng.random((7, 5)).astype(np.float32), "K": np.asfortranarray(rng.random((3, 3)))}
    arrays |= {"labels": rng.integers(0, 9, (7, 5)).astype(">i2"), "empty": np.zeros((0, 4))}
    arrays["projection"] = np.array("orthographic")
    save(tmp_path / "frame.npz", **arrays)
    found = npz_arrays(tmp_path / "frame.npz", (*arrays, "missing"))
    assert set(found) == set(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
    wide = archive(tmp_path, depth=npy(arrays["depth"], (2, 0)))
    np.testing.assert_array_equal(npz_arrays(wide, ["depth"])["depth"], arrays["depth"])


@pytest.mark.parametrize(
    ("member", "words"),
    [
        (header((100_000, 200_000)) + bytes(64), "allocate|EOF"),
        (header((2**40, 2**40)), "not a readable NPZ"),
        (header((2**24,)) + bytes(64), "EOF"),
        (header((3,), "|O") + bytes(24), "allow_pickle"),
        (header((2**20,), "<U64"), "EOF"),
        (npy(np.zeros(3))[:-1], "EOF"),
        (b"\x93NUMPY\x09\x00", "not a readable NPZ"),
        (b"", "not a readable NPZ"),
    ],
    ids=["160 GB", "overflow", "short", "objects", "text", "cut", "version", "nothing"],
)
def test_arrays_that_are_not_what_they_claim_are_refused(tmp_path, member, words):
    path = archive(tmp_path, depth=member)
    with pytest.raises(UnpackingError, match=words):
        npz_arrays(path, ["depth"])
    with pytest.raises(FrameError, match=str(path)):
        read(path)


@pytest.mark.parametrize(("there", "damaged"), [(b"}", b"("), (b"'<f8'", b"'<,48")])
def test_a_damaged_header_is_refused_as_one(tmp_path, there, damaged):
    """What NumPy raises about it is no ValueError, and one such frame ended a run over many."""
    data = header((4,)).replace(there, damaged) + bytes(32)
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(UnpackingError, match="not a readable"):
        unpacking.npy_array(tmp_path / "a.npy")
    with pytest.raises(UnpackingError, match="not a readable"):
        npz_arrays(archive(tmp_path, depth=data), ["depth"])


def test_damage_in_any_packing_is_a_damaged_archive(tmp_path: Path) -> None:
    for packing in (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        path = tmp_path / "frame.npz"
        with zipfile.ZipFile(path, "w", packing) as file:
            file.writestr("depth.npy", npy(np.random.default_rng(0).random(4000)))
        data = bytearray(path.read_bytes())
        data[2000:2040] = bytes(40)
        path.write_bytes(data)
        with pytest.raises(UnpackingError, match="not a readable NPZ archive"):
            npz_arrays(path, ["depth"])


@pytest.mark.parametrize(
    ("bound", "words"), [("MOST_PIXELS", "65536 numbers, got 262144"), ("MOST_BYTES", "65536 bytes")]
)
def test_an_archive_that_unpacks_to_far_more_than_it_weighs_is_refused(tmp_path, monkeypatch, bound, words):
    monkeypatch.setattr(unpacking, bound, 2**16)
    path = archive(tmp_path, depth=npy(np.zeros((2**9, 2**9))))
    assert path.stat().st_size < 2**13
    with pytest.raises(UnpackingError, match=f"at most {words}"):
        npz_arrays(path, ["depth"])


def test_grey_images_are_read(tmp_path):
    rng = np.random.default_rng(1)
    for name, dtype in (("a.png", np.uint8), ("b.png", np.uint16), ("c.bmp", np.uint8), ("c.tif", np.uint16)):
        grey = rng.integers(0, np.iinfo(dtype).max, (6, 9)).astype(dtype)
        assert cv2.imwrite(str(tmp_path / name), grey)
        np.testing.assert_array_equal(grey_image(tmp_path / name), grey)
    far = rng.random((6, 9), dtype=np.float32)
    far[2, 3] = np.nan
    assert cv2.imwrite(str(tmp_path / "e.tiff"), far)
    np.testing.assert_array_equal(grey_image(tmp_path / "e.tiff"), far)
    (tmp_path / "d.png").write_bytes(png(3, 2, b"\x00\x01\x02\x03\x00\x04\x05\x06"))
    np.testing.assert_array_equal(grey_image(tmp_path / "d.png"), [[1, 2, 3], [4, 5, 6]])


def test_a_palette_is_named_as_what_is_in_the_way(tmp_path):
    """As of masks that are drawn in colours: their labels are the indices."""
    image = Image.fromarray(np.array([[0, 1], [2, 0]], np.uint8), "P")
    for name, colours in (("colours", [0, 0, 0, 128, 0, 0, 0, 128, 0]), ("greys", [0, 0, 0, 1, 1, 1, 2, 2, 2])):
        image.putpalette(colours)
        image.save(tmp_path / f"{name}.png")
    with pytest.raises(UnpackingError, match="got a palette of colours: save its indices"):
        grey_image(tmp_path / "colours.png")
    assert grey_image(tmp_path / "greys.png").tolist() == [[0, 1], [2, 0]]


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (png(9_000, 9_000, bytes(2000)), "1 to 33554432 pixels, got 9000 x 9000"),
        (png(20_000, 20_000, bytes(2000)), "33554432 pixels"),
        (png(2**31 - 1, 2**31 - 1, b""), "pixels"),
        (png(0, 5, b""), "pixels"),
        (b"BM" + bytes(16) + struct.pack("<ii", 50_000, -50_000) + bytes(32), "pixels"),
        (b"\x89PNG\r\n\x1a\n", "PNG, BMP or TIFF"),
        (b"GIF89a", "PNG, BMP or TIFF"),
        (b"", "PNG, BMP or TIFF"),
    ],
    ids=["large", "larger", "overflow", "none", "bmp", "cut", "other", "nothing"],
)
def test_images_that_would_fill_the_memory_are_refused(tmp_path, data, words):
    (tmp_path / "some.png").write_bytes(data)
    with pytest.raises(UnpackingError, match=words):
        grey_image(tmp_path / "some.png")


BOMB = "a: &a [x, x]\n" + "".join(
    f"{new}: &{new} [*{old}, *{old}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BOMB, "alias"),
        ("a: &a\n  b: *a\n", "alias"),
        ("[" * 500_000, "recursion"),
        ("- " * 100_000, "recursion"),
        ("x: " + "y" * 2**20, "at most 1048576 bytes"),
        ("!!python/object/apply:os.system ['true']", "could not determine a constructor"),
        (b"\xff\xfe\x00", "utf-8"),
        ("a: [", "expected"),
        ("when: 2020-99-99", "month"),
        ("a: 1\n---\nb: 2", "one document"),
    ],
    ids=["bomb", "loop", "deep", "lists", "long", "code", "bytes", "cut", "date", "two"],
)
def test_what_is_no_plain_data_is_refused_with_a_reason(tmp_path, text, words):
    path = tmp_path / "some.yaml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(UnpackingError, match=words):
        unpacking.read_yaml(path)


def test_plain_data_is_read(tmp_path):
    path = tmp_path / "some.yaml"
    path.write_text("width: 640\nk: [1.0, 0, 3]\nroi: {x_offset: 0}\nname: 'a # b'\n")
    assert unpacking.read_yaml(path) == {"width": 640, "k": [1.0, 0, 3], "roi": {"x_offset": 0}, "name": "a # b"}
    path.write_text("")
    assert unpacking.read_yaml(path) is None
    assert unpacking.yaml_documents(b"a: 1\n---\nb: 2\n---\n") == [{"a": 1}, {"b": 2}, None]
    with pytest.raises(UnpackingError, match="No such file"):
        unpacking.read_yaml(tmp_path / "none.yaml")
