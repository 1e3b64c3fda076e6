"""The files of sq-perception recover: whole when it is interrupted, resumed, and never in the place of an input."""

import json

import cv2
import numpy as np
import pytest
from recover_runs import camera_yaml, recover, run, save_npz, save_png

from sq_perception.commands import main, recover_outputs
from sq_perception.geometry import mesh
from sq_perception.learning import checkpoint
from sq_perception.recordings import html_page
from sq_perception.recordings import result_json as module
from sq_perception.recovery.recoverer import Recoverer


@pytest.mark.parametrize(
    ("how", "code", "words"),
    [(KeyboardInterrupt(), 130, "interrupted"), (OSError(28, "No space left on device"), 1, "No space left")],
    ids=["Ctrl-C", "full disk"],
)
def test_an_interruption_leaves_whole_files(tmp_path, monkeypatch, capsys, how, code, words):
    """While the second frame's mesh is being written: the first frame's files are there, and nothing half."""
    names = [save_npz(tmp_path / f"{name}.npz") for name in ("a", "b", "c")]
    export = mesh.export

    def interrupted(bodies, path, **options):
        export(bodies, path, **options)
        if path.name.startswith("b."):
            raise how

    monkeypatch.setattr(mesh, "export", interrupted)
    frames = recover(tmp_path, *names, "--meshes", tmp_path / "meshes", code=code)
    assert [frame["file"] for frame in frames] == [str(name) for name in names[:2]]
    assert [path.name for path in (tmp_path / "meshes").iterdir()] == ["a.glb"]
    assert not [path for path in tmp_path.iterdir() if "partial" in path.name]
    errors = capsys.readouterr().err
    assert words in errors
    assert "2 frames, 4 objects (0 failed), median" in errors


def interrupt_after(frames, monkeypatch):
    """Ctrl-C while the frame after so many is worked on."""
    entry, calls = module.frame_entry, []

    def interrupted(*arguments, **options):
        if len(calls) == frames:
            raise KeyboardInterrupt
        calls.append(0)
        return entry(*arguments, **options)

    monkeypatch.setattr(module, "frame_entry", interrupted)


def test_a_good_document_outlives_a_run_without_a_frame_and_an_interrupted_one(tmp_path, monkeypatch, capsys):
    out = tmp_path / "keep.json"
    out.write_text("good")
    assert run(tmp_path / "missing.npz", "--json", out) == 1
    assert out.read_text() == "good"
    assert f"{out} stays as it is" in capsys.readouterr().err
    names = [save_npz(tmp_path / f"{name}.npz") for name in ("a", "b")]
    interrupt_after(1, monkeypatch)
    assert run(*names, "--json", out) == 130
    assert out.read_text() == "good"
    assert len(json.loads((tmp_path / "keep.partial.json").read_text())["frames"]) == 1
    assert "keep.partial.json" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--json", "--jsonl"])
def test_links_and_devices_are_written_through(tmp_path, option):
    frame = save_npz(tmp_path / "a.npz")
    for name, target in (("null", "/dev/null"), ("link", "target")):
        (tmp_path / name).symlink_to(target)
        assert run(frame, option, tmp_path / name) == 0
        assert (tmp_path / name).is_symlink()
    first = (tmp_path / "target").read_text()
    assert json.loads(first if option == "--json" else first.splitlines()[0])["format"] == "sq_perception.recovery"


@pytest.mark.parametrize("option", ["--json", "--jsonl", "--mcap", "--pictures", "--meshes"])
def test_what_cannot_be_written_is_known_before_a_frame_is_computed(tmp_path, option, monkeypatch, capsys):
    monkeypatch.setattr(Recoverer, "recover", None)
    assert run(save_npz(tmp_path / "a.npz"), option, "/proc/sys/out.mcap") == 2
    assert option in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--mcap", "--html"])
def test_weights_damaged_beyond_their_header_leave_nothing_behind(tmp_path, option, capsys):
    model, outputs = tmp_path / "damaged.safetensors", tmp_path / "outputs"
    outputs.mkdir()
    model.write_bytes(checkpoint.resolve(None).read_bytes()[:-1000] + 1000 * b"\xff")
    frame, out = save_npz(tmp_path / "a.npz"), outputs / f"out.{option[2:]}"
    assert main.main(["recover", str(frame), "--model", str(model), option, str(out)]) == 1
    assert "not all finite" in capsys.readouterr().err
    assert not list(outputs.iterdir())


