"""recover_node: superquadrics from depth images, started by a network and refined (see frame_node for the topics)."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sq_perception.nodes import process

if TYPE_CHECKING:
    from sq_perception.nodes.frame_node import FrameNode
    from sq_perception.nodes.parameters import RecoverParameters
    from sq_perception.recovery import Recoverer, RecoveryOptions

NAME = "recover_node"


def create() -> FrameNode:
    """The node; imported here, as torch takes seconds to import and Ctrl-C must be heard meanwhile."""
    from sq_perception.nodes.frame_node import FrameNode
    from sq_perception.nodes.parameters import RecoverParameters

    return FrameNode(NAME, RecoverParameters, _recoverer, _options)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit code."""
    return process.run(NAME, create, arguments)


def _recoverer(parameters: RecoverParameters) -> Recoverer:
    import torch

    from sq_perception.recovery import Recoverer

    # On a robot's busy cores the slowest of several threads sets the time; one image is too small to gain from them.
    torch.set_num_threads(1)
    return Recoverer(parameters.model or None, parameters.device, parameters.method, parameters.consensus)


def _options(parameters: RecoverParameters) -> RecoveryOptions:
    from sq_perception.recovery import RecoveryOptions

    return RecoveryOptions(
        method=parameters.method,
        refine=parameters.refine,
        sharpness=parameters.s,
        tau=parameters.tau,
        depth_range=parameters.depth_range,
        max_objects=parameters.max_objects,
        time_budget=parameters.seconds,
    )


if __name__ == "__main__":
    sys.exit(main())
