"""``sq-perception fit``: files of clouds and meshes in, lines and JSON out; and ``recover``, given what is for it."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from sq_perception.commands.main import main
from sq_perception.geometry.superquadric import Superquadric

BODY = Superquadric([0.03, 0.04, 0.09], [0.2, 1.0], [0.02, -0.03, 0.6], [0.2, 0.1, 0.0, 1.0])


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    """A cloud of a whole object before where a camera might have been."""
    path = tmp_path / "whole.ply"
    trimesh.PointCloud(BODY.sample_surface(4000, np.random.default_rng(0))).export(path)
    return path


def test_a_cloud_becomes_a_line_and_json(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.json"
    assert main(["fit", str(whole), "--json", str(out)]) == 0
    assert "0 converged 80.0 x 60.0 x 180.0" in capsys.readouterr().out
    document = json.loads(out.read_text())
    assert document["format"] == "sq_perception.points"
    (entry,) = document["files"]
    (body,) = entry["superquadrics"]
    assert entry["points"] == 4000
    assert np.allclose(np.sort(body["size"]), np.sort(BODY.size), rtol=0.01)
    assert np.allclose(body["translation"], BODY.translation, atol=1e-3)
    assert np.shape(body["covariance"]) == (11, 11)


def test_meshes_and_arrays_are_read_and_parts_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = trimesh.creation.cylinder(radius=0.03, height=0.1)
    mesh.export(tmp_path / "can.obj")
    np.save(tmp_path / "cloud.npy", BODY.sample_surface(1000, np.random.default_rng(1)))
    assert main(["fit", str(tmp_path / "can.obj"), str(tmp_path / "cloud.npy"), "--most", "3", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)["files"]
    assert [len(entry["superquadrics"]) for entry in found] == [1, 1]


def test_what_cannot_be_read_is_said_and_the_rest_follows(whole, tmp_path, capsys) -> None:
    broken = tmp_path / "broken.ply"
    broken.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 9999999\nend_header\n")
    assert main(["fit", str(broken), str(tmp_path / "none.stl"), str(tmp_path / "some.txt"), str(whole)]) == 1
    shown = capsys.readouterr()
    for name, reason in (("broken.ply", ""), ("none.stl", "No such file"), ("some.txt", ".stl")):
        assert f"{name}: " in shown.err
        assert reason in shown.err
    assert "0 converged" in shown.out


def test_a_plane_fails_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "plane.npy", np.random.default_rng(2).random((500, 3)) * [1.0, 1.0, 0.0])
    assert main(["fit", str(tmp_path / "plane.npy")]) == 0
    assert "failed: all points lie on one plane" in capsys.readouterr().out


def test_recover_sends_the_cloud_of_a_whole_object_here(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["recover", str(whole), "--method", "symmetry"]) == 1
    assert "sq-perception fit takes clouds of whole objects" in capsys.readouterr().err
