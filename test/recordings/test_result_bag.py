"""Results as a bag: independent readers find what the JSON says, with the input's times and names, whatever happens."""

import gc
import json
import sys
import tracemalloc
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")
pytest.importorskip("mcap", reason="needs the extra 'bags'")

from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from recover_runs import BODIES, CAMERA, run
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from sq_msgs_py.depth_image import Intrinsics, depth_to_message, grey_to_message, intrinsics_to_message
from sq_msgs_py.superquadrics import from_message
from sq_perception import RecordedFrame, Recoverer, Superquadric
from sq_perception.imaging import raycast, unit_cube
from sq_perception.recordings import result_bag
from sq_perception.recordings.bag_file import InputOptions, RecordedBag
from sq_perception.recordings.frame_file import FrameError, Reading, Stamp
from sq_perception.recordings.result_bag import MARKERS, RENDERED, SUPERQUADRICS, ResultBag

TYPES = get_typestore(Stores.ROS2_JAZZY)
SECOND = 10**9
TOPIC, INFO = "/camera/depth/image_rect_raw", "/camera/depth/camera_info"
ALL = "depth,rendered,labels"


def depth_of(bodies=BODIES):
    rendered, _ = raycast.render(bodies, CAMERA)
    return np.where(np.isfinite(rendered), rendered, np.nan).astype(np.float32)


def header(stamp, frame_id="depth_optical"):
    time = result_bag.types("builtin_interfaces/msg/Time")(sec=stamp.sec, nanosec=stamp.nanosec)
    return result_bag.types("std_msgs/msg/Header")(stamp=time, frame_id=frame_id)


def record(path, depths, encoding="16UC1", frame_ids=()):
    """A bag of depth images, taken at 7.1, 7.2 ... and received at 100.003, 100.103 ..."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {
            topic: writer.add_connection(topic, f"sensor_msgs/msg/{kind}", typestore=TYPES)
            for topic, kind in ((TOPIC, "Image"), (INFO, "CameraInfo"))
        }
        for k, depth in enumerate(depths):
            at = header(Stamp(7, (k + 1) * 10**8), *frame_ids[k : k + 1])
            known = Intrinsics(CAMERA.width, CAMERA.height, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
            received = 100 * SECOND + 3_000_000 + k * 10**8
            info = intrinsics_to_message(known, at, result_bag.types)
            writer.write(topics[INFO], received - 1000, result_bag.as_cdr(info))
            if encoding == "mono8":
                image = grey_to_message(depth, at, result_bag.types)
            else:
                image = depth_to_message(depth, at, encoding, result_bag.types)
            writer.write(topics[TOPIC], received, result_bag.as_cdr(image))
    return path


def recover(*arguments, code=0):
    assert run(*arguments) == code


def messages(path):
    """Messages by topic, each with its time, as rosbags reads them; the index and all checksums are looked at first."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        counted = reader.get_summary().statistics.message_count
        assert len(list(reader.iter_messages())) == counted
    found = {}
    with Reader(path) as reader:
        for connection, time, data in reader.messages():
            message = TYPES.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((time, message))
    assert sum(map(len, found.values())) == counted
    return found


@pytest.fixture(scope="module")
def scene():
    frame = RecordedFrame(depth_of(), CAMERA, None, "scene", encoding="32FC1")
    return frame, Recoverer(method="symmetry").recover(frame.depth, frame.camera)


