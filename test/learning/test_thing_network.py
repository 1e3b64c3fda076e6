"""The network of things: its likelihood in closed form, mirrors, what it begins with, and a short training."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file
from scipy.stats import multivariate_t

from sq_perception.commands import main
from sq_perception.geometry.rotation import random
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.union import DIRECTIONS, mirrored
from sq_perception.imaging.canonical_view import NEAREST
from sq_perception.learning import checkpoint, networks, shard_training
from sq_perception.learning.inference import ThingPredictor
from sq_perception.learning.network_config import mirror_planes
from sq_perception.learning.networks import HullPrediction, MaskNetwork, ThingConfig, ThingNetwork
from sq_perception.learning.training import TrainingState
from sq_perception.learning.training_config import THING_RUN
from sq_perception.simulation import thing_views
from sq_perception.simulation.thing_views import ThingViews, draw_thing_views

SMALL = ThingConfig(widths=(8, 16, 16, 16), blocks=1, hidden=16, factors=2)
J = len(DIRECTIONS)


def shards(folder: Path, count: int, rng: np.random.Generator) -> None:
    """Shards of 24 random views whose numbers have the right form."""
    folder.mkdir()
    for k in range(count):
        arrays = {"planes": rng.standard_normal((24, 4)), "extents": rng.uniform(0.05, 0.4, 24)}
        arrays = {name: one.astype(np.float32) for name, one in (arrays | {"support": rng.random((24, J))}).items()}
        arrays |= {"images": rng.random((24, 64, 64)).astype(np.float16), "kinds": rng.integers(3, size=24)}
        save_file(arrays, str(folder / f"{k:05d}.safetensors"))


def test_directions_are_42_and_closed_under_mirrors_and_planes_mirror_with_their_points(rng) -> None:
    assert DIRECTIONS.shape == (42, 3)
    assert np.linalg.norm(DIRECTIONS, axis=1) == pytest.approx(np.ones(42))
    for axis in range(3):
        turned = DIRECTIONS * np.where(np.arange(3) == axis, -1, 1)
        assert DIRECTIONS[mirrored(axis)] == pytest.approx(turned)
    # No two of them are nearer than the edge of a twice divided icosahedron allows.
    assert np.max(DIRECTIONS @ DIRECTIONS.T - 2 * np.eye(42)) == pytest.approx(0.8506508, abs=1e-6)
    plane, points = rng.standard_normal(4), rng.random((10, 3))
    there = mirror_planes(plane[None])[0]
    moved = points * [-1, 1, 1] + [1, 0, 0]
    assert moved @ there[:3] + there[3] == pytest.approx(points @ plane[:3] + plane[3])


def test_the_likelihood_is_that_of_a_multivariate_t(rng: np.random.Generator) -> None:
    mu, log_sigma = rng.normal(size=J), rng.uniform(-3, -1, J)
    factors, truth = 0.1 * rng.normal(size=(J, 3)), rng.normal(size=(5, J))
    said = HullPrediction(
        Superquadric.from_flat(torch.ones(5, 12)), torch.tensor(np.tile(mu, (5, 1))),
        torch.tensor(np.tile(log_sigma, (5, 1))), torch.tensor(np.tile(factors, (5, 1, 1))), freedom=4.0,
    )
    shape = np.diag(np.exp(2 * log_sigma)) + factors @ factors.T
    distribution = multivariate_t(mu, shape, df=4.0)
    expected = -distribution.logpdf(truth)
    found = said.negative_log_likelihood(torch.tensor(truth)).numpy()
    assert said.covariance()[0].numpy() == pytest.approx(shape)
    drawn = distribution.rvs(200_000, random_state=1)
    assert said.deviation()[0].numpy() == pytest.approx(drawn.std(axis=0), rel=0.05)
    # A constant is left out.
    assert found - found[0] == pytest.approx(expected - expected[0], rel=1e-6, abs=1e-6)


def test_the_support_of_a_body_touches_its_farthest_points(rng: np.random.Generator) -> None:
    body = Superquadric(
        rng.uniform(0.1, 0.4, (3, 3)), rng.uniform(0.1, 1.0, (3, 2)), rng.uniform(0.3, 0.7, (3, 3)), random(3, rng)
    )
    reach = networks.support_of(Superquadric.from_flat(torch.tensor(body.to_flat())))
    for k in range(3):
        points = body[k].sample_surface(4000, rng) - np.array([0.5, 0.5, NEAREST])
        sampled = (points @ DIRECTIONS.T).max(axis=0)
        assert (sampled <= reach[k].numpy() + 1e-9).all()
        assert sampled == pytest.approx(reach[k].numpy(), abs=0.02)


def test_a_predictor_answers_a_mirrored_view_with_the_mirrored_hull(rng: np.random.Generator) -> None:
    torch.manual_seed(3)
    predictor = ThingPredictor(ThingNetwork(SMALL))
    views, planes = rng.random((2, 64, 64)).astype(np.float32), rng.standard_normal((2, 4))
    extents = np.array([0.1, 0.0])
    straight = predictor.predict(views, planes, extents)
    turned = predictor.predict(np.ascontiguousarray(views[:, :, ::-1]), mirror_planes(planes), extents)
    back = mirrored(0)
    assert turned.support[:, back] == pytest.approx(straight.support, abs=1e-5)
    assert turned.covariance[:, back][:, :, back] == pytest.approx(straight.covariance, abs=1e-5)
    assert (np.linalg.eigvalsh(straight.covariance) > 0).all()


def test_it_begins_with_all_weights_of_another_of_its_kind(tmp_path: Path) -> None:
    path, given = tmp_path / "things.safetensors", ThingNetwork(replace(SMALL, spread=0.4))
    checkpoint.save(path, given)
    network = shard_training.THINGS.network(str(path))
    assert network.config == SMALL
    for name, weights in given.state_dict().items():
        # Files keep 11 bits.
        assert torch.allclose(weights.float(), network.state_dict()[name].float(), rtol=1e-3, atol=1e-4), name


def test_it_begins_with_no_network_of_another_kind_and_no_other_goes_on_with_its_state(tmp_path, rng, capsys) -> None:
    shards(tmp_path / "views", 3, rng)
    run = ["train-things", str(tmp_path / "views"), "--output", str(tmp_path / "run"), "--batch", "2"]
    for start, kind in (("masks", "masks"), ("robust", "regressor")):
        assert main.main([*run, "--start", start]) == main.FAILURE
        said = f"expected a header 'format: sq_perception.things', got 'sq_perception.{kind}'"
        assert said in capsys.readouterr().err
    TrainingState(tmp_path / "run" / "state.safetensors", MaskNetwork(), torch.optim.AdamW([torch.zeros(1)])).save()
    assert main.main(run) == main.FAILURE
    said = capsys.readouterr().err
    assert "not the state of such a run" in said
    assert len(said) < 500


def test_weights_of_another_kind_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "things.safetensors"
    checkpoint.save(path, ThingNetwork(SMALL))
    assert checkpoint.load_things(path).config == SMALL
    assert checkpoint.predicts_hulls(path)
    assert not checkpoint.predicts_hulls("robust")
    checkpoint.check(path)
    assert set(checkpoint.shipped_regressors()) == {"robust", "supervised"}
    with pytest.raises(checkpoint.CheckpointError, match="expected a header"):
        checkpoint.load(path)
    with pytest.raises(checkpoint.CheckpointError, match="expected a header"):
        checkpoint.load_things("robust")
    with pytest.raises(checkpoint.CheckpointError, match=r"sq_perception\.masks"):
        checkpoint.load_masks("robust")


def test_a_run_that_was_stopped_goes_on(tmp_path: Path, rng: np.random.Generator) -> None:
    """Its spread comes from views that were not trained on; one that is over and asked for again does nothing."""
    shards(tmp_path / "views", 3, rng)
    asked: list[ThingViews] = []

    def finish(network: ThingNetwork, views: ThingViews) -> None:
        asked.append(views)
        shard_training.THINGS.finish(network, views)

    kind = replace(shard_training.THINGS, network=lambda _: ThingNetwork(SMALL), finish=finish)
    config = replace(THING_RUN, minutes=0.02, batch=8, held=1, validation=1, threads=1)

    def run(minutes: float) -> list[dict[str, Any]]:
        shard_training.train(kind, replace(config, minutes=minutes), tmp_path / "views", tmp_path / "run")
        return [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]

    first = run(0.02)
    log = run(first[-1]["seconds"] / 60 + 0.02)  # a busy machine may have taken longer than it was given
    assert [row["step"] for row in log] == sorted(row["step"] for row in log)
    assert log[len(first)]["step"] > first[-1]["step"]
    assert log[-1]["seconds"] > first[-1]["seconds"]
    kept = checkpoint.load_things(tmp_path / "run" / "things.safetensors").config
    assert kept.spread != 1.0
    assert replace(kept, spread=1.0) == SMALL
    assert run(0.02)[-1]["step"] == log[-1]["step"]
    assert checkpoint.load_things(tmp_path / "run" / "things.safetensors").config == kept
    held = shard_training.read_views(shard_training.THINGS.none, [tmp_path / "views" / "00000.safetensors"])
    assert [np.array_equal(views.support, held.support) for views in asked] == [True] * 3


def test_the_spread_is_that_of_the_errors(rng: np.random.Generator) -> None:
    """True hulls drawn from a quarter of the covariance that a network says: it is found, and then nothing is left."""
    torch.manual_seed(5)
    network = ThingNetwork(SMALL).eval()
    count = 1500
    images, planes = rng.random((count, 64, 64)).astype(np.float32), np.zeros((count, 4), np.float32)
    extents = np.full(count, 0.2, np.float32)
    with torch.inference_mode():
        said = network(*map(torch.from_numpy, (images, planes, extents)))
    root = np.linalg.cholesky(0.25 * said.covariance().numpy().astype(float))
    normal = np.einsum("bij,bj->bi", root, rng.standard_normal((count, J)))
    tails = np.sqrt(SMALL.freedom / rng.chisquare(SMALL.freedom, count))
    truth = (said.support.numpy() + tails[:, None] * normal).astype(np.float32)
    views = ThingViews(images, planes, extents, truth, np.zeros(count, np.int64))
    shard_training.calibrate_spread(network, views)
    spread = network.config.spread
    assert spread == pytest.approx(0.25, rel=0.15)
    shard_training.calibrate_spread(network, views)
    assert network.config.spread == pytest.approx(spread, rel=0.01)


@pytest.mark.parametrize(("processed", "least", "most"), [(0.0, 0.8, 1.25), (1.0, 0.9, 1.5)])
def test_the_shipped_network_says_how_well_it_knows(processed, least, most, monkeypatch) -> None:
    """On views that no training saw: the error of the support function, and its deviation in units of the said one."""
    monkeypatch.setattr(thing_views, "PROCESSED", processed)
    held = draw_thing_views(240, np.random.default_rng([77, 1]))
    found = shard_training.validate_things(checkpoint.load_things(), held)
    assert found["error"] < 0.09
    assert least < found["ratio"] < most
