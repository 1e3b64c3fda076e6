"""ONNX: the same bodies through another runtime, alone with its file, and one plain sentence where it is missing."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sq_perception.commands import main, render
from sq_perception.geometry import rotation
from sq_perception.learning import checkpoint, onnx_export
from sq_perception.learning.dataset import draw_views
from sq_perception.learning.regressor import Regressor, RegressorConfig

COMPACT = RegressorConfig(pixels=32, widths=(4, 8, 8), blocks=2, hidden=32)
THESIS = replace(RegressorConfig.thesis(), pixels=64)
REASON = "onnx or onnxruntime is missing"


@pytest.fixture
def runtime(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("ORT_DISABLE_TELEMETRY", "1")  # since release 1.29 it calls its maker
    pytest.importorskip("onnx", reason=REASON)
    return pytest.importorskip("onnxruntime", reason=REASON)


def lively(config: RegressorConfig) -> Regressor:
    """A network with measured normalisations and heads so loud that every parameter reaches most of its range."""
    torch.manual_seed(4)
    model = Regressor(config)
    views = torch.rand(64, 1, config.pixels, config.pixels)
    with torch.no_grad():
        for _ in range(3):
            model.train()(views)
        for head in (model.size_head, model.shape_head, model.translation_head, model.rotation_head):
            head.weight.normal_(0, 1)
        h = model.eval().mixer(model.features(views))
        model.mixer[-2].weight.div_(h.std(0).mean())
        model.mixer[-2].bias.sub_(h.mean(0)).div_(h.std(0).mean())
    return model


def session(runtime: Any, path: Path) -> Any:
    return runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


@pytest.mark.parametrize("config", [COMPACT, THESIS], ids=["compact", "resnet18"])
def test_the_same_parameters_as_torch(config: RegressorConfig, runtime: Any) -> None:
    model = lively(config)
    views = np.random.default_rng(1).random((60, config.pixels, config.pixels)).astype(np.float32)
    expected = model.predict(views)
    assert set(np.abs(expected.rotation).argmax(axis=1)) == {0, 1, 2, 3}, "every branch of the quaternion"
    net = runtime.InferenceSession(onnx_export.build(model).SerializeToString(), providers=["CPUExecutionProvider"])
    (found,) = net.run(None, {"views": views[:, None]})
    np.testing.assert_allclose(found, expected.to_flat(), atol=2e-4)
    assert expected.size.std() > 0.01


def test_quaternions_are_those_of_the_six(runtime: Any, rng: np.random.Generator) -> None:
    """The decoding alone, on heads' outputs as they come, among them turns by exactly half a turn."""
    import onnx

    raw = rng.standard_normal((200, 14)).astype(np.float32)
    raw[:3, 8:] = [[1, 0, 0, 0, -1, 0], [-1, 0, 0, 0, 1, 0], [-1, 0, 0, 0, -1, 0]]
    raw[3, 8:] = [1, 0, 0, 0, 1, 0]
    graph = onnx_export._Graph(onnx)
    onnx_export._decode(graph, "raw", COMPACT)
    value = onnx.helper.make_tensor_value_info
    inputs, outputs = [value("raw", 1, ["n", 14])], [value(onnx_export.OUTPUT, 1, ["n", 12])]
    proto = onnx.helper.make_model(
        onnx.helper.make_graph(graph.nodes, "decode", inputs, outputs, graph.initializers),
        opset_imports=[onnx.helper.make_opsetid("", onnx_export.OPSET)],
        ir_version=onnx_export.IR_VERSION,
    )
    run = runtime.InferenceSession(proto.SerializeToString(), providers=["CPUExecutionProvider"]).run
    found = run(None, {"raw": raw})[0]
    expected = COMPACT.decode(raw.astype(float))
    np.testing.assert_allclose(found[:, :8], expected.to_flat()[:, :8], rtol=1e-5, atol=1e-6)
    assert rotation.geodesic_angle(found[:, 8:].astype(float), expected.rotation).max() < 2e-3
    np.testing.assert_allclose(np.abs(found[:4, 8:]), np.eye(4), atol=1e-6)


def test_the_shipped_network_as_a_file(runtime: Any, tmp_path: Path) -> None:
    """Through the command, any number of views at once, and all that a reader of the file must know inside it."""
    path = tmp_path / "net.onnx"
    assert main.main(["export", "--output", str(path)]) == 0
    net = session(runtime, path)
    views, _ = draw_views(5, np.random.default_rng(3))
    expected = checkpoint.load().predict(views).to_flat()
    for count in (1, 2, 5):
        (found,) = net.run(None, {"views": views[:count, None]})
        np.testing.assert_allclose(found, expected[:count], atol=1e-5)
    (given,), (got,) = net.get_inputs(), net.get_outputs()
    assert (given.name, given.shape[1:], given.type) == ("views", [1, 64, 64], "tensor(float)")
    assert (got.name, got.shape[1:]) == ("parameters", [12])
    facts = net.get_modelmeta().custom_metadata_map
    header = checkpoint.read_header(checkpoint.resolve())
    assert facts["format"] == checkpoint.FORMAT
    assert facts["parameters"].split() == list(render.PARAMETERS)
    assert json.loads(facts["config"])["pixels"] == 64
    assert json.loads(facts["config"])["backbone"] == "compact"
    assert facts["metrics"] == header["metrics"]


def test_another_model_is_exported_too(runtime: Any, tmp_path: Path) -> None:
    model = lively(THESIS)
    checkpoint.save(tmp_path / "m.safetensors", model, dtype=np.float32)
    assert main.main(["export", "--model", str(tmp_path / "m.safetensors"), "-o", str(tmp_path / "m.onnx")]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.onnx", "m.safetensors"]
    views = np.random.default_rng(2).random((2, 64, 64)).astype(np.float32)
    (found,) = session(runtime, tmp_path / "m.onnx").run(None, {"views": views[:, None]})
    np.testing.assert_allclose(found, model.predict(views).to_flat(), atol=2e-4)


class TestMissing:
    def test_one_sentence_where_onnx_is_not_installed(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(sys.modules, "onnx", None)
        assert main.main(["export", "-o", str(tmp_path / "net.onnx")]) == 1
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "pip install 'sq_perception[export]'" in said
        assert not list(tmp_path.iterdir())

    def test_a_missing_model_and_a_missing_folder(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        command = ["export", "--model", str(tmp_path / "none.safetensors"), "-o", str(tmp_path / "net.onnx")]
        assert main.main(command) == 1
        assert "no such model file" in capsys.readouterr().err
        assert main.main(["export", "-o", str(tmp_path / "no" / "net.onnx")]) == main.USAGE

    def test_nothing_of_it_is_imported_before_it_is_needed(self) -> None:
        code = (
            "import sys, sq_perception.learning.onnx_export; "
            "assert not {'onnx', 'onnxruntime'} & set(sys.modules), 'imported too early'"
        )
        subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
