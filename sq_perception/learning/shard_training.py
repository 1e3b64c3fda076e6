"""Train a network on views that a folder holds: that of things, and that of masks.

Making a view takes as long as learning from it, and each is worth being seen several times: views are written into a
folder, shard by shard, and a training reads what it finds there.  Of more shards than the memory is to hold it reads
some, others after each validation.

The learning rate falls as a cosine over the time that the run is given.  Views of the ``held`` first shards that a run
finds, which its state names, are never trained on: the log has the network's figures on them, and what is set when a
run ends is set by them.

The network of things
---------------------
Half of the views are shown as in a mirror, of some the extent is kept back.

    loss = mean over views of  -log p(h) / J  +  2 |h_body - h|  +  |mu - h|

The likelihood alone makes the first steps wild; the last term leads.  The log has the mean error of h by kind of
thing, and the standard deviation of error / sigma, which should be 1.

The network of masks
--------------------
Batches are mirrored or turned by a quarter at random, and a view is shown now and then as if there were no support
plane, no other segments, or no readings where a dark or shiny label is.

    loss = sum_cells w cross entropy(l, truth) / sum_cells w,    w = 1 within the segment, AROUND beside it,
                                                                 0 where nothing was measured

The cells beside the segment find the other pieces of an object.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.numpy import load_file as load_arrays
from safetensors.numpy import save as bytes_of

from sq_perception.files import output_file
from sq_perception.geometry.union import mirrored
from sq_perception.imaging.segment_view import HEIGHT, MEASURED, NEARNESS, OTHERS, PLANE, SEGMENT
from sq_perception.learning import checkpoint
from sq_perception.learning.inference import check_device
from sq_perception.learning.network_config import mirror_planes
from sq_perception.learning.networks import HullPrediction, MaskNetwork, ThingNetwork, body_loss
from sq_perception.learning.training import Task, TrainingState, run, threads
from sq_perception.learning.training_config import ShardTraining
from sq_perception.simulation.household import KINDS
from sq_perception.simulation.segment_views import UNKNOWN, YES, SegmentViews, draw_segment_views
from sq_perception.simulation.thing_views import ThingViews, draw_thing_views

AROUND = 0.5
_KEPT_BACK = 0.1  # share of the views without their extent, without the plane, and without other segments
_LABELLED = 0.4  # share of the views of masks with a label that a sensor does not see
HIDDEN = (MEASURED, NEARNESS, HEIGHT, SEGMENT, OTHERS)  # channels that show nothing where there is no reading
_AT_ONCE = 128  # views of a validation that are computed at once
_IN_MEMORY = 2**30
"""Bytes of shards that are read at once, three times that while others are: as many views as a training of masks shows
between two validations."""


@dataclass(frozen=True)
class NetworkKind:
    """What is particular to a network that is trained on shards of views, a dataclass of arrays (n, ...)."""

    name: str  # name of its file of weights and of its command, train-NAME
    none: Any  # no views at all, in the form of all
    network: Callable[[str], Any]  # a network to begin with, from the weights that ShardTraining.start names
    batch: Callable[[Any, np.ndarray, np.random.Generator], tuple[np.ndarray, ...]]
    """What the network takes of the views of these numbers, varied at random, and last the truth about them."""
    loss: Callable[[Any, tuple[torch.Tensor, ...], Any, float], torch.Tensor]  # as Task.loss
    validate: Callable[[Any, Any], dict[str, Any]]  # figures of the network on views
    finish: Callable[..., None] = lambda network, views: None
    """Changes a network when its training ends, by views that it was not trained on: errors on the others are smaller,
    by a seventh after 8 million views of 700 000."""


def write_views(folder: Path, shards: Iterable[int], draw: Callable[[np.random.Generator], Any], seed: int) -> None:
    """Write shards of freshly drawn views that are not there yet; shard k follows from (seed, k) and ``draw`` alone."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in shards:
        path = folder / f"{k:05d}.safetensors"
        if path.exists():
            print(f"{path}: there already")
            continue
        drawn = draw(np.random.default_rng([seed, k]))
        output_file.write(path, bytes_of(_to_stored(drawn)))
        print(f"{path}: {len(drawn.images)} views")


