"""A node that may fail to start, and has something to stop before it is destroyed."""

from __future__ import annotations

from rclpy.node import Node


class StoppableNode(Node):
    """What :func:`sq_perception.nodes.process.run` expects."""

    start_failure = ""
    """Why the node cannot start, once it has found out; its process then ends."""

    def close(self) -> bool:
        """Stop threads; called once, before destroy_node.  False if one of them could not be stopped."""
        return True
