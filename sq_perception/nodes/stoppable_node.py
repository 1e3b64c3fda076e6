"""A node that has something to stop before it is destroyed."""

from __future__ import annotations

from rclpy.node import Node


class StoppableNode(Node):
    """What :func:`sq_perception.nodes.process.run` expects."""

    def close(self) -> None:
        """Stop threads; called once, before destroy_node."""
