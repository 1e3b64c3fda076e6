"""The network: two backbones with one face, shipped and ImageNet weights, precision, files that are safe."""

import json
import re
import struct
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch.nn import functional

from sq_perception.learning import checkpoint
from sq_perception.learning.dataset import ViewSource, any_occluder, draw_views
from sq_perception.learning.networks import Regressor, RegressorConfig, ResNet18
from sq_perception.learning.train import validate

COMPACT = RegressorConfig(pixels=32, widths=(4, 8, 8), blocks=1, hidden=32)
THESIS = replace(RegressorConfig.thesis(), pixels=64)
STAGES = {1: (64, 64, 1), 2: (64, 128, 2), 3: (128, 256, 2), 4: (256, 512, 2)}
"""Channels in, channels out, first stride (He et al. 2016, table 1)."""


def torchvision_state(rng: np.random.Generator) -> dict[str, torch.Tensor]:
    """Random weights under the names and in the shapes of torchvision's resnet18, classifier and counters included."""
    state = {}

    def convolution(name: str, out: int, into: int, side: int) -> None:
        spread = np.sqrt(2 / (into * side * side))
        state[f"{name}.weight"] = torch.tensor(spread * rng.standard_normal((out, into, side, side))).float()

    def norm(name: str, channels: int) -> None:
        bounds = {"weight": (0.5, 1), "bias": (-0.1, 0.1), "running_mean": (-1, 1), "running_var": (1, 2)}
        for what, (low, high) in bounds.items():
            state[f"{name}.{what}"] = torch.tensor(rng.uniform(low, high, channels)).float()
        state[f"{name}.num_batches_tracked"] = torch.tensor(7)

    convolution("conv1", 64, 3, 7)
    norm("bn1", 64)
    for stage, (into, out, stride) in STAGES.items():
        for block, channels in enumerate((into, out)):
            name = f"layer{stage}.{block}"
            convolution(f"{name}.conv1", out, channels, 3)
            norm(f"{name}.bn1", out)
            convolution(f"{name}.conv2", out, out, 3)
            norm(f"{name}.bn2", out)
        if stride == 2:
            convolution(f"layer{stage}.0.downsample.0", out, into, 1)
            norm(f"layer{stage}.0.downsample.1", out)
    state["fc.weight"], state["fc.bias"] = torch.zeros(1000, 512), torch.zeros(1000)
    return state


def colour_features(state: dict[str, torch.Tensor], images: torch.Tensor) -> torch.Tensor:
    """Features (n, 512) of colour images (n, 3, p, p): ResNet-18 written down from its weights alone."""

    def norm(name: str, x: torch.Tensor) -> torch.Tensor:
        mean, var = state[f"{name}.running_mean"], state[f"{name}.running_var"]
        return functional.batch_norm(x, mean, var, state[f"{name}.weight"], state[f"{name}.bias"])

    x = functional.relu(norm("bn1", functional.conv2d(images, state["conv1.weight"], stride=2, padding=3)))
    x = functional.max_pool2d(x, 3, stride=2, padding=1)
    for stage, (_, _, first) in STAGES.items():
        for block, stride in enumerate((first, 1)):
            name = f"layer{stage}.{block}"
            y = functional.conv2d(x, state[f"{name}.conv1.weight"], stride=stride, padding=1)
            y = functional.conv2d(functional.relu(norm(f"{name}.bn1", y)), state[f"{name}.conv2.weight"], padding=1)
            if stride == 2:
                x = norm(f"{name}.downsample.1", functional.conv2d(x, state[f"{name}.downsample.0.weight"], stride=2))
            x = functional.relu(x + norm(f"{name}.bn2", y))
    return functional.adaptive_avg_pool2d(x, 1).flatten(1)