def read_views(none: Any, paths: list[Path]) -> Any:
    """All views of some shards; a ValueError if one is damaged, or not in the form of ``none``, or all are empty."""
    form, shards = type(none), []
    for path in paths:
        try:
            arrays = load_arrays(str(path))
            shards.append([arrays[name] for name in vars(none)])
            for (name, wanted), array in zip(_to_stored(none).items(), shards[-1], strict=True):
                shape = len(shards[-1][0]), *wanted.shape[1:]
                if array.shape != shape or array.dtype != wanted.dtype:
                    raise ValueError(f"{name}: expected {wanted.dtype} {shape}, got {array.dtype} {array.shape}")
        except (SafetensorError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path}: not a readable shard of {form.__name__}: {error}") from error
    if not any(len(shard[0]) for shard in shards):
        raise ValueError(f"{paths[0].parent}: expected views in {', '.join(path.name for path in paths)}, found none")
    return form(*(np.concatenate(parts) for parts in zip(*shards, strict=True)))


def _to_stored(views: Any) -> dict[str, np.ndarray]:
    """Views as a shard holds them."""
    return {**vars(views), "images": views.images.astype(np.float16)}


def train(kind: NetworkKind, config: ShardTraining, views: Path, output: Path) -> Any:
    """Run, or continue, a training; returns the averaged network, also kept in ``output``/NAME.safetensors.  Raises
    ValueError for too few or damaged shards or an absent device, CheckpointError, and what :func:`run` raises."""
    device = torch.device(check_device(config.device))
    with threads(config.threads):
        torch.manual_seed(config.seed)
        output.mkdir(parents=True, exist_ok=True)
        goes_on = (output / "state.safetensors").exists()  # and has all weights, though the start may be gone
        state = TrainingState.begin(kind.network("" if goes_on else config.start).to(device), config, output)
        rng = np.random.default_rng([config.seed, state.step])
        state.held = state.held or [shard.name for shard in _shards(views, config.held)[: config.held]]
        held = read_views(kind.none, [views / name for name in state.held])
        shards = _choose_shards(views, state.held, rng)
        pool = read_views(kind.none, shards)

        def batch() -> tuple[tuple[torch.Tensor, ...], torch.Tensor]:
            drawn = kind.batch(pool, rng.integers(len(pool.images), size=config.batch), rng)
            *shown, truth = (torch.from_numpy(np.ascontiguousarray(each)).to(device) for each in drawn)
            return tuple(shown), truth

        def validate(network: Any) -> dict[str, Any]:
            nonlocal shards, pool
            if (chosen := _choose_shards(views, state.held, rng)) != shards:
                shards, pool = chosen, read_views(kind.none, chosen)
            return kind.validate(network, held)

        finish = partial(kind.finish, views=held)
        return run(state, config, Task(f"train-{kind.name}", kind.name, batch, kind.loss, validate, finish))


def _shards(folder: Path, held: int) -> list[Path]:
    """The shards that a folder holds, in order; raises ValueError if there are none but those kept for validation."""
    # One that is being written is NAME.partial.safetensors.
    found = sorted(path for path in folder.glob("*.safetensors") if ".partial" not in path.suffixes)
    if len(found) <= held:
        raise ValueError(f"{folder}: expected more than {held} shards of views, found {len(found)}")
    return found


def _choose_shards(folder: Path, held: Sequence[str], rng: np.random.Generator) -> list[Path]:
    """All shards to train on if the memory is to hold them, else some at random, in order."""
    shards = [shard for shard in _shards(folder, len(held)) if shard.name not in held]
    sizes = np.array([shard.stat().st_size for shard in shards])
    if sizes.sum() <= _IN_MEMORY:
        return shards
    drawn = rng.permutation(len(shards))
    fit = np.cumsum(sizes[drawn]) <= _IN_MEMORY
    fit[0] = True
    return [shards[k] for k in np.sort(drawn[fit])]


