"""recover_node and fitter_node: one node, whose method is auto in the one and classic in the other.

The topics are in :mod:`sq_perception.nodes.frame_node`, the recoverer is made of the parameters here.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import torch

from sq_perception.learning import checkpoint
from sq_perception.nodes.engine import RecovererFactory
from sq_perception.nodes.frame_node import FrameNode
from sq_perception.nodes.parameters import FitterParameters, RecoverParameters
from sq_perception.recovery.recoverer import Recoverer, RecoveryOptions, checked_device

KINDS = {"recover_node": RecoverParameters, "fitter_node": FitterParameters}
_NEEDS_NETWORK = ("auto", "network")


def create(namespace: str | None = None, name: str = "recover_node", context: Any = None) -> FrameNode:
    """The node of that name, recover_node or fitter_node."""
    return FrameNode(name, KINDS[name], FACTORY, namespace=namespace, context=context)


def options(parameters: RecoverParameters) -> RecoveryOptions:
    """What the parameters say to each frame."""
    return RecoveryOptions(
        method=parameters.method,
        refine=parameters.refine,
        sharpness=parameters.s,
        tau=parameters.tau,
        depth_range=parameters.depth_range,
        max_objects=parameters.max_objects,
        max_size=parameters.max_size,
        time_budget=parameters.seconds,
        repair=parameters.repair,
    )


def _recoverer(parameters: RecoverParameters, previous: Recoverer | None) -> Recoverer:
    # On a robot's busy cores the slowest of several threads sets the time; one image is too small to gain from them.
    torch.set_num_threads(1)
    return Recoverer(
        parameters.model or None,
        parameters.device,
        parameters.method,
        parameters.consensus,
        parameters.threads or None,
        weights_of=previous,
    )


def _weights(parameters: RecoverParameters) -> Hashable:
    """The very file: another one may take its name."""
    path = checkpoint.resolve(parameters.model or None)
    try:
        known = path.stat()
    except OSError:
        return str(path)
    return str(path.resolve()), known.st_ino, known.st_size, known.st_mtime_ns


def _check(parameters: RecoverParameters, names: frozenset[str], at_work: Recoverer | None) -> None:
    if "device" in names:
        checked_device(parameters.device)
    is_loaded = at_work is not None and at_work.has_weights
    is_wanted = parameters.method in _NEEDS_NETWORK and at_work is not None
    if "model" in names or (is_wanted and ("device" in names or ("method" in names and not is_loaded))):
        try:
            checkpoint.check(parameters.model or None)
        except ValueError as error:
            raise ValueError(f"model: {error}") from error


def _describe(parameters: RecoverParameters) -> str:
    if parameters.method not in _NEEDS_NETWORK:
        return f"method {parameters.method}, no network"
    return f"method {parameters.method}, {parameters.model or 'default weights'} on {parameters.device}"


FACTORY: RecovererFactory[RecoverParameters] = RecovererFactory(
    make=_recoverer,
    options=options,
    made_of=("model", "device", "consensus", "threads", "method"),
    read_by=("model", "device"),
    weights=_weights,
    answers=("method", "refine", "consensus"),
    check=_check,
    describe=_describe,
)
