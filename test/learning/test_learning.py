"""Learning: losses that compare bodies, data that is what it says, a network that learns, files that are safe."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from sq_perception.geometry import Superquadric
from sq_perception.learning import checkpoint
from sq_perception.learning.choices import UNSUPERVISED
from sq_perception.learning.dataset import ViewPool, ViewSource, any_occluder, draw_views
from sq_perception.learning.losses import Objective
from sq_perception.learning.networks import Regressor, RegressorConfig
from sq_perception.learning.train import recalibrate, train, validate
from sq_perception.learning.training_config import TrainingConfig
from sq_perception.simulation import view_rendering

SMALL = RegressorConfig(pixels=32, widths=(4, 8, 8), blocks=1, hidden=32)


class TestData:
    def test_pool_pairs_views_with_their_bodies(self) -> None:
        pool = ViewPool(np.random.default_rng(5), ViewSource(32), capacity=32)
        images, bodies = pool.batch(16)
        again, _ = view_rendering.render_views(bodies, 32)
        assert np.abs(again - images).mean() < 0.01


class TestNetwork:
    def test_outputs_are_bodies_within_bounds(self) -> None:
        torch.manual_seed(0)
        bodies = Regressor(SMALL).predict(np.random.default_rng(6).random((5, 32, 32)))
        assert bodies.batch_shape == (5,)
        assert (bodies.size >= 0.039).all()
        assert (bodies.shape >= 0.1).all()
        assert (bodies.shape <= 1).all()
        np.testing.assert_allclose(np.linalg.norm(bodies.rotation, axis=1), 1)

    @pytest.mark.parametrize("views", [np.zeros((32, 32)), np.zeros((1, 31, 32)), np.full((1, 32, 32), np.nan)])
    def test_refuses_other_views(self, views: np.ndarray) -> None:
        with pytest.raises(ValueError, match="expected"):
            Regressor(SMALL).predict(views)

    @pytest.mark.parametrize(
        ("name", "source", "hidden", "least", "over_85"),
        [
            ("supervised", ViewSource(), 0.0, 0.935, 0.96),
            ("robust", ViewSource(), 0.0, 0.915, 0.93),
            ("robust", ViewSource(pinhole_share=1.0), 0.0, 0.905, 0.92),
            ("robust", ViewSource(), 0.3, 0.85, 0.6),
        ],
    )
    def test_shipped_models_read_unseen_bodies(
        self, name: str, source: ViewSource, hidden: float, least: float, over_85: float
    ) -> None:
        """Networks alone, on bodies of seeds that no training uses."""
        rng = np.random.default_rng(123456)
        views, truth = draw_views(300, rng, source, any_occluder(np.full(300, hidden), rng) if hidden else None)
        iou = validate(checkpoint.load(name), views, truth)
        assert iou.mean() > least
        assert (iou > 0.85).mean() > over_85

    def test_names_of_shipped_weights_stand_for_their_files(self, tmp_path: Path) -> None:
        assert set(checkpoint.shipped_weights()) == {"masks", "robust", "supervised", "things"}
        assert checkpoint.resolve() == checkpoint.shipped_weights()[checkpoint.DEFAULT]
        assert checkpoint.resolve("supervised").is_file()
        assert checkpoint.resolve(tmp_path / "supervised.safetensors") == tmp_path / "supervised.safetensors"
        with pytest.raises(checkpoint.CheckpointError, match="no such model file"):
            checkpoint.load("unheard-of")

    def test_shipped_weights_say_where_they_come_from(self) -> None:
        for path in (checkpoint.resolve(name) for name in ("robust", "supervised")):
            header = checkpoint.read_header(path)
            made, training = json.loads(header["made"]), json.loads(header["training"])
            assert made["hours"] > 0
            assert made["commit"]
            assert training["seed"]
            assert json.loads(header["metrics"])["iou"] > 0.9
            assert path.stat().st_size < 8_000_000


class TestTraining:
    CONFIG = TrainingConfig(steps=40, batch=16, points=64, validation=20, warm_up=5, threads=1)

    def test_learns(self, tmp_path: Path) -> None:
        views, truth = draw_views(60, np.random.default_rng(7), ViewSource(32))
        before = validate(Regressor(SMALL), views, truth).mean()
        model = train(self.CONFIG, tmp_path / "whole", SMALL)
        assert validate(model, views, truth).mean() > before + 0.05
        records = [json.loads(line) for line in (tmp_path / "whole" / "log.jsonl").read_text().splitlines()]
        assert [r["step"] for r in records] == [20, 40]

    @pytest.mark.parametrize("loss", ["dual", "render"])
    def test_labels_go_to_the_losses_that_need_them_and_to_no_other(
        self, loss: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        given = []
        compute = Objective.loss

        def watched(self: Objective, prediction: Superquadric, views: torch.Tensor, truth: Any, *rest: Any) -> Any:
            given.append(truth is not None)
            return compute(self, prediction, views, truth, *rest)

        monkeypatch.setattr(Objective, "loss", watched)
        config = TrainingConfig(**{**vars(self.CONFIG), "loss": loss, "steps": 2})
        train(config, tmp_path, SMALL)
        assert given == [loss not in UNSUPERVISED] * 2
        header = checkpoint.read_header(tmp_path / "model.safetensors")
        assert json.loads(header["training"])["loss"] == loss

    def test_a_few_views_are_learned_without_labels(self) -> None:
        """Overfit: 8 views, no labels, and the network's bodies become those of the views."""
        torch.manual_seed(3)
        views, truth = draw_views(8, np.random.default_rng(9), ViewSource(32))
        batch = torch.from_numpy(views)[:, None]
        model, generator = Regressor(SMALL), torch.Generator().manual_seed(0)
        objective = Objective("least_squares_free")
        before = validate(model, views, truth).mean()
        optimizer = torch.optim.AdamW(model.parameters(), 3e-3)
        for step in range(100):
            model.train()
            optimizer.zero_grad()
            objective.loss(model(batch), batch, None, step / 100, generator).mean().backward()
            optimizer.step()
        recalibrate(model, batch, 8)
        assert validate(model, views, truth).mean() > max(before + 0.2, 0.7)


class TestCheckpoint:
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
        checkpoint.save(path, Regressor(SMALL))
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
