"""recover_node: superquadrics from depth images, started by a network and refined (see frame_node for the topics)."""

from __future__ import annotations

import sys
from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING

from sq_perception.nodes import process

if TYPE_CHECKING:
    from sq_perception.nodes.engine import Workshop
    from sq_perception.nodes.frame_node import FrameNode
    from sq_perception.nodes.parameters import RecoverParameters
    from sq_perception.recovery.recoverer import Recoverer, RecoveryOptions

NAME = "recover_node"


def create(namespace: str | None = None) -> FrameNode:
    """The node; imported here, as torch takes seconds to import and Ctrl-C must be heard meanwhile."""
    from sq_perception.nodes.frame_node import FrameNode
    from sq_perception.nodes.parameters import RecoverParameters

    return FrameNode(NAME, RecoverParameters, workshop(), namespace=namespace)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit code."""
    return process.run(NAME, lambda: [create()], arguments)


def workshop() -> Workshop[RecoverParameters]:
    """How the node's recoverer is made."""
    from sq_perception.nodes.engine import Workshop

    return Workshop(
        make=_recoverer,
        options=_options,
        ingredients=("model", "device", "consensus", "threads", "method"),
        key=_key,
        judge=_judge,
        describe=_describe,
    )


def _recoverer(parameters: RecoverParameters) -> Recoverer:
    import torch

    from sq_perception.recovery.recoverer import Recoverer

    # On a robot's busy cores the slowest of several threads sets the time; one image is too small to gain from them.
    torch.set_num_threads(1)
    return Recoverer(
        parameters.model or None,
        parameters.device,
        parameters.method,
        parameters.consensus,
        parameters.threads or None,
    )


def _options(parameters: RecoverParameters) -> RecoveryOptions:
    from sq_perception.recovery.recoverer import RecoveryOptions

    return RecoveryOptions(
        method=parameters.method,
        refine=parameters.refine,
        sharpness=parameters.s,
        tau=parameters.tau,
        depth_range=parameters.depth_range,
        max_objects=parameters.max_objects,
        time_budget=parameters.seconds,
        repair=parameters.repair,
    )


def _key(parameters: RecoverParameters) -> Hashable:
    """What a recoverer is made of: the very file too, as another one may take its name."""
    from sq_perception.learning import checkpoint

    path = checkpoint.resolve(parameters.model or None)
    try:
        known = path.stat()
        file: Hashable = (str(path.resolve()), known.st_ino, known.st_size, known.st_mtime_ns)
    except OSError:
        file = str(path)
    return file, parameters.device, parameters.consensus, parameters.threads, parameters.method


def _judge(parameters: RecoverParameters, names: frozenset[str]) -> None:
    from sq_perception.learning import checkpoint
    from sq_perception.recovery.recoverer import checked_device

    if "model" in names:
        try:
            checkpoint.check(parameters.model or None)
        except ValueError as error:
            raise ValueError(f"model: {error}") from error
    if "device" in names:
        checked_device(parameters.device)


def _describe(parameters: RecoverParameters) -> str:
    model = parameters.model or "default weights"
    return f"method {parameters.method}, {model} on {parameters.device}"


if __name__ == "__main__":
    sys.exit(main())
