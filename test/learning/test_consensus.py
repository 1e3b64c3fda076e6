"""Consensus of the 8 positions: what every position says counts, what one of them says does not."""

from __future__ import annotations

import numpy as np

from sq_perception.geometry import Superquadric
from sq_perception.geometry.metrics import volume_iou
from sq_perception.learning import checkpoint
from sq_perception.learning.consensus import Consensus, averaged
from sq_perception.learning.dataset import draw_views
from sq_perception.learning.dihedral import MIRROR, TURNS, moved_bodies, moved_images
from sq_perception.learning.regressor import RegressorConfig
from sq_perception.simulation.scenes import thesis_bodies


def answers(bodies: Superquadric, noise: float, rng: np.random.Generator) -> Superquadric:
    """8 answers to each body (n,): its 8 equivalent forms in random order, each with errors of its own."""
    forms = bodies.equivalent_forms().to_flat().transpose(1, 0, 2)
    flat = forms[:, rng.permutation(8)].copy()
    flat[..., :3] *= np.exp(noise * rng.standard_normal(flat[..., :3].shape))
    flat[..., 3:] += noise * rng.standard_normal(flat[..., 3:].shape) * ([0.5] * 2 + [0.2] * 3 + [0.5] * 4)
    flat[..., 8:] *= np.where(rng.random((*flat.shape[:2], 1)) < 0.5, -1, 1)
    flat[..., 8:] /= np.linalg.norm(flat[..., 8:], axis=-1, keepdims=True)
    return Superquadric.from_flat(flat)


class TestAverage:
    def test_equal_bodies_in_any_form_are_that_body(self) -> None:
        bodies = thesis_bodies(20, np.random.default_rng(0))
        found = averaged(answers(bodies, 0.0, np.random.default_rng(1)))
        assert volume_iou(found, bodies).min() > 0.999

    def test_errors_fall_with_the_root_of_eight(self) -> None:
        bodies, rng = thesis_bodies(200, np.random.default_rng(2)), np.random.default_rng(3)
        given = answers(bodies, 0.04, rng)
        found = averaged(given)
        alone = np.log(np.prod(given.size, axis=-1)[:, 0] / np.prod(bodies.size, axis=-1))
        together = np.log(np.prod(found.size, axis=-1) / np.prod(bodies.size, axis=-1))
        assert 2 < alone.std() / together.std() < 3.5

    def test_outvotes_the_few(self) -> None:
        """Two answers of eight that take another axis for z change nothing."""
        bodies = thesis_bodies(20, np.random.default_rng(4))
        given = answers(bodies, 0.0, np.random.default_rng(5)).to_flat()
        wrong = thesis_bodies(40, np.random.default_rng(6)).to_flat().reshape(20, 2, 12)
        wrong[..., :3] *= 3
        given[:, [2, 6]] = wrong
        assert volume_iou(averaged(Superquadric.from_flat(given)), bodies).min() > 0.999


class TestConsensus:
    def test_asks_in_every_position_and_carries_back(self) -> None:
        """A predictor that knows the truth in each position is believed."""
        views, truth = draw_views(3, np.random.default_rng(7))

        class Knowing:
            config = RegressorConfig()

            def predict(self, moved: np.ndarray) -> Superquadric:
                np.testing.assert_array_equal(
                    moved, moved_images(np.repeat(views, 8, axis=0), np.tile(TURNS, 3), np.tile(MIRROR, 3))
                )
                repeated = Superquadric.from_flat(np.repeat(truth.to_flat(), 8, axis=0))
                return moved_bodies(repeated, np.tile(TURNS, 3), np.tile(MIRROR, 3))

        assert volume_iou(Consensus(Knowing()).predict(views), truth).min() > 0.999

    def test_answers_move_with_the_view(self) -> None:
        """What a network alone has not learned exactly, the consensus has by construction."""
        model = checkpoint.load()
        views, _ = draw_views(16, np.random.default_rng(8))
        turns, mirror = np.arange(16) % 4, np.arange(16) % 8 >= 4
        both = []
        for predictor in (model, Consensus(model)):
            straight = moved_bodies(predictor.predict(views), turns, mirror)
            both.append(volume_iou(predictor.predict(moved_images(views, turns, mirror)), straight).mean())
        assert both[0] < 0.97
        assert both[1] > 0.995

    def test_is_better_than_one_answer(self) -> None:
        model = checkpoint.load()
        views, truth = draw_views(150, np.random.default_rng(9))
        alone, together = (volume_iou(p.predict(views), truth) for p in (model, Consensus(model)))
        assert together.mean() > alone.mean() + 0.005
