"""fitter_node: superquadrics from depth images by the method of Solina and Bajcsy (see frame_node for the topics)."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sq_perception.nodes import process

if TYPE_CHECKING:
    from sq_perception.nodes.engine import Workshop
    from sq_perception.nodes.frame_node import FrameNode
    from sq_perception.nodes.parameters import FitterParameters
    from sq_perception.recovery.recoverer import Recoverer, RecoveryOptions

NAME = "fitter_node"


def create(namespace: str | None = None) -> FrameNode:
    """The node; imported here, as torch takes seconds to import and Ctrl-C must be heard meanwhile."""
    from sq_perception.nodes.frame_node import FrameNode
    from sq_perception.nodes.parameters import FitterParameters

    return FrameNode(NAME, FitterParameters, workshop(), namespace=namespace)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit code."""
    return process.run(NAME, lambda: [create()], arguments)


def workshop() -> Workshop[FitterParameters]:
    """How the node's recoverer is made."""
    from sq_perception.nodes.engine import Workshop

    return Workshop(
        make=_recoverer, options=_options, key=lambda _: "classic", describe=lambda _: "method classic, no network"
    )


def _recoverer(parameters: FitterParameters) -> Recoverer:
    from sq_perception.recovery.recoverer import Recoverer

    return Recoverer(method="classic")


def _options(parameters: FitterParameters) -> RecoveryOptions:
    from sq_perception.recovery.recoverer import RecoveryOptions

    return RecoveryOptions(
        method="classic",
        sharpness=parameters.s,
        tau=parameters.tau,
        depth_range=parameters.depth_range,
        max_objects=parameters.max_objects,
        time_budget=parameters.seconds,
    )


if __name__ == "__main__":
    sys.exit(main())