def test_a_bag_that_was_begun_is_forgotten_where_the_page_cannot_be(tmp_path, monkeypatch, capsys):
    def full(path):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(html_page, "HtmlPage", full)
    frame, outputs = save_npz(tmp_path / "a.npz"), tmp_path / "outputs"
    outputs.mkdir()
    assert run(frame, "--mcap", outputs / "out.mcap", "--html", outputs / "out.html") == 1
    assert "No space left" in capsys.readouterr().err
    assert not list(outputs.iterdir())


def test_no_output_takes_the_place_of_an_input_or_of_another(tmp_path, capsys):
    """Files that were named, and masks, cameras and the parts of a bag that are read for them."""
    frame, png = save_npz(tmp_path / "a.npz"), save_png(tmp_path / "b.png")
    camera = camera_yaml(tmp_path / "camera.yaml")
    masks, bag = tmp_path / "masks", tmp_path / "bag"
    masks.mkdir(), bag.mkdir()
    cv2.imwrite(str(masks / "b.png"), np.ones((120, 160), np.uint8))
    for name in ("metadata.yaml", "bag.mcap"):
        (bag / name).write_text("recorded")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for arguments in (
        (frame, "--json", frame),
        (frame, "--jsonl", frame),
        (png, "--camera-info", camera, "--json", camera),
        (tmp_path, "--json", camera),
        (tmp_path, "--pictures", tmp_path),
        (png, "--masks", masks, "--pictures", masks),
        (bag, "--mcap", bag / "bag.mcap"),
    ):
        assert run(*arguments) == 2
        assert "input" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in before} == before
    frame, out = save_npz(tmp_path / "a.npz"), tmp_path / "out.json"
    assert main.main(["recover", str(frame), "--json", str(out), "--jsonl", f"{tmp_path}/./out.json"]) == 2
    assert "--json, --jsonl: " in capsys.readouterr().err
    assert not out.exists()
    assert main.main(["recover", str(frame), "--json", "/dev/null", "--csv", "/dev/null"]) == 0


def test_a_folder_is_resumed_where_it_ended(tmp_path, monkeypatch, capsys):
    """Interrupted after two of five frames, then again to the end: every frame once, in order, computed once."""
    folder = tmp_path / "frames"
    for k in range(5):
        save_npz(folder / f"f{k}.npz")
    lines, out, meshes = tmp_path / "out.jsonl", tmp_path / "out.json", tmp_path / "meshes"
    with monkeypatch.context() as context:
        interrupt_after(2, context)
        assert run(folder, "--jsonl", lines, "--meshes", meshes) == 130
    first = lines.read_text()
    assert len(first.splitlines()) == 3
    assert run(folder, "--jsonl", lines, "--meshes", meshes, "--json", out) == 0
    assert lines.read_text().startswith(first), "what is done is not done again"
    frames = [json.loads(line) for line in lines.read_text().splitlines()[1:]]
    assert [frame["file"] for frame in frames] == [str(folder / f"f{k}.npz") for k in range(5)]
    assert json.loads(out.read_text())["frames"] == frames
    assert sorted(path.name for path in meshes.iterdir()) == [f"f{k}.glb" for k in range(5)]
    monkeypatch.setattr(Recoverer, "recover", None)
    assert run(folder, "--jsonl", lines) == 0, "nothing is left to do"
    assert f"0 frames, 0 objects (0 failed), 5 frames in {lines} before" in capsys.readouterr().err
    assert run(folder, "--jsonl", lines, "--max-objects", "3") == 2
    assert run(folder, "--jsonl", lines, "--workspace", *"001112") == 2
    assert run(folder, "--jsonl", lines, "--mcap", tmp_path / "out.mcap") == 2


def test_pictures_of_a_resumed_run_keep_their_names(tmp_path, monkeypatch):
    """Three frames of one name; after the first there are two left, and they do not take its picture's place."""
    monkeypatch.setattr(recover_outputs, "_draw", lambda path, *_: path.write_bytes(b""))
    frames = [save_npz(tmp_path / name / "f.npz") for name in "abc"]
    lines, pictures = tmp_path / "out.jsonl", tmp_path / "pictures"
    with monkeypatch.context() as context:
        interrupt_after(1, context)
        assert run(*frames, "--jsonl", lines, "--pictures", pictures) == 130
    assert [path.name for path in pictures.iterdir()] == ["f.png"]
    first = (pictures / "f.png").stat().st_mtime_ns
    assert run(*frames[:2], "--jsonl", lines, "--pictures", pictures) == 0
    assert run(*frames, "--jsonl", lines, "--pictures", pictures) == 0
    assert sorted(path.name for path in pictures.iterdir()) == ["f.png", "f_2.png", "f_3.png"]
    assert (pictures / "f.png").stat().st_mtime_ns == first