def hull_loss(predicted: HullPrediction, _shown: Any, truth: torch.Tensor, _progress: float) -> torch.Tensor:
    """The loss for true support functions (b, J); see the module."""
    return (
        predicted.negative_log_likelihood(truth).mean() / truth.shape[1]
        + 2 * body_loss(predicted.body, truth).mean()
        + (predicted.support - truth).abs().mean()
    )


@torch.inference_mode()
def validate_things(network: ThingNetwork, views: ThingViews) -> dict[str, Any]:
    """Mean errors of h and of the body's h in sides of the view, and the deviation of error / sigma, by kind."""
    network.eval()
    device = next(network.parameters()).device
    parts = []
    for i in range(0, len(views.images), _AT_ONCE):
        chosen = slice(i, i + _AT_ONCE)
        arrays = views.images[chosen].astype(np.float32), views.planes[chosen], views.extents[chosen]
        *shown, truth = (torch.from_numpy(each).to(device) for each in (*arrays, views.support[chosen]))
        predicted = network(*shown)
        error = predicted.support - truth
        figures = error.abs().mean(dim=1), body_loss(predicted.body, truth), error / predicted.deviation()
        parts.append([each.cpu().numpy() for each in figures])
    mean_error, body_error, ratio = map(np.concatenate, zip(*parts, strict=True))
    means = {"error": mean_error.mean(), "body": body_error.mean(), "ratio": ratio.std()}
    found: dict[str, Any] = {name: float(mean) for name, mean in means.items()}
    for k, kind in enumerate(KINDS):
        mine = views.kinds == k
        if mine.any():
            found[kind] = [float(mean_error[mine].mean()), float(np.sqrt(np.mean(ratio[mine] ** 2)))]
    return found


def calibrate_spread(network: ThingNetwork, views: ThingViews) -> None:
    """Scale S so that error / sigma deviates by 1 on these views; 4000 views settle it to 2 %.  The likelihood leaves
    1.3, as it takes errors in longer tails than those of the t distribution for rare."""
    spread = network.config.spread * validate_things(network, views)["ratio"] ** 2
    network.config = replace(network.config, spread=float(spread))


def _begin_things(start: str) -> ThingNetwork:
    network = checkpoint.load_things(start) if start else ThingNetwork()
    network.config = replace(network.config, spread=1.0)  # that of the weights to come is set when the training ends
    return network


