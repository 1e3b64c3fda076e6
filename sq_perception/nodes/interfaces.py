"""Interfaces of the package sq_msgs that nodes offer if it is built."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node

from sq_msgs_py.answers import superquadric_array
from sq_msgs_py.message_types import installed
from sq_perception.recordings.publication import Findings

Outcomes = Callable[[], Awaitable[tuple[bool, str, Findings | None]]]
"""Recovers the next image: success, summary or reason, and the bodies."""


def optional(node: Node, create: Callable[..., Any], name: str, *arguments: Any, **more: Any) -> Any:
    """Return what ``create`` makes of an interface package/msg/Name of sq_msgs; None if it is not installed."""
    try:
        return create(installed(name), *arguments, **more)
    except ModuleNotFoundError:
        return None
    except Exception as error:  # a package that is there in part fails in other ways
        node.get_logger().warning(f"{name} cannot be used: {type(error).__name__}: {error}")
        return None


class RecoverInterfaces:
    """The service ``~/recover_array`` for the next image, and the action ``~/recover_images``."""

    def __init__(self, node: Node, outcomes: Outcomes, group: CallbackGroup) -> None:
        self._outcomes = outcomes
        optional(
            node, node.create_service, "sq_msgs/srv/Recover", "~/recover_array", self._on_recover, callback_group=group
        )

        def served(kind: Any) -> ActionServer:
            self._feedback, self._result = kind.Feedback, kind.Result
            cancelled = {"cancel_callback": lambda _: CancelResponse.ACCEPT}
            return ActionServer(node, kind, "~/recover_images", self._on_images, callback_group=group, **cancelled)

        self._server = optional(node, served, "sq_msgs/action/Recover")

    def close(self) -> None:
        """Destroy the action, which rclpy does not destroy with its node."""
        server, self._server = self._server, None
        if server is not None:
            server.destroy()

    async def _on_recover(self, request: Any, response: Any) -> Any:
        return await self._answer(response)

    async def _on_images(self, goal: Any) -> Any:
        """Recover as many images as the goal asks for; the first failure ends it."""
        result = self._result()
        for _ in range(max(int(goal.request.images), 1)):
            if goal.is_cancel_requested:
                goal.canceled()
                return result
            result = await self._answer(self._result())
            if not result.success:
                goal.abort()
                return result
            goal.publish_feedback(self._feedback(bodies=result.bodies))
        goal.succeed()
        return result

    async def _answer(self, answer: Any) -> Any:
        answer.success, answer.message, found = await self._outcomes()
        if found is not None:
            answer.bodies = superquadric_array(found.array, found.covariances, found.header, found.parts)
        return answer
