"""JSON lines: whole lines only, resumed where they end, and nothing of anybody else's is touched."""

import csv
import io
import json

import pytest

from sq_perception import __version__
from sq_perception.recordings.frame_file import Stamp
from sq_perception.recordings.result_json import Recovered, ResultLines, ResumeError, table

OPTIONS = {"method": "auto", "model": None}


def entry(k):
    return {"file": f"{k}.npz", "superquadrics": [], "topic": None, "stamp": None}


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "out.jsonl"
    lines = ResultLines(path, OPTIONS)
    for k in range(2):
        lines.add(entry(k))
        assert len(path.read_text().splitlines()) == k + 2, "there at once"
    lines.close()
    return path


def test_a_head_and_a_line_a_frame(path):
    head, *frames = map(json.loads, path.read_text().splitlines())
    about = {"program": f"sq_perception {__version__}", "units": {"optical": "m", "cube": "1"}, "options": OPTIONS}
    assert head == {"format": "sq_perception.recovery", "version": 1, **about}
    assert frames == [entry(0), entry(1)]


@pytest.mark.parametrize(("end", "done"), [(-1, 1), (-5, 1), (-30, 1), (10, 0)])
def test_a_line_or_head_that_was_cut_short_is_written_again(path, end, done):
    whole = path.read_bytes()
    path.write_bytes(whole[:end])
    lines = ResultLines(path, OPTIONS)
    assert lines.done == [entry(0)][:done]
    for k in range(done, 2):
        lines.add(entry(k))
    lines.close()
    assert path.read_bytes() == whole


@pytest.mark.parametrize(
    "content", ["important notes\n", "important notes", '{"format": "another"}\n', "[1]\n", "[" * 100_000 + "\n", "\n"],
    ids=["text", "no line", "JSON", "list", "deep", "blank"],
)
def test_what_is_not_ours_is_refused_and_stays(tmp_path, content):
    path = tmp_path / "notes.txt"
    path.write_text(content)
    with pytest.raises(ResumeError):
        ResultLines(path, OPTIONS)
    assert path.read_text() == content


def test_other_options_are_refused_by_name_unless_there_is_no_frame_yet(path):
    """As of a run whose model turned out to be damaged; a document in one line is no such file."""
    before, other = path.read_bytes(), {**OPTIONS, "method": "network"}
    with pytest.raises(ResumeError, match="method was auto, is network"):
        ResultLines(path, other)
    assert path.read_bytes() == before
    head = path.read_text().splitlines()[0]
    path.write_text(head + "\n")
    ResultLines(path, other).close()
    assert json.loads(path.read_text())["options"] == other
    document = json.dumps({**json.loads(head), "frames": [entry(0)]}) + "\n"
    path.write_text(document)
    with pytest.raises(ResumeError):
        ResultLines(path, other)
    assert path.read_text() == document


def test_a_damaged_line_is_named(path):
    lines = path.read_text().splitlines(keepends=True)
    path.write_text(lines[0] + "damaged\n" + lines[2])
    with pytest.raises(ResumeError, match="line 2"):
        ResultLines(path, OPTIONS)
    path.write_text(lines[0] + '{"file": 3}\n')
    with pytest.raises(ResumeError, match="line 2"):
        ResultLines(path, OPTIONS)


def test_two_programs_do_not_share_a_file(path):
    lines = ResultLines(path, OPTIONS)
    with pytest.raises(OSError, match="another program is writing it"):
        ResultLines(path, OPTIONS)
    lines.close()


def test_what_a_full_disk_cut_short_is_written_again(path, file_size_limit):
    lines, before = ResultLines(path, OPTIONS), path.read_bytes()
    with file_size_limit(len(before) + 20):
        with pytest.raises(OSError, match=f"too large: '{path}'"):
            lines.add(entry(2))
        lines.close()
    lines = ResultLines(path, OPTIONS)
    assert path.read_bytes() == before
    lines.add(entry(2))
    lines.close()
    assert json.loads(path.read_text().splitlines()[-1]) == entry(2)


def test_a_row_a_body_with_the_numbers_of_the_document():
    body = {
        "size": [0.1, 0.2, 0.3], "sigma_size": [0.01, None, 0.03], "shape": [0.5, 1.0], "translation": [1.0, 2.0, 3.0],
        "rotation": [0.0, 0.0, 0.0, 1.0], "seen": [1.0, 0.5, None], "score": 0.9, "residual": 0.001, "pixels": 99,
        "objectness": 0.75, "taper": [0.0, 0.0],
        "label": None, "message": "converged; a, b", "status": "converged", "track": {"id": 7},
    }  # fmt: skip
    stamp = {"sec": 3, "nanosec": 40}
    frame = {
        "file": "a.npz",
        "stamp": stamp,
        "coordinates": "optical",
        "superquadrics": [{**body, "parts": [{**body, "size": [0.05, 0.2, 0.3]}]}, {**body, "track": None}],
    }
    first, part, second = csv.DictReader(io.StringIO(table([frame, {**frame, "superquadrics": []}])))
    assert (first["stamp"], first["body"], first["id"], first["a2"]) == ("3.000000040", "0", "7", "0.2")
    assert (first["sigma_a2"], first["seen_a3"], first["qw"], first["message"]) == ("", "", "1.0", "converged; a, b")
    assert (second["body"], second["id"], second["e2"], second["label"]) == ("1", "", "1.0", "")
    assert [row["part"] for row in (first, part, second)] == ["0", "1", "0"]
    assert (part["body"], part["id"], part["a1"]) == ("0", "7", "0.05")


def test_equal_frames_count_one_by_one():
    done = Recovered()
    done.add([entry(0), entry(0), {"file": "bag", "topic": "/depth", "stamp": {"sec": 1, "nanosec": 2}}])
    assert [done("0.npz", "", None) for _ in range(3)] == [True, True, False]
    assert [done("bag", "/depth", Stamp(1, 2)), done("bag", "/depth", Stamp(1, 2))] == [True, False]
    assert not done("1.npz", "", None)