def test_masks_of_a_bag_are_those_of_its_images(tmp_path, scene):
    """Written with labels and read again."""
    frame, recovery = scene
    labels = np.where(recovery.labels > 0, recovery.labels + 4, 0)
    out = tmp_path / "out.mcap"
    with ResultBag(out, ("depth", "labels")) as bag:
        for k in range(3):
            bag.add(replace(frame, stamp=Stamp(7, k)), replace(recovery, labels=labels * (k != 1)), None)
    with RecordedBag(out) as read:
        assert read.topic == "/depth/image"
        for k, one in enumerate(read):
            np.testing.assert_array_equal(one.labels, labels * (k != 1))


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_numbers_times_and_names_survive(tmp_path, encoding):
    """Written, then read by rosbags, and by the mcap package with a decoder of its own."""
    decoder = pytest.importorskip("mcap_ros2.decoder", reason="needs the extra 'test'")
    bag, out = record(tmp_path / "bag", 3 * [depth_of()], encoding), tmp_path / "results.mcap"
    recover(bag, "--mcap", out, "--mcap-images", ALL, "--json", tmp_path / "out.json")
    frames = json.loads((tmp_path / "out.json").read_text())["frames"]
    found = messages(out)
    topics = (TOPIC, INFO, "/mask/image", SUPERQUADRICS, MARKERS, RENDERED)
    assert {topic: len(entries) for topic, entries in found.items()} == dict.fromkeys(topics, 3)
    for topic, entries in found.items():
        for k, (time, message) in enumerate(entries):
            assert time == 100 * SECOND + 3_000_000 + k * 10**8
            for one in message.markers if topic == MARKERS else [message]:
                stamp = one.header.stamp
                assert (stamp.sec, stamp.nanosec, one.header.frame_id) == (7, (k + 1) * 10**8, "depth_optical")
    with out.open("rb") as file:
        reader = make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        decoded = list(reader.iter_decoded_messages(topics=[SUPERQUADRICS]))
    assert [one.schema.name for one in decoded] == 3 * ["sensor_msgs/msg/PointCloud2"]
    for entry, one, (_, message) in zip(frames, decoded, found[SUPERQUADRICS], strict=True):
        for array in (from_message(one.decoded_message), from_message(message)):
            assert len(array) == len(entry["superquadrics"]) == 2
            for k, body in enumerate(entry["superquadrics"]):
                for name in ("size", "shape", "translation", "rotation", "score", "residual", "sigma_size"):
                    expected = np.array(body[name], dtype=float).astype(np.float32)  # null is NaN
                    np.testing.assert_array_equal(getattr(array, name)[k], expected)
                assert array.status[k] == {"converged": 0, "weak": 1}[body["status"]]
    for _, image in found["/mask/image"]:
        assert image.encoding == "mono16"  # no depth to whoever reads the results as an input
        assert set(np.unique(image.data.view("<u2"))) >= {0, *from_message(found[SUPERQUADRICS][0][1]).id}


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_what_went_in_can_be_read_again(tmp_path, encoding):
    """The results hold the input: recovering from them gives the same bodies, and a bag with the same images."""
    bag = record(tmp_path / "bag", [depth_of()], encoding)
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    recover(bag, "--mcap", first)
    recover(first, "--mcap", second)
    assert first.read_bytes() == second.read_bytes()
    recover(first, "--mcap", second, "--mcap-images", "none")
    assert set(messages(second)) == {SUPERQUADRICS, MARKERS}
    with RecordedBag(bag) as before, RecordedBag(first) as after:
        (one,), (two,) = before, after
    np.testing.assert_array_equal(one.depth, two.depth)
    for name in ("camera", "stamp", "topic", "frame_id", "encoding", "received"):
        assert getattr(one, name) == getattr(two, name)
    (_, image), (_, original) = messages(first)[TOPIC][0], messages(next(bag.glob("*.mcap")))[TOPIC][0]
    np.testing.assert_array_equal(image.data, original.data)


def test_depth_in_other_units_is_written_as_it_was_read(tmp_path, scene):
    bag = record(tmp_path / "bag", [depth_of()])
    with RecordedBag(bag, InputOptions(reading=Reading(scale=1e4))) as recorded:
        (frame,) = recorded
    with ResultBag(tmp_path / "results.mcap") as results:
        results.add(frame, scene[1], None)
    with RecordedBag(tmp_path / "results.mcap") as written:
        (again,) = written
    np.testing.assert_array_equal(again.depth, frame.depth)
    assert frame.depth[60, 57] == pytest.approx(depth_of()[60, 57] / 10, abs=5.1e-5)


def test_tracks_keep_their_ids_and_each_message_shows_its_bodies_alone(tmp_path):
    """One body leaves, and comes back: wherever a player begins, no marker of another frame stays."""
    depths = [depth_of(), depth_of(), depth_of(BODIES[:1]), depth_of(BODIES[:1]), depth_of()]
    bag, out = record(tmp_path / "bag", depths), tmp_path / "results.mcap"
    recover(bag, "--track", "--mcap", out, "--json", tmp_path / "out.json")
    frames = json.loads((tmp_path / "out.json").read_text())["frames"]
    found = messages(out)
    for entry, (_, cloud), (_, array) in zip(frames, found[SUPERQUADRICS], found[MARKERS], strict=True):
        bodies = from_message(cloud)
        tracks = [one["track"] for one in entry["superquadrics"]]
        assert list(bodies.id) == [one["id"] for one in tracks]
        np.testing.assert_array_equal(bodies.size, np.float32([one["size"] for one in tracks]))
        np.testing.assert_array_equal(bodies.rotation, np.float32([one["rotation"] for one in tracks]))
        first, *others = array.markers
        assert first.action == first.DELETEALL
        assert {(one.ns, one.id) for one in others} == {
            (f"superquadrics/{kind}", one) for kind in ("surface", "outline") for one in bodies.id
        }
    assert [len(one) for one in map(from_message, (message for _, message in found[SUPERQUADRICS]))] == [2, 2, 1, 1, 2]


