"""Nodes in a ROS context of their own, spun in the background, and a peer beside them that speaks to them."""

import gc
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future

PATIENCE = 30.0


class SpunNodes:
    """Make the nodes in ``context``, then :meth:`spin` them; :meth:`close` destroys them and the peer."""

    def __init__(self, *arguments: str) -> None:
        self.context = Context()
        self.context.init(args=["--ros-args", *arguments])
        self.peer = Node("peer", context=self.context)

    def spin(self, nodes: Sequence[Node], executor: Any = None) -> None:
        self._all = (*nodes, self.peer)
        self.executor = (executor or SingleThreadedExecutor)(context=self.context)
        for node in self._all:
            self.executor.add_node(node)
        self.thread = threading.Thread(target=self._spin, daemon=True)
        self.thread.start()

    def _spin(self) -> None:
        try:
            while self.context.ok():
                with suppress(InvalidHandle):  # as sq_perception.nodes.process
                    self.executor.spin_once(timeout_sec=0.2)
        except (ExternalShutdownException, RuntimeError):
            if self.context.ok():
                raise

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.context.try_shutdown()
        self.thread.join(PATIENCE)
        for node in self._all:
            self.executor.remove_node(node)
            node.destroy_node()
        self.executor.shutdown()
        # An events executor keeps what it was waiting for until it is collected, and the next nodes would hear of it.
        del self.executor
        gc.collect()

    @staticmethod
    def set(node: Node, **values: Any) -> None:
        """Set parameters of a node one by one, which it has to accept."""
        for result in node.set_parameters([Parameter(name, value=value) for name, value in values.items()]):
            assert result.successful, result.reason

    @staticmethod
    def until(condition: Callable[[], Any]) -> None:
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            time.sleep(0.005)

    def hear(self, kind: Any, topic: str, quality: Any = 5) -> list[Any]:
        messages: list[Any] = []
        self.peer.create_subscription(kind, topic, messages.append, quality)
        return messages

    def ask(self, kind: Any, name: str, request: Any = None) -> Future:
        client = self.peer.create_client(kind, name)
        self.until(client.service_is_ready)
        return client.call_async(request or kind.Request())

    def call(self, kind: Any, name: str, request: Any = None) -> Any:
        future = self.ask(kind, name, request)
        self.until(future.done)
        return future.result()