def _thing_batch(views: ThingViews, chosen: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Images (b, p, p), planes (b, 4), extents (b,) and support functions (b, J) of some views."""
    images = views.images[chosen].astype(np.float32)
    planes, support = views.planes[chosen], views.support[chosen]
    extents = np.where(rng.random(len(chosen)) < _KEPT_BACK, np.float32(0), views.extents[chosen])
    turned = rng.random(len(chosen)) < 0.5
    images[turned] = images[turned][:, :, ::-1]
    planes = np.where(turned[:, None], mirror_planes(planes), planes)
    return images, planes, extents, np.where(turned[:, None], support[:, mirrored(0)], support)


def mask_loss(
    logits: torch.Tensor, shown: tuple[torch.Tensor, ...], truth: torch.Tensor, _progress: float = 0.0
) -> torch.Tensor:
    """The loss of logits (b, p, p) for views (b, CHANNELS, p, p) and their truth (b, p, p); see the module."""
    (images,) = shown
    weight = torch.where(images[:, SEGMENT] > 0, 1.0, AROUND) * (truth != UNKNOWN)
    each = torch.nn.functional.binary_cross_entropy_with_logits(logits, (truth == YES).float(), reduction="none")
    return (weight * each).sum() / weight.sum().clamp_min(1)


@torch.inference_mode()
def validate_masks(network: MaskNetwork, views: SegmentViews) -> dict[str, float]:
    """Shares in the objects' readings: outliers in segments before and after, and readings that are lost."""
    network.eval()
    device = next(network.parameters()).device
    outliers = left = lost = objects = 0
    for i in range(0, len(views.images), _AT_ONCE):
        images = torch.from_numpy(views.images[i : i + _AT_ONCE].astype(np.float32)).to(device).permute(0, 3, 1, 2)
        truth = torch.from_numpy(views.truth[i : i + _AT_ONCE]).to(device)
        inside = (images[:, SEGMENT] > 0) & (truth != UNKNOWN)
        kept, own = network(images) >= 0, inside & (truth == YES)
        objects += int(own.sum())
        outliers += int((inside & ~own).sum())
        left += int((inside & ~own & kept).sum())
        lost += int((own & ~kept).sum())
    objects = max(objects, 1)  # views of no object at all have outliers alone
    return {"outliers": outliers / objects, "left": left / objects, "lost": lost / objects}


def _mask_batch(views: SegmentViews, chosen: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Images (b, CHANNELS, p, p) and their truth (b, p, p)."""
    images, truth = views.images[chosen].astype(np.float32), views.truth[chosen]
    for k in np.flatnonzero(rng.random(len(chosen)) < _LABELLED):
        hide_label(images[k], truth[k], rng)
    without_plane, alone = rng.random((2, len(chosen))) < _KEPT_BACK
    images[without_plane, :, :, HEIGHT] = images[without_plane, :, :, PLANE] = 0
    images[alone, :, :, OTHERS] = 0
    if rng.random() < 0.5:
        images, truth = images[:, :, ::-1], truth[:, :, ::-1]
    if rng.random() < 0.5:
        images, truth = images.transpose(0, 2, 1, 3), truth.transpose(0, 2, 1)
    return images.transpose(0, 3, 1, 2), truth


def hide_label(image: np.ndarray, truth: np.ndarray, rng: np.random.Generator) -> None:
    """Remove the readings of a random band or patch of a segment from a view (p, p, CHANNELS) and its truth, in place.

    Half of the bands also split the segment: what lies beyond the band becomes another segment, as a segmentation would
    have it.  Segments of fewer than 30 cells stay as they are.
    """
    cells = np.argwhere((image[..., SEGMENT] > 0) & (image[..., MEASURED] > 0))
    if len(cells) < 30:
        return
    centred, grid = cells - cells.mean(axis=0), np.moveaxis(np.indices(truth.shape), 0, -1) - cells.mean(axis=0)
    across, along = np.linalg.eigh(centred.T @ centred)[1].T
    angle = rng.uniform(0, np.pi)
    way = (along, across, np.array([np.cos(angle), np.sin(angle)]))[rng.choice(3, p=(0.45, 0.25, 0.3))]
    place, beside = grid @ way, grid @ np.array([-way[1], way[0]])
    extent, width = np.ptp(centred @ way), np.ptp(centred @ np.array([-way[1], way[0]]))
    middle, half = extent * rng.uniform(-0.3, 0.3), extent * rng.uniform(0.03, 0.2)
    hidden, is_band = np.abs(place - middle) < half, rng.random() < 0.65
    if not is_band:
        hidden &= np.abs(beside - width * rng.uniform(-0.3, 0.3)) < width * rng.uniform(0.15, 0.35)
    of_thing = truth == YES if rng.random() < 0.7 else (image[..., SEGMENT] > 0) | (image[..., OTHERS] > 0)
    gone = hidden & of_thing
    for channel in HIDDEN:
        image[gone, channel] = 0
    truth[gone] = UNKNOWN
    segment = image[..., SEGMENT] > 0
    kept = segment & ((place < middle) == (rng.random() < 0.5))
    sides = kept, segment & ~kept
    if is_band and rng.random() < 0.5 and all(side.sum() >= 12 and (truth[side] == YES).mean() > 0.9 for side in sides):
        image[..., SEGMENT], image[..., OTHERS] = kept, np.maximum(image[..., OTHERS], sides[1])


THINGS = NetworkKind(
    "things", draw_thing_views(0, np.random.default_rng(0)), _begin_things, _thing_batch, hull_loss, validate_things,
    calibrate_spread,
)
MASKS = NetworkKind(
    "masks", draw_segment_views(0, np.random.default_rng(0)),
    lambda start: checkpoint.load_masks(start) if start else MaskNetwork(), _mask_batch, mask_loss, validate_masks,
)
