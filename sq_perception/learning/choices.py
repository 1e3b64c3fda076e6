"""What a network and its training may be chosen from, by name; importable without torch, for the help of commands."""

from __future__ import annotations

from typing import Literal, get_args

Backbone = Literal["compact", "resnet18"]  # the residual networks of :mod:`sq_perception.learning.networks`
Framing = Literal["cropped", "full"]  # what a view shows: one object that fills it, or the thesis' whole image
Loss = Literal["occupancy", "occupancy_rotation", "dual", "mse", "least_squares", "least_squares_free", "render"]
"""The losses of :mod:`sq_perception.learning.losses`."""
LOSSES: tuple[str, ...] = get_args(Loss)
UNSUPERVISED = ("least_squares", "least_squares_free", "render")  # losses that see the view alone, no label
NEEDS_TORCH = "needs torch: pip install 'sq_perception[train]'"
"""The remedy where torch is not installed: training, graphics cards, ResNet-18 and the soft renderer need it."""
