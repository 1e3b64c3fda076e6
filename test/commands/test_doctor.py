"""sq-perception doctor: what it says is what is there."""

from __future__ import annotations

import os

from sq_perception import __version__
from sq_perception.commands import doctor, main


def test_the_doctor_names_versions_cores_weights_and_kernels(capsys):
    assert main.main(["doctor"]) == 0
    said = dict(line.split(None, 1) for line in capsys.readouterr().out.splitlines())
    assert __version__ in said["program"]
    assert said["cores"].startswith(f"{len(os.sched_getaffinity(0))} of ")
    assert {"numpy", "torch", "[bags]", "[view]", "[train]", "[ros]", "kernels"} <= said.keys()
    assert "robust" in said["weights"]


def test_what_is_missing_comes_with_its_remedy(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "_EXTRAS", {"bags": ("no_such_module",)})
    monkeypatch.setattr(doctor, "_requirements", lambda: ["no-such-package>=3"])
    assert main.main(["doctor"]) == 1
    said = capsys.readouterr().out
    assert "missing no_such_module: pip install 'sq_perception[bags]'" in said
    assert "missing: pip install 'no-such-package>=3'" in said
