"""Networks without torch answer as the modules of torch do, in several positions, of which a mean is taken."""

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg  # noqa: F401  # its own BLAS, which is looked at below, is there from the start
import torch

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.segment_view import CHANNELS
from sq_perception.learning import checkpoint, inference, layout
from sq_perception.learning.dataset import draw_views
from sq_perception.learning.forward import CompactMasks, CompactRegressor, CompactThings
from sq_perception.learning.inference import predict_in_positions
from sq_perception.learning.network_config import MaskConfig, RegressorConfig, ThingConfig
from sq_perception.learning.networks import MaskNetwork, Regressor, ThingNetwork
from sq_perception.simulation import rendering

FORMS = [
    RegressorConfig(pixels=32, widths=(4, 8, 8), blocks=1, hidden=32),
    RegressorConfig(pixels=64, widths=(8, 16, 12), blocks=3, hidden=24),
    RegressorConfig(pixels=48, widths=(4, 8, 8, 8), blocks=2, hidden=16),  # 24, 12, 6 and 3 pixels a side
    RegressorConfig(pixels=16, widths=(3, 5, 7, 9), blocks=2, hidden=16),  # down to one pixel
    RegressorConfig(pixels=8, widths=(4,), hidden=16),
]
MASKS = [MaskConfig(), MaskConfig(pixels=32, widths=(4, 8, 8), blocks=2), MaskConfig(pixels=16, widths=(3, 5))]
THINGS = [ThingConfig(), ThingConfig(pixels=32, widths=(8, 16, 16), blocks=3, hidden=16, factors=2, spread=0.3)]


def lively(model: Any) -> Any:
    """The module with measured normalisations and outputs that differ from view to view."""
    pixels = model.config.pixels
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if name.endswith("bias") or "norm" in name or name.startswith("features.1"):
                parameter.add_(0.3 * torch.randn_like(parameter))
            if "mixer" in name or name.endswith("head.weight"):
                parameter.mul_(4)
        for _ in range(3):
            shown = torch.rand(16, pixels, pixels)
            inputs = (shown, torch.randn(16, 4), torch.rand(16))
            model.train()(*(inputs if isinstance(model, ThingNetwork) else (shown[:, None],)))
    return model.eval()


def weights(model: Any) -> dict[str, np.ndarray]:
    return {name: tensor.numpy() for name, tensor in model.state_dict().items()}