def test_files_have_times_that_are_the_same_in_every_run(tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    for name in ("f1.npz", "f2.npz", "99999999999.5.npz"):
        np.savez(folder / name, depth=depth_of(), K=CAMERA.matrix)
    outs = [tmp_path / name for name in ("a.mcap", "b.mcap")]
    for out in outs:
        recover(folder, "--mcap", out)
    assert outs[0].read_bytes() == outs[1].read_bytes()
    found = messages(outs[0])
    assert set(found) == {"/depth/image", "/depth/camera_info", SUPERQUADRICS, MARKERS}
    for k, (time, message) in enumerate(found["/depth/image"]):
        stamp = message.header.stamp
        assert time == stamp.sec * SECOND + stamp.nanosec == (k + 1) * 10**8
        assert message.header.frame_id == "camera_depth_optical_frame"
        np.testing.assert_array_equal(message.data.view("<f4").reshape(120, 160), depth_of())
    (_, info) = found["/depth/camera_info"][0]
    np.testing.assert_array_equal(info.k.reshape(3, 3), CAMERA.matrix)
    recover((folder / "f1.npz").rename(tmp_path / "1305031102.160407.npz"), "--mcap", outs[0])
    assert messages(outs[0])[SUPERQUADRICS][0][0] == 1305031102160407000, "a name that is a time is a stamp"


def test_grey_images_of_the_cube(tmp_path):
    """No camera_info; bodies in the cube; the grey values that were read."""
    body = Superquadric([0.2, 0.15, 0.1], [0.3, 0.8], [0.5, 0.5, 0.5], [0.2, 0.3, 0.1, 0.9])
    rendered, _ = raycast.render(unit_cube.optical_from_cube(body), unit_cube.camera())
    grey = unit_cube.grey_from_depth(rendered)
    bag, out = record(tmp_path / "bag", [grey], "mono8"), tmp_path / "results.mcap"
    recover(bag, "--projection", "orthographic", "--mcap", out, "--mcap-images", ALL)
    found = messages(out)
    assert INFO not in found
    np.testing.assert_array_equal(found[TOPIC][0][1].data.reshape(256, 256), grey)
    np.testing.assert_allclose(from_message(found[SUPERQUADRICS][0][1]).translation, body.translation[None], atol=0.01)
    difference = np.abs(found[RENDERED][0][1].data.reshape(256, 256).astype(int) - grey)
    assert np.median(difference[grey > 0]) <= 1


def test_names_of_recordings_are_not_trusted(tmp_path, scene):
    frame, recovery = scene
    topics = ("/a//b", "no_slash", "/1st", "/" + 300 * "a", SUPERQUADRICS, RENDERED, "/mask/image", "/good/name")
    out = tmp_path / "results.mcap"
    with ResultBag(out) as bag:
        for topic in topics:
            bag.add(replace(frame, topic=topic, frame_id="optical", stamp=Stamp(1, 0), received=5), recovery, None)
        with pytest.raises(FrameError, match="frame_id"):
            bag.add(replace(frame, topic="/a", frame_id=256 * "x", stamp=Stamp(1, 0), received=5), recovery, None)
    found = messages(out)
    assert [len(found[topic]) for topic in ("/depth/image", "/good/name")] == [len(topics) - 1, 1]


def test_a_frame_that_the_bag_refuses_is_in_all_other_files(tmp_path, capsys):
    """It was read and recovered: no frame is unreadable."""
    bag = record(tmp_path / "bag", 3 * [depth_of()], frame_ids=("optical", 256 * "x", "optical"))
    out, document, page = (tmp_path / f"out.{suffix}" for suffix in ("mcap", "json", "html"))
    recover(bag, "--mcap", out, "--json", document, "--jsonl", tmp_path / "out.jsonl", "--html", page, code=1)
    errors = capsys.readouterr().err
    assert "--mcap: 1 of the frames are not in it: bag_7.200000000: frame_id: expected at most 255" in errors
    assert "3 frames, 6 objects (0 failed), median" in errors
    assert len(json.loads(document.read_text())["frames"]) == 3
    assert len((tmp_path / "out.jsonl").read_text().splitlines()) == 4
    assert page.read_text().count("<script>frames.push") == 3
    assert [time % SECOND for time, _ in messages(out)[SUPERQUADRICS]] == [3_000_000, 203_000_000]


def test_times_of_recordings_are_not_trusted(tmp_path, scene):
    """Before 1970, beyond the end of time, nanoseconds above a second: nothing that a reader would choke on."""
    frame, recovery = scene
    out = tmp_path / "results.mcap"
    stamps = (Stamp(-(2**31), 2**32 - 1), Stamp(2**31 - 1, 0), Stamp(0, 0))
    with ResultBag(out) as bag:
        for stamp in stamps:
            for received in (-5, 2**64 - 1):
                bag.add(replace(frame, topic="/a", stamp=stamp, received=received), recovery, None)
        bag.add(replace(frame, stamp=Stamp(10**17, 0)), recovery, None)
    found = [(time, message.header.stamp) for time, message in messages(out)[SUPERQUADRICS]]
    assert {time for time, _ in found} == {0, 2**63 - 1, 10**8}
    assert {(one.sec, one.nanosec) for _, one in found} == {*stamps, (0, 10**8)}


def leftovers(folder):
    return [path.name for path in folder.iterdir() if "partial" in path.name]


def test_a_name_that_cannot_be_written_is_said_at_once(tmp_path, capsys):
    path = tmp_path / "1.5.npz"
    np.savez(path, depth=depth_of(), K=CAMERA.matrix)
    (tmp_path / "folder.mcap").mkdir()
    (lone,) = record(tmp_path / "bag", [depth_of()]).glob("*.mcap")
    for source, arguments, said in (
        (path, ["--mcap", tmp_path / "nowhere" / "results.mcap"], "folder does not exist"),
        (path, ["--mcap", tmp_path / "results.bag"], "ends in .mcap"),
        (path, ["--mcap", tmp_path / "folder.mcap"], "Is a directory"),
        (path, ["--mcap", tmp_path / "results.mcap", "--mcap-images", "depth,colour"], "colour"),
        (lone, ["--mcap", lone], "this is an input"),
    ):
        recover(source, *arguments, code=2)
        assert said in capsys.readouterr().err
    recover(tmp_path / "missing.npz", "--mcap", tmp_path / "results.mcap", code=1)
    assert not (tmp_path / "results.mcap").exists()
    assert not leftovers(tmp_path)


def test_without_mcap_one_sentence_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.delitem(sys.modules, "sq_perception.recordings.result_bag")
    monkeypatch.delattr("sq_perception.recordings.result_bag")
    for name in [name for name in sys.modules if name.partition(".")[0] == "mcap"]:
        monkeypatch.setitem(sys.modules, name, None)
    recover(tmp_path / "missing.npz", "--mcap", tmp_path / "results.mcap", code=1)
    message = "sq-perception: --mcap: writing bags needs the module 'mcap': pip install 'sq_perception[bags]'"
    assert capsys.readouterr().err.splitlines() == [message]


def test_ctrl_c_leaves_a_whole_file(tmp_path, monkeypatch, capsys):
    """While the third frame is worked on: the frames that were done are there."""
    bag, out = record(tmp_path / "bag", 5 * [depth_of()]), tmp_path / "results.mcap"
    real, calls = ResultBag.add, []

    def interrupted(*arguments, **options):
        calls.append(0)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(*arguments, **options)

    monkeypatch.setattr(ResultBag, "add", interrupted)
    recover(bag, "--mcap", out, code=130)
    assert "interrupted" in capsys.readouterr().err
    assert [len(entries) for entries in messages(out).values()] == 4 * [2]
    assert not leftovers(tmp_path)


def test_a_full_device_is_one_line(tmp_path, capsys):
    bag, out = record(tmp_path / "bag", [depth_of()]), tmp_path / "results.mcap"
    out.symlink_to("/dev/full")
    recover(bag, "--mcap", out, code=1)
    errors = capsys.readouterr().err
    assert "No space left on device" in errors
    assert errors.count("\n") == 2, "and the summary"
    assert out.is_symlink()
    assert not leftovers(tmp_path)


def test_a_good_file_outlives_a_bag_that_is_not_whole(tmp_path, scene):
    out = tmp_path / "results.mcap"
    out.write_bytes(b"good")
    bag = ResultBag(out)
    bag.add(*scene, None)
    assert bag.close(whole=False) == tmp_path / "results.partial.mcap"
    assert out.read_bytes() == b"good"
    assert len(messages(tmp_path / "results.partial.mcap")[SUPERQUADRICS]) == 1
    assert leftovers(tmp_path) == ["results.partial.mcap"]


@pytest.mark.parametrize("chunk", [1, 2**30])
def test_a_disk_that_fills_up_keeps_what_was_written(tmp_path, monkeypatch, capsys, file_size_limit, chunk):
    """The kernel allows files of 200 kB: what is in the first chunks can be read without an index."""
    noise = np.random.default_rng(1).uniform(3, 4, (6, 120, 160))  # does not pack well
    depths = np.where(np.isfinite(depth_of()), depth_of(), noise)
    bag, out = record(tmp_path / "bag", depths), tmp_path / "results.mcap"
    monkeypatch.setattr(result_bag, "CHUNK_BYTES", chunk)
    with file_size_limit(200_000):
        recover(bag, "--mcap", out, code=1)
    (said,) = [line for line in capsys.readouterr().err.splitlines() if ".mcap" in line]
    assert "File too large; kept without an index, from which 'mcap recover' makes a file" in said
    assert leftovers(tmp_path) == ["results.partial.mcap"]
    assert not out.exists()
    if chunk == 1:
        kept = []
        with (tmp_path / "results.partial.mcap").open("rb") as file, suppress(EndOfFile):
            for _, channel, _ in NonSeekingReader(file).iter_messages(log_time_order=False):
                kept.append(channel.topic)
        assert kept.count(SUPERQUADRICS) >= 1


def test_memory_does_not_grow_with_the_frames(tmp_path, scene, monkeypatch):
    """200 frames more of 80 kB each leave less than 100 kB: their lines in the index."""
    frame, recovery = scene
    empty = replace(recovery, bodies=())  # fits and meshes leave garbage that is collected now and then
    monkeypatch.setattr(result_bag, "CHUNK_BYTES", 2**17)

    def held(frames):
        tracemalloc.start()
        with ResultBag(tmp_path / "results.mcap") as bag:
            for _ in range(frames):
                bag.add(frame, empty, None)
            gc.collect()
            found = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
        return found

    held(20)
    assert held(240) - held(40) < 200 * 500


def test_the_file_holds_what_the_node_publishes(tmp_path, scene):
    """The same recovery through the node's code and its message classes: byte for byte, but for gaps between fields."""
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    from builtin_interfaces.msg import Time
    from rclpy.serialization import serialize_message
    from std_msgs.msg import Header

    from sq_msgs_py import superquadrics
    from sq_perception.imaging.calibration import Calibration
    from sq_perception.nodes.frame import Frame
    from sq_perception.nodes.parameters import RecoverParameters
    from sq_perception.recordings import publication
    from sq_perception.recovery.recoverer import render_recovery

    frame, recovery = scene
    calibration = Calibration(frame.camera)
    live = Frame(Header(stamp=Time(sec=3, nanosec=4), frame_id="optical"), "32FC1", frame.depth, calibration)
    ids, defaults = tuple(one.label for one in recovery.bodies), RecoverParameters()
    shown = publication.findings(publication.Identified(recovery, ids), live.header, is_cube=False)
    expected = {
        SUPERQUADRICS: superquadrics.to_message(shown.array, live.header),
        MARKERS: shown.markers(defaults.marker_alpha),
        RENDERED: live.encode(render_recovery(recovery, frame.camera)[0]),
        "/a/image": live.encode(frame.depth),
    }
    out = tmp_path / "results.mcap"
    with ResultBag(out, ["depth", "rendered"]) as bag:
        bag.add(replace(frame, topic="/a/image", frame_id="optical", stamp=Stamp(3, 4), received=5), recovery, None)
    with out.open("rb") as file:
        written = {channel.topic: message.data for _, channel, message in make_reader(file).iter_messages()}
    for topic, message in expected.items():
        name = f"{type(message).__module__.split('.')[0]}/msg/{type(message).__name__}"
        assert written[topic] == TYPES.serialize_cdr(TYPES.deserialize_cdr(serialize_message(message), name), name)