class TestConfig:
    def test_the_thesis_network(self) -> None:
        """Chapter 5.2: 11.2 million weights of ResNet-18 less two colours of the stem, then two layers of 256."""
        config = RegressorConfig.thesis()
        assert (config.backbone, config.pixels, config.framing) == ("resnet18", 256, "full")
        for low, high, (least, most) in ((25, 75, config.size_range), (88, 168, config.translation_range)):
            assert least < low / 255
            assert high / 255 < most
        with torch.device("meta"):
            model = Regressor(config)
        count = sum(parameter.numel() for parameter in model.features.parameters())
        assert count == 11_689_512 - 513 * 1000 - 2 * 64 * 49
        shapes = [tuple(layer.weight.shape) for layer in model.mixer if hasattr(layer, "weight")]
        assert shapes == [(256, 512), (256, 256)]

    @pytest.mark.parametrize(
        ("field", "value"),
        [
            *(("backbone", "vgg"), ("framing", "round"), ("pixels", 0), ("pixels", 40), ("size_range", (0.0, 1.0))),
            *(("shape_range", (1.0, 0.1)), ("translation_range", (0.0, float("inf")))),
        ],
    )
    def test_refuses_what_no_network_can_be(self, field: str, value: Any) -> None:
        with pytest.raises(ValueError, match=field):
            replace(RegressorConfig.thesis(), **{field: value})

    @pytest.mark.parametrize("form", [replace(THESIS, pixels=32), replace(THESIS, pixels=96), COMPACT])
    def test_outputs_are_bodies_within_bounds(self, form: RegressorConfig) -> None:
        """Also of ResNet-18 on views of any multiple of 32 pixels."""
        bodies = Regressor(form).predict(np.random.default_rng(0).random((5, form.pixels, form.pixels)))
        assert bodies.batch_shape == (5,)
        assert (0.049 if form.backbone == "resnet18" else 0.039) <= bodies.size.min() <= bodies.size.max() <= 0.401
        assert 0.1 <= bodies.shape.min() <= bodies.shape.max() <= 1
        np.testing.assert_allclose(np.linalg.norm(bodies.rotation, axis=1), 1)