@pytest.mark.parametrize("config", [*FORMS, RegressorConfig(), RegressorConfig.thesis(), *THINGS, *MASKS], ids=str)
def test_the_layout_is_that_of_the_modules(config: RegressorConfig | ThingConfig | MaskConfig) -> None:
    module: Any = {RegressorConfig: Regressor, ThingConfig: ThingNetwork, MaskConfig: MaskNetwork}[type(config)]
    with torch.device("meta"):
        model = module(config)
    held = {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
    assert layout.shapes(config) == {name: shape for name, shape in held.items() if not name.endswith(layout.COUNTER)}


@pytest.mark.parametrize("config", [*FORMS, *(RegressorConfig(pixels=pixels) for pixels in (32, 96))], ids=str)
def test_a_random_regressor(config: RegressorConfig, rng: np.random.Generator) -> None:
    torch.manual_seed(1)
    model = lively(Regressor(config))
    predictor = CompactRegressor(config, weights(model))
    views = (rng.random((23, 1, 1)) * rng.random((23, config.pixels, config.pixels))).astype(np.float32)
    for some in (views[:3], views, views[:0], views[:1]):
        expected = model.predict(some).to_flat()
        np.testing.assert_allclose(predictor.predict(some).to_flat(), expected, atol=1e-5)
    assert model.predict(views).to_flat().std(axis=0).max() > 1e-3, "views differ"


@pytest.mark.parametrize("name", ["robust", "supervised"])
def test_the_shipped_regressors(name: str, rng: np.random.Generator) -> None:
    views = np.where(rng.random((5, 64, 64)) < 0.4, 0, rng.random((5, 64, 64))).astype(np.float32)
    expected, found = predict_in_positions(checkpoint.load(name).predict, views), inference.load(name).predict(views)
    np.testing.assert_allclose(found.to_flat(), expected.to_flat(), atol=1e-5)


@pytest.mark.parametrize("config", [*MASKS, None], ids=str)
def test_networks_of_masks(config: MaskConfig | None, rng: np.random.Generator) -> None:
    """None: the one that ships."""
    torch.manual_seed(3)
    model = checkpoint.load_masks() if config is None else MaskNetwork(config)
    pixels = model.config.pixels
    views = rng.standard_normal((21, pixels, pixels, CHANNELS)).astype(np.float32)
    shown = torch.from_numpy(views).permute(0, 3, 1, 2)
    if config is not None:
        for _ in range(3):
            model.train()(shown)
    predictor = CompactMasks(model.config, weights(model))
    for some in (slice(0, 21), slice(3, 4)):
        with torch.inference_mode():
            expected = model.eval()(shown[some]).numpy()
        np.testing.assert_allclose(predictor.logits(views[some]), expected, atol=1e-4)
    assert expected.shape == (1, pixels, pixels)
    assert expected.std() > 1e-3


@pytest.mark.parametrize("config", [*THINGS, None], ids=str)
def test_networks_of_things(config: ThingConfig | None, rng: np.random.Generator) -> None:
    """None: the one that ships.  Half of the planes and extents are unknown."""
    torch.manual_seed(2)
    model = checkpoint.load_things() if config is None else lively(ThingNetwork(config))
    predictor = CompactThings(model.config, weights(model))
    pixels = model.config.pixels
    views = np.where(rng.random((12, pixels, pixels)) < 0.4, -0.5, rng.random((12, pixels, pixels))).astype(np.float32)
    known = np.arange(12) % 2
    planes = (known[:, None] * rng.standard_normal((12, 4))).astype(np.float32)
    extents = (known * rng.uniform(0.05, 0.4, 12)).astype(np.float32)
    expected, found = model.predict(views, planes, extents), predictor.predict(views, planes, extents)
    np.testing.assert_allclose(found[0].to_flat(), expected[0].to_flat(), atol=2e-5)
    for one, other in zip(found[1:], expected[1:], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)


def test_threads_do_not_share_what_they_compute_in(rng: np.random.Generator) -> None:
    predictor = inference.load("robust")
    batches = [rng.random((k, 64, 64)).astype(np.float32) for k in (1, 4, 2, 7)]
    expected = [predictor.predict(views).to_flat() for views in batches]
    found: dict[int, np.ndarray] = {}

    def ask(k: int) -> None:
        for _ in range(3):
            found[k] = predictor.predict(batches[k]).to_flat()

    threads = [threading.Thread(target=ask, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k in range(4):
        np.testing.assert_allclose(found[k], expected[k], atol=1e-6)


@pytest.mark.parametrize(
    "views", [np.zeros((64, 64)), np.zeros((1, 63, 64)), np.full((1, 64, 64), np.nan)], ids=["flat", "narrow", "nan"]
)
def test_other_views_are_refused_with_and_without_torch(views: np.ndarray) -> None:
    for network in (inference.load("robust"), checkpoint.load("robust")):
        with pytest.raises(ValueError, match="expected"):
            network.predict(views)


def test_torch_computes_what_is_no_compact_network(tmp_path: Path, rng: np.random.Generator) -> None:
    torch.manual_seed(3)
    model = Regressor(replace(RegressorConfig.thesis(), pixels=64)).eval()
    checkpoint.save(tmp_path / "m.safetensors", model, dtype=np.float32)
    views, before = rng.random((2, 64, 64)), torch.get_num_threads()
    found = inference.load(tmp_path / "m.safetensors").predict(views)
    np.testing.assert_allclose(found.to_flat(), predict_in_positions(model.predict, views).to_flat(), atol=1e-4)
    assert torch.get_num_threads() == before


def random(count: int, rng: np.random.Generator) -> Superquadric:
    size, shape = rng.uniform(0.1, 0.3, (count, 3)), rng.uniform(0.1, 1.0, (count, 2))
    return Superquadric(size, shape, rng.uniform(0.4, 0.6, (count, 3)), quaternions.random(count, rng))


def changed(bodies: Superquadric, growth: float, shift: float, turn: np.ndarray) -> Superquadric:
    rotation = quaternions.multiply(bodies.rotation, turn)
    return Superquadric(bodies.size * growth, bodies.shape, bodies.translation + shift, rotation)


def answers(*each: Superquadric) -> Superquadric:
    return Superquadric.from_flat(np.stack([one.to_flat() for one in each]))


def test_moved_images_are_images_of_the_moved_bodies() -> None:
    rng = np.random.default_rng(4)
    images, bodies = draw_views(48, rng)
    turns, mirror = np.arange(48) % 4, np.arange(48) // 4 % 2 == 0
    shown, moved = inference.move_images(images, turns, mirror), inference.move_bodies(bodies, turns, mirror)
    again, _ = rendering.render_views(moved)
    assert ((again > 0) != (shown > 0)).mean() < 0.001
    assert np.abs(again - shown)[(again > 0) & (shown > 0)].mean() < 0.004


def test_the_mean_of_forms_of_a_body_is_the_body() -> None:
    rng = np.random.default_rng(1)
    bodies = random(20, rng)
    forms = bodies.equivalent_forms()[rng.integers(8, size=20), np.arange(20)]
    signed = Superquadric(forms.size, forms.shape, forms.translation, -forms.rotation)
    found = inference.mean_body(answers(bodies, forms, signed))
    np.testing.assert_allclose(found.to_flat(), bodies.to_flat(), atol=1e-12)


def test_opposite_errors_cancel() -> None:
    bodies = random(20, np.random.default_rng(2))
    turn = np.array([np.sin(0.05), 0.0, 0.0, np.cos(0.05)])
    larger, smaller = changed(bodies, 1.1, 0.02, turn), changed(bodies, 1 / 1.1, -0.02, turn * [-1, -1, -1, 1])
    mean = inference.mean_body(answers(larger, smaller))
    sign = np.sign((mean.rotation * bodies.rotation).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(mean.size, bodies.size)
    np.testing.assert_allclose(mean.translation, bodies.translation)
    np.testing.assert_allclose(sign * mean.rotation, bodies.rotation, atol=1e-12)


def test_different_answers_are_not_mixed_and_the_one_that_has_most_counts() -> None:
    bodies = random(20, np.random.default_rng(3))
    aside = changed(bodies, 1.5, 0.0, np.array([np.sin(0.35), 0, 0, np.cos(0.35)]))
    for shown, expected in (((bodies, aside), bodies), ((aside, bodies, bodies), bodies), ((aside, bodies), aside)):
        found = inference.mean_body(answers(*shown))
        np.testing.assert_allclose(found.size, expected.size)
        np.testing.assert_allclose(found.rotation, expected.rotation)


def test_a_network_is_shown_four_positions_as_one_batch() -> None:
    """One that answers with the place of the pixel that it sees, whose answers are moved back."""
    views = np.zeros((2, 8, 8), np.float32)
    views[0, 3, 1], views[1, 5, 6] = 1.0, 1.0
    shown = []

    def predict(batch: np.ndarray) -> Superquadric:
        shown.append(len(batch))
        _, rows, columns = np.nonzero(batch)
        place = np.column_stack([(columns + 0.5) / 8, 1 - (rows + 0.5) / 8, np.full(len(batch), 0.5)])
        ones = np.ones((len(batch), 1))
        return Superquadric(ones * [0.1, 0.2, 0.3], ones * [0.5, 0.5], place, ones * [0.0, 0.0, 0.0, 1.0])

    found = inference.predict_in_positions(predict, views)
    assert shown == [8]
    np.testing.assert_allclose(found.translation[:, :2], [[1.5 / 8, 4.5 / 8], [6.5 / 8, 2.5 / 8]])
