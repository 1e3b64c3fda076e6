"""Depth images and intrinsics as other tools write them, and what is taken of an image."""

import json
import sys

import cv2
import numpy as np
import pytest
from PIL import Image

from sq_perception.imaging.camera import Camera
from sq_perception.recordings.bag_file import InputOptions
from sq_perception.recordings.frame_file import FrameError, Reading, read
from sq_perception.recordings.inputs import RecordedInput

NUMBERS = "60,61,31.5,23.5"
CAMERA = Camera(64, 48, 60.0, 61.0, 31.5, 23.5)


def save(path, value=1000, dtype=np.uint16):
    image = np.full((48, 64), value, dtype)
    image[0, 0] = 0
    np.save(path, image) if path.suffix == ".npy" else cv2.imwrite(str(path), image)
    return path


@pytest.mark.parametrize(
    ("name", "value", "dtype"),
    [
        *[("a.npy", 0.8, np.float32), ("a.npy", 0.8, ">f8"), ("a.npy", 800, np.uint16), ("a.npy", 800, ">u2")],
        *[("a.tiff", 0.8, np.float32), ("a.tiff", 800, np.uint16), ("a.png", 800, np.uint16)],
    ],
)
def test_a_file_has_the_units_of_its_type(tmp_path, name, value, dtype):
    frame = read(save(tmp_path / name, value, dtype), NUMBERS)
    assert (frame.depth.dtype, frame.depth[1, 1]) == (np.float32, pytest.approx(0.8))
    assert np.isnan(frame.depth[0, 0])
    if name == "a.tiff":
        (tmp_path / "b.tif").write_bytes((tmp_path / name).read_bytes()[:100])
        with pytest.raises(FrameError, match="not a readable image"):
            read(tmp_path / "b.tif", NUMBERS)