def test_with_weights_of_imagenet_a_grey_view_is_a_colour_image_of_three_equal_colours(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    """Those that the page on training takes over; here random ones in torchvision's form."""
    state, torchvision = torchvision_state(rng), MagicMock()
    torchvision.models.resnet18.return_value.state_dict.return_value = dict(state)
    monkeypatch.setitem(sys.modules, "torchvision", torchvision)
    monkeypatch.chdir(tmp_path)
    (snippet,) = re.findall(
        r"^```python\n(.*?)^```$", (repository / "docs" / "training.md").read_text(encoding="utf-8"), re.M | re.S
    )
    exec(compile(snippet, "training.md", "exec"), {})  # noqa: S102
    model = checkpoint.load("resnet18.safetensors")
    views = torch.tensor(rng.random((3, 1, 64, 64))).float()
    with torch.inference_mode():
        features = model.features(views)
        expected = colour_features(state, views.expand(-1, 3, -1, -1))
        folded = model.for_inference().features(views)
    assert expected.std() > 0.1
    torch.testing.assert_close(features, expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(folded, expected, rtol=1e-3, atol=1e-3)


class TestShippedWeights:
    @pytest.mark.parametrize(
        ("name", "source", "hidden", "least", "over_85"),
        [
            ("supervised", ViewSource(), 0.0, 0.935, 0.96),
            ("robust", ViewSource(), 0.0, 0.915, 0.93),
            ("robust", ViewSource(pinhole_share=1.0), 0.0, 0.905, 0.92),
            ("robust", ViewSource(), 0.3, 0.85, 0.6),
        ],
    )
    def test_they_read_unseen_bodies(self, name, source, hidden, least, over_85) -> None:
        """Networks alone, on bodies of seeds that no training uses."""
        rng = np.random.default_rng(123456)
        views, truth = draw_views(300, rng, source, any_occluder(np.full(300, hidden), rng) if hidden else None)
        iou = validate(checkpoint.load(name), views, truth)
        assert iou.mean() > least
        assert (iou > 0.85).mean() > over_85

    def test_their_names_stand_for_their_files(self, tmp_path: Path) -> None:
        assert set(checkpoint.shipped_weights()) == {"masks", "robust", "supervised", "things"}
        assert checkpoint.resolve() == checkpoint.shipped_weights()[checkpoint.DEFAULT]
        assert checkpoint.resolve("supervised").is_file()
        assert checkpoint.resolve(tmp_path / "supervised.safetensors") == tmp_path / "supervised.safetensors"
        with pytest.raises(checkpoint.CheckpointError, match="no such model file"):
            checkpoint.load("unheard-of")

    def test_they_say_where_they_come_from(self) -> None:
        for name in ("robust", "supervised", "things"):
            header = checkpoint.read_header(name)
            made, training = json.loads(header["made"]), json.loads(header["training"])
            figures = json.loads(header.get("metrics") or header["validation"])
            if name == "things":
                assert "train-things" in made["command"]
                assert min(training["views"], figures["error"]) > 0
            else:
                assert made["hours"] > 0
                assert made["commit"]
                assert training["seed"]
                assert figures["iou"] > 0.9
            assert checkpoint.resolve(name).stat().st_size < 8_000_000


class TestPrecision:
    @pytest.mark.parametrize("config", [COMPACT, THESIS], ids=["compact", "resnet18"])
    def test_folded_copies_predict_the_same(self, config: RegressorConfig) -> None:
        torch.manual_seed(2)
        model = Regressor(config)
        views = torch.rand(16, 1, config.pixels, config.pixels)
        model.train()(views)
        expected = model.eval()(views).to_flat().detach().numpy()
        folded = model.for_inference()
        assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in folded.modules())
        assert any(isinstance(module, torch.nn.BatchNorm2d) for module in model.modules())
        np.testing.assert_allclose(folded.predict(views[:, 0].numpy()).to_flat(), expected, atol=2e-4)
        np.testing.assert_allclose(model.predict(views[:, 0].numpy()).to_flat(), expected, atol=1e-5)


class TestCheckpoint:
    @pytest.mark.parametrize("config", [COMPACT, THESIS], ids=["compact", "resnet18"])
    def test_networks_and_notes_round_trip(self, config: RegressorConfig, tmp_path: Path) -> None:
        torch.manual_seed(1)
        model = Regressor(config)
        checkpoint.save(tmp_path / "m.safetensors", model, {"metrics": {"iou": 0.5}}, np.float32)
        again = checkpoint.load(tmp_path / "m.safetensors")
        header = checkpoint.read_header(tmp_path / "m.safetensors")
        (tmp_path / "m.safetensors").write_bytes(bytes(1000))  # a loaded network does not live in its file
        assert again.config == config
        assert isinstance(again.features, ResNet18) == (config is THESIS)
        assert all(parameter.requires_grad for parameter in again.parameters())
        views = np.random.default_rng(8).random((3, config.pixels, config.pixels))
        np.testing.assert_array_equal(again.predict(views).to_flat(), model.predict(views).to_flat())
        assert json.loads(header["metrics"]) == {"iou": 0.5}

    def test_files_from_before_there_were_backbones(self, tmp_path: Path) -> None:
        path = tmp_path / "m.safetensors"
        checkpoint.save(path, Regressor(COMPACT), dtype=np.float32)
        header, state = checkpoint.read_header(path), load_file(str(path))
        config = json.loads(header["config"])
        for name in ("backbone", "framing"):
            config.pop(name)
        save_file(state, str(path), metadata={**header, "config": json.dumps(config)})
        assert checkpoint.load(path).config == COMPACT
        assert {"features.0.weight", "features.3.first_norm.running_mean", "features.3.shortcut.0.weight"} <= set(state)

    @pytest.mark.parametrize("config", [COMPACT, THESIS], ids=["compact", "resnet18"])
    @pytest.mark.parametrize(
        "change",
        [
            *({"hidden": hidden} for hidden in (60_000, 10**30, -3)),
            *({"pixels": pixels} for pixels in (2**25, "64")),
            *({"widths": widths, "backbone": "compact"} for widths in ([30_000] * 4, [1] * 100_000, [], 4)),
            *({"size_range": wrong} for wrong in ([0.1], ["a", "b"])),
            *({"blocks": 10**9}, {"backbone": "resnet152"}, {"framing": None}, {"unknown": 1}),
        ],
        ids=lambda change: " ".join(change) + " " + str(next(iter(change.values())))[:12],
    )
    def test_hostile_headers_are_refused_before_they_cost_memory(self, config, change, tmp_path) -> None:
        """Any of these networks in full would take gigabytes, or never end."""
        header = {"format": checkpoint.FORMAT, "version": checkpoint.VERSION}
        header["config"] = json.dumps({**asdict(config), **change})
        save_file({"x": torch.zeros(1)}, str(tmp_path / "m.safetensors"), metadata=header)
        with pytest.raises(checkpoint.CheckpointError, match="the header's config describes no network"):
            checkpoint.load(tmp_path / "m.safetensors")

    def test_no_memory_is_taken_that_the_file_does_not_hold(self, tmp_path: Path) -> None:
        """The largest network that the header may describe, in a file of a few bytes."""
        config = RegressorConfig(widths=(8, 8, 8, 8), hidden=14_000)
        header = {"format": checkpoint.FORMAT, "version": checkpoint.VERSION, "config": json.dumps(asdict(config))}
        save_file({"x": torch.zeros(1)}, str(tmp_path / "m.safetensors"), metadata=header)
        allocated: list[torch.device] = []
        linear = torch.nn.Linear.reset_parameters

        def watched(layer: torch.nn.Linear) -> None:
            allocated.append(layer.weight.device)
            linear(layer)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(torch.nn.Linear, "reset_parameters", watched)
            with pytest.raises(checkpoint.CheckpointError, match="the weights do not fit"):
                checkpoint.load(tmp_path / "m.safetensors")
        assert not allocated

    def test_says_what_is_wrong_with_a_file(self, tmp_path: Path) -> None:
        path = tmp_path / "m.safetensors"

        def refused(words: str, *reads: Any) -> None:
            for read in reads or (checkpoint.load,):
                with pytest.raises(checkpoint.CheckpointError, match=words):
                    read(path)

        refused("no such model file")
        with pytest.raises(checkpoint.CheckpointError, match=r"no such model file|cannot be read"):
            checkpoint.check(tmp_path / ("m" * 5000) / "x.safetensors")
        path.write_bytes(b"not a model")
        refused("not a readable safetensors")
        save_file({"x": torch.zeros(1)}, str(path))
        refused("format")
        checkpoint.save(path, Regressor(COMPACT))
        checkpoint.check(path)
        header, state = checkpoint.read_header(path), load_file(str(path))
        state.pop("size_head.bias")
        save_file(state, str(path), metadata=header)
        refused(r"size_head\.bias")
        save_file(state, str(path), metadata={**header, "config": '{"pixels": 100000000, "widths": [9]}'})
        refused("config")
        path.write_bytes(path.read_bytes()[:-100])
        refused("not a readable safetensors", checkpoint.load, checkpoint.check)
        for length in (0, 2**20 + 1, 2**40, 2**64 - 1):  # believed only where the file is as long
            path.write_bytes(struct.pack("<Q", length) + b"{}")
            refused("not a readable safetensors", checkpoint.load, checkpoint.check, checkpoint.read_header)
        with path.open("wb") as file:
            file.truncate(2**34)  # a hole, no bytes
        refused("expected at most")
