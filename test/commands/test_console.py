"""What all commands have in common: what is read stays, what is printed arrives, and every name will do."""

import io
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from sq_perception.commands import main
from sq_perception.commands.console import progress


def recover(*arguments):
    return main.main(["recover", *map(str, arguments), "--method", "symmetry"])


def test_a_file_that_is_called_like_the_standard_output_is_no_output(tmp_path, monkeypatch, capsys):
    """It is read where masks or the files of a bag are."""
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((30, 40), np.uint16))
    (tmp_path / "-").write_text("what somebody has left")
    monkeypatch.chdir(tmp_path)
    assert recover("a.png", "--camera-info", "50,50,19.5,14.5", "--masks", ".", "--json", "-") == 0
    assert "input" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("output", "words"),
    [("/dev/full", "sq-perception: the standard output: No space left on device\n"), ("a closed pipe", "")],
)
def test_what_cannot_be_printed_is_code_one_and_no_exception(output, words):
    """Buffered, as in a user's shell, so that it fails when all is done."""
    into, of = os.pipe()
    os.close(into)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with os.fdopen(of, "wb") if output == "a closed pipe" else open(output, "wb") as sink:
        command = [sys.executable, "-m", "sq_perception", "--version"]
        done = subprocess.run(command, stdout=sink, stderr=subprocess.PIPE, text=True, env=environment, check=False)
    assert (done.returncode, done.stderr) == (1, words)


def test_json_on_a_closed_standard_output_is_wrong_usage(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdout", None)
    assert recover(tmp_path / "a.npz", "--json", "-") == 2
    assert "--json: the standard output is closed" in capsys.readouterr().err


@pytest.mark.parametrize("name", [b"$1$_$2_$.npz", b"caf\xe9.npz"])
def test_a_frame_may_be_called_anything(tmp_path, name, monkeypatch):
    """What Matplotlib takes for a formula, and what is no UTF-8, in pictures, meshes, tables and on the terminal."""
    path = Path(os.fsdecode(os.path.join(os.fsencode(tmp_path), name)))
    depth = np.full((30, 40), 1.0, np.float32)
    depth[8:22, 10:30] = 0.8
    np.savez(path, depth=depth, K=[[50, 0, 19.5], [0, 50, 14.5], [0, 0, 1]], labels=(depth < 0.9).astype(int))
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding="utf-8"))
    outputs = ("--pictures", tmp_path, "--meshes", tmp_path, "--csv", tmp_path / "out.csv")
    assert recover(path, *outputs) == 0
    assert sys.stdout.buffer.getvalue()
    assert {found.suffix for found in tmp_path.iterdir()} == {".npz", ".png", ".glb", ".csv"}
    assert "weak" in (tmp_path / "out.csv").read_text(encoding="utf-8")


@pytest.mark.parametrize("command", ["train-things", "train-masks"])
def test_a_training_that_is_interrupted_says_so_by_its_code(tmp_path, command, monkeypatch, capsys):
    pytest.importorskip("torch", reason="needs the extra 'train'")
    from sq_perception.learning import shard_training
    from sq_perception.learning.training import Stopped

    def interrupted(*_):
        raise Stopped("the same command goes on")

    monkeypatch.setattr(shard_training, "train", interrupted)
    assert main.main([command, str(tmp_path), "--output", str(tmp_path)]) == 130
    assert "the same command goes on" in capsys.readouterr().err


def test_a_bar_that_no_terminal_shows_writes_nothing(capsys):
    """Not even an empty line, as rich before 14.3 ends it with."""
    with progress() as bar:
        bar.add_task("recovering", total=1)
        bar.console.line()
    assert capsys.readouterr().err == ""