@pytest.mark.parametrize("array", [np.zeros((2, 3, 4), np.uint16), np.zeros((0, 4)), np.zeros((4, 4), np.int8)])
def test_an_npy_of_another_form_is_refused(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(FrameError, match=r"expected an image|has 16 bit"):
        read(tmp_path / "a.npy", NUMBERS)


def test_a_hostile_npy_is_refused(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(FrameError, match="objects"):
        read(path, NUMBERS)
    path.write_bytes(save(path).read_bytes()[:-1])
    with pytest.raises(FrameError, match="file size"):
        read(path, NUMBERS)


@pytest.fixture
def exr():
    return pytest.importorskip("OpenEXR", reason="needs the extra 'exr'")


def save_exr(exr, path, **channels):
    with exr.File({"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}, channels) as file:
        file.write(str(path))
    return path


@pytest.mark.parametrize("names", ["Z", "Depth.V", "RGB", "RAZ"])
def test_an_exr_is_metres(tmp_path, exr, names):
    """The depth pass of a renderer, by itself, beside a picture, or as a grey picture."""
    depth = np.random.default_rng(0).uniform(0.5, 2, (48, 64)).astype(np.float32)
    depth[2, 3] = np.nan
    channels = dict.fromkeys([names] if "." in names else names, depth)
    if "A" in channels:
        channels["A"] = channels["R"] = np.ones_like(depth)
    frame = read(save_exr(exr, tmp_path / "a.exr", **channels), NUMBERS)
    np.testing.assert_array_equal(frame.depth, depth)


def test_the_extra_of_an_exr_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    (tmp_path / "a.exr").touch()
    with pytest.raises(FrameError, match=r"sq_perception\[exr\]"):
        read(tmp_path / "a.exr", NUMBERS)


def test_a_hostile_exr_is_refused(tmp_path, exr):
    plain = np.ones((48, 64), np.float32)
    path = save_exr(exr, tmp_path / "a.exr", Z=plain)
    whole = path.read_bytes()
    window = np.array([0, 0, 63, 47], "<i4").tobytes()
    huge = whole.replace(window, np.array([0, 0, 2**20, 2**20], "<i4").tobytes())
    for data, words in ((b"", "not a readable"), (whole[:-9], "not a readable"), (huge, "expected 1 to")):
        path.write_bytes(data)
        with pytest.raises(FrameError, match=words):
            read(path, NUMBERS)
    with pytest.raises(FrameError, match="channel Z"):
        read(save_exr(exr, path, R=plain, G=2 * plain), NUMBERS)


def test_scale_is_what_is_said_or_what_the_name_says(tmp_path):
    tum, other = save(tmp_path / "1305031102.160407.png"), save(tmp_path / "7.5.png")
    frame = read(tum, NUMBERS)
    assert frame.depth[1, 1] == pytest.approx(0.2)
    assert "5000 units are a metre" in frame.notes
    assert frame.encoding == "32FC1", "millimetres would round it"
    for path, scale, depth in ((tum, 1000.0, 1.0), (other, None, 1.0), (other, 5000.0, 0.2)):
        frame = read(path, NUMBERS, reading=Reading(scale=scale))
        assert frame.depth[1, 1] == pytest.approx(depth)
        assert not frame.notes


def test_what_is_taken_of_an_image(tmp_path):
    path = tmp_path / "a.npz"
    depth = np.tile(np.linspace(0.5, 1.5, 64, dtype=np.float32), (48, 1))
    labels = np.arange(48 * 64, dtype=np.int32).reshape(48, 64)
    np.savez(path, depth=depth, labels=labels, K=CAMERA.matrix)
    whole, frame = read(path), read(path, reading=Reading(nearest=0.7, farthest=1.2, region=(10, 5, 50, 40)))
    part = np.s_[5:45, 10:60]
    np.testing.assert_array_equal(np.isfinite(frame.depth), (depth[part] >= 0.7) & (depth[part] <= 1.2))
    np.testing.assert_array_equal(frame.labels, labels[part])
    points = whole.camera.unproject(np.array([20.0]), np.array([15.0]), np.array([1.0]))
    np.testing.assert_allclose(frame.camera.unproject(np.array([10.0]), np.array([10.0]), np.array([1.0])), points)
    with pytest.raises(FrameError, match="within 64 x 48"):
        read(path, reading=Reading(region=(10, 5, 55, 40)))


@pytest.mark.parametrize(
    "wrong",
    [{"scale": 0.0}, {"scale": np.inf}, {"nearest": 2.0, "farthest": 1.0}, {"nearest": -1.0},
     {"region": (0, 0, 0, 4)}, {"region": (-1, 0, 4, 4)}],
)  # fmt: skip
def test_limits_that_leave_nothing_are_refused(wrong):
    with pytest.raises(ValueError, match="expected"):
        Reading(**wrong)


def test_masks_are_found_by_name(tmp_path):
    """Plain images of labels, the indices of a palette, and the binary images of BOP."""
    path, plain = save(tmp_path / "000003.png"), tmp_path / "masks"
    plain.mkdir()
    with pytest.raises(FrameError, match="no such mask"):
        read(path, NUMBERS, reading=Reading(masks=plain))
    labels = np.zeros((48, 64), np.uint8)
    labels[10:20, 10:20], labels[30:40, 10:20] = 1, 2
    palette, separate = tmp_path / "palette", tmp_path / "mask_visib"
    palette.mkdir(), separate.mkdir()
    image = Image.fromarray(labels)
    image.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    image.save(palette / "000003.png")
    for number in (1, 2):
        cv2.imwrite(str(separate / f"000003_00000{number - 1}.png"), 255 * (labels == number).astype(np.uint8))
    cv2.imwrite(str(separate / "000013_000000.png"), np.full((48, 64), 255, np.uint8))
    cv2.imwrite(str(plain / "000003.png"), labels)
    for folder in (plain, palette, separate):
        np.testing.assert_array_equal(read(path, NUMBERS, reading=Reading(masks=folder)).labels, labels)
    cv2.imwrite(str(separate / "000003_000002.png"), labels[1:])
    cv2.imwrite(str(plain / "000003.png"), labels[:-1])
    for folder, said in ((separate, "one size"), (plain, "shape")):
        with pytest.raises(FrameError, match=said):
            read(path, NUMBERS, reading=Reading(masks=folder))


def test_matrices_beside_frames_are_no_frames(tmp_path):
    save(tmp_path / "a.png")
    save(tmp_path / "K.npy")
    assert [file for file, _ in RecordedInput([str(tmp_path)], InputOptions(NUMBERS))] == [str(tmp_path / "a.png")]
    (tmp_path / "a.png").unlink()
    assert [file for file, _ in RecordedInput([str(tmp_path)], InputOptions(NUMBERS))] == [str(tmp_path / "K.npy")]


def npz(path, depth, **fields):
    np.savez(path, depth=np.full((48, 64), depth, np.float32), **fields)
    return path


MATRIX = CAMERA.matrix


@pytest.mark.parametrize(
    ("depth", "fields", "projection", "said"),
    [
        (800.0, {"K": MATRIX}, "pinhole", "for millimetres the depth scale is 1000"),
        (0.0008, {"K": MATRIX}, "pinhole", "for metres the depth scale is 1"),
        (0.8, {"K": MATRIX}, "orthographic", "has the matrix K of a pinhole camera"),
        (2.5, {}, "orthographic", "a metric image is not orthographic"),
    ],
)
def test_the_likely_mistake_is_named(tmp_path, depth, fields, projection, said):
    path = npz(tmp_path / "a.npz", depth, **fields)
    assert said in read(path, projection=projection).warning
    assert not read(npz(path, 0.8, K=MATRIX)).warning
    assert not read(npz(path, 0.8), projection="orthographic").warning


@pytest.mark.parametrize(
    ("name", "dtype"), [("a.npz", np.float32), ("a.npz", np.float16), ("a.npy", np.float32), ("a.tiff", np.float32)],
)
def test_a_scale_holds_for_floats_too(tmp_path, name, dtype):
    """Half floats are divided in full precision."""
    path = tmp_path / name
    if path.suffix == ".npz":
        np.savez(path, depth=np.full((48, 64), 1234, dtype), K=MATRIX)
    else:
        save(path, 1234, dtype)
    frame = read(path, NUMBERS, reading=Reading(scale=1000.0))
    assert frame.depth[1, 1] == np.float32(1.234)
    assert not frame.warning


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "cube.npz"])
@pytest.mark.filterwarnings("error")
def test_a_number_that_float32_does_not_hold_is_no_reading(tmp_path, name):
    depth = np.full((48, 64), 0.5)
    depth[0, :3] = np.finfo(float).max, -np.finfo(float).max, np.inf
    fields = {"K": CAMERA.matrix} if name == "a.npz" else {"projection": "orthographic"}
    np.save(tmp_path / name, depth) if name == "a.npy" else np.savez(tmp_path / name, depth=depth, **fields)
    frame = read(tmp_path / name, NUMBERS)
    assert frame.is_cube == (name == "cube.npz"), "an orthographic archive says so itself"
    assert np.isnan(frame.depth[0, :3]).all()
    assert np.all(frame.depth[1:] == 0.5)


def test_a_broken_link_in_a_folder_is_reported_and_an_empty_name_is_no_folder(tmp_path, monkeypatch):
    """As of a data set of which not all was fetched."""
    save(tmp_path / "a.png")
    monkeypatch.chdir(tmp_path)
    ((_, error),) = RecordedInput([""])
    assert "got an empty one" in str(error)
    (tmp_path / "b.png").symlink_to(tmp_path / "elsewhere" / "b.png")
    (_, frame), (file, error) = RecordedInput([str(tmp_path)], InputOptions(NUMBERS))
    assert frame.camera == CAMERA
    assert isinstance(error, FrameError)
    assert file == str(tmp_path / "b.png")


def test_a_folder_without_frames_gives_those_of_its_subfolders(tmp_path):
    """In natural order, with the camera beside them or above; a folder with frames keeps to them."""
    for name in ("take10/b.png", "take2/depth/a.png", "take2/depth/deeper/x.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        save(tmp_path / name)
    for folder, focal in ((tmp_path, 60), (tmp_path / "take10", 70)):
        known = {"width": 64, "height": 48, "intrinsic_matrix": [focal, 0, 0, 0, focal, 0, 31.5, 23.5, 1]}
        (folder / "camera_intrinsic.json").write_text(json.dumps(known))
    found = list(RecordedInput([str(tmp_path)]))
    assert [file for file, _ in found] == [str(tmp_path / name) for name in ("take2/depth/a.png", "take10/b.png")]
    assert [frame.camera.fx for _, frame in found] == [60, 70]


def test_a_folder_of_names_that_are_times_gives_them_by_time(tmp_path):
    names = ("5.0", "5.05", "5.1", "5.15", "10.0")
    for name in names:
        save(tmp_path / f"{name}.png")
    found = list(RecordedInput([str(tmp_path)], InputOptions(NUMBERS)))
    assert [frame.name for _, frame in found] == [f"{name}.png" for name in names]
    save(tmp_path / "5.1_b.png")
    found = list(RecordedInput([str(tmp_path)], InputOptions(NUMBERS)))
    assert [frame.name for _, frame in found][:4] == ["5.0.png", "5.1.png", "5.1_b.png", "5.05.png"]


def test_intrinsics_of_another_resolution_are_noticed(tmp_path):
    assert not read(save(tmp_path / "a.png"), NUMBERS).warning
    assert "another resolution's?" in read(save(tmp_path / "a.png"), "600,610,315,235").warning


def test_an_image_of_one_channel_is_one(tmp_path):
    depth = np.full((48, 64), 0.8, np.float32)
    for k, shape in enumerate(((48, 64, 1), (1, 48, 64))):
        np.save(tmp_path / f"{k}.npy", depth.reshape(shape))
        np.testing.assert_array_equal(read(tmp_path / f"{k}.npy", NUMBERS).depth, depth)
    np.save(tmp_path / "K.npy", CAMERA.matrix)
    assert read(tmp_path / "0.npy", tmp_path / "K.npy").camera == CAMERA
