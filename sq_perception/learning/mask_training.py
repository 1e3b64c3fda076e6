"""How the network of masks (:mod:`sq_perception.learning.mask_network`) is trained on segments.

Batches are mirrored or turned by a quarter at random, and a view is shown now and then as if there were no support
plane, or no other segments.

    loss = sum_cells w cross entropy(l, truth) / sum_cells w,    w = 1 within the segment, AROUND beside it,
                                                                 0 where nothing was measured

The cells beside the segment find the other pieces of an object.
"""

from __future__ import annotations

import numpy as np
import torch

from sq_perception.imaging.segment_view import HEIGHT, OTHERS, PLANE, SEGMENT
from sq_perception.learning import checkpoint
from sq_perception.learning.mask_network import MaskNetwork
from sq_perception.learning.shard_training import Subject
from sq_perception.simulation.segment_views import UNKNOWN, YES, SegmentViews, draw_segment_views

AROUND = 0.5
_KEPT_BACK = 0.1
"""Share of the views without the plane, and without other segments."""
_BATCH = 128
"""Views of a validation that are computed at once."""


def mask_loss(logits: torch.Tensor, images: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """The loss of logits (b, p, p) for views (b, CHANNELS, p, p) and their truth (b, p, p); see the module."""
    weight = torch.where(images[:, SEGMENT] > 0, 1.0, AROUND) * (truth != UNKNOWN)
    each = torch.nn.functional.binary_cross_entropy_with_logits(logits, (truth == YES).float(), reduction="none")
    return (weight * each).sum() / weight.sum().clamp_min(1)


@torch.inference_mode()
def validate(network: MaskNetwork, views: SegmentViews) -> dict[str, float]:
    """Shares in the objects' readings: outliers in segments before and after, and readings that are lost."""
    network.eval()
    device = next(network.parameters()).device
    outliers = left = lost = objects = 0
    for i in range(0, len(views.images), _BATCH):
        images = torch.from_numpy(views.images[i : i + _BATCH].astype(np.float32)).to(device).permute(0, 3, 1, 2)
        truth = torch.from_numpy(views.truth[i : i + _BATCH]).to(device)
        inside = (images[:, SEGMENT] > 0) & (truth != UNKNOWN)
        kept, own = network(images) >= 0, inside & (truth == YES)
        objects += int(own.sum())
        outliers += int((inside & ~own).sum())
        left += int((inside & ~own & kept).sum())
        lost += int((own & ~kept).sum())
    objects = max(objects, 1)  # views of no object at all have outliers alone
    return {"outliers": outliers / objects, "left": left / objects, "lost": lost / objects}


def _new_network(start: str) -> MaskNetwork:
    return checkpoint.load_masks(start) if start else MaskNetwork()


def _batch(views: SegmentViews, chosen: np.ndarray, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Images (b, CHANNELS, p, p) and their truth (b, p, p), varied as the module says."""
    images = views.images[chosen].astype(np.float32)
    without_plane, alone = rng.random((2, len(chosen))) < _KEPT_BACK
    images[without_plane, :, :, HEIGHT] = images[without_plane, :, :, PLANE] = 0
    images[alone, :, :, OTHERS] = 0
    truth = views.truth[chosen]
    if rng.random() < 0.5:
        images, truth = images[:, :, ::-1], truth[:, :, ::-1]
    if rng.random() < 0.5:
        images, truth = images.transpose(0, 2, 1, 3), truth.transpose(0, 2, 1)
    return torch.from_numpy(np.ascontiguousarray(images.transpose(0, 3, 1, 2))), torch.from_numpy(truth.copy())


MASKS = Subject("masks", draw_segment_views(0, np.random.default_rng(0)), _new_network, _batch, mask_loss, validate)
