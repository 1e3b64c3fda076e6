"""moveit_msgs/CollisionObject of superquadrics, and the planning scene difference that carries them; needs moveit_msgs.

The pose of an object is that of the body, its id ``<prefix><id>``.  Its one shape has the identity as pose and encloses
the body (:mod:`sq_msgs_py.shapes`): the smallest of box, cylinder and sphere, or a mesh, grown to enclose.  Primitives
are solid and quick to make and to test.  Meshes fit closely, take a hundred times as long to make, and FCL, MoveIt's
usual collision checker, knows of a mesh only its surface.

MoveIt takes objects on two topics, both with a queue of ten: ``collision_object``, one object a message, and
``planning_scene``, any number.  A frame is one difference (``is_diff``) for the latter: it arrives whole or not at all,
and leaves alone what others put into the scene.  MoveIt places an object by the newest transform of the header's frame,
whatever its stamp.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from itertools import compress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from geometry_msgs.msg import Pose, Quaternion

from sq_msgs_py.poses import PREFIX, body_name, matrices, pose_messages, unit_quaternions
from sq_msgs_py.shapes import enclosing_factor, mesh_message, primitive, support
from sq_msgs_py.superquadrics import SuperquadricArray

if TYPE_CHECKING:
    from moveit_msgs.msg import CollisionObject, PlanningScene


Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices (k, 3) and faces (m, 3)."""


class _Known(NamedTuple):
    """An object as it was sent, and its body; None for one that has to be sent again when it is shown."""

    message: CollisionObject
    body: SuperquadricArray | None


class Scene:
    """The bodies of one source as planners know them: what each frame changes.

    An object is sent again when it has changed, as a planner copies its world for each message, and all of them in
    another frame or as other shapes.  One is removed when its id is gone, that is neither shown nor hidden: what a
    robot's arm hides is still there, and another planner is told of it as well.
    """

    def __init__(self) -> None:
        self._known: dict[str, _Known] = {}  # by name
        self._is_new = False  # whether a planner listens that knows nothing
        self._gone: dict[str, int] = {}  # how many repetitions remove a name once more, in the order in which they went
        self._gone_again: frozenset[str] = frozenset()  # those that the next frame removes once more
        self._known_as = "", False
        self._header: Any = None

    def forget(self) -> None:
        """Let the next frame send every object again, hidden ones as they were: another planner listens."""
        self._send_again()
        self._is_new = True

    def repeat(self) -> None:
        """Let the next frame send every object and every late removal again: a planner may have lost messages.

        None that is hidden: one that a gripper has taken, and that is attached to it by now, would come back.
        """
        self._send_again()
        self._gone_again = frozenset(self._gone)
        self._gone = {key: left - 1 for key, left in self._gone.items() if left > 1}

    def changes(
        self, superquadrics: SuperquadricArray, header: Any, hidden: Iterable[int] = (), *, rests: bool = True,
        meshes: Callable[[], Sequence[Mesh]] | None = None, prefix: str = PREFIX,
    ) -> list[CollisionObject]:
        """Objects to ADD and to REMOVE after another frame, by :func:`collision_objects` and :func:`removals`.

        ``hidden``: ids of bodies that the frame does not show and that are not given up.  ``rests``: whether the
        header's frame does: where it moves, what is hidden is no longer where it was sent to.  ``meshes``: makes those
        of the bodies that did not fail, where they are needed.
        """
        known_as = header.frame_id, meshes is not None
        if known_as != self._known_as:
            self._send_again()
        self._known_as, self._header = known_as, header
        shown = superquadrics.recovered
        names = [body_name(number, prefix) for number in shown.id]
        bodies = [self._known[key].body if key in self._known else None for key in names]
        new = np.array([_has_changed(body, shown, k) for k, body in enumerate(bodies)], dtype=bool)
        surfaces = None
        if meshes is not None:
            surfaces = list(compress(meshes(), new)) if new.any() else []
        objects = collision_objects(shown.where(new), header, meshes=surfaces, prefix=prefix)
        sent = dict(zip(np.flatnonzero(new), objects, strict=True))
        unseen = {body_name(number, prefix) for number in hidden}
        if self._is_new and rests:
            told = (self._known[key].message for key in sorted(unseen & self._known.keys()))
            objects += (message for message in told if message.header.frame_id == header.frame_id)
        self._is_new = False
        kept = {*names, *unseen}
        gone = self._known.keys() - kept
        objects += removals((gone | self._gone_again) - kept, header)
        # Twice more, as a planner may be busy when the first one comes; of a hundred at most.
        late = [*((key, left) for key, left in self._gone.items() if key not in gone), *((key, 2) for key in gone)]
        self._gone, self._gone_again = dict(late[-100:]), frozenset()
        self._known = {key: known for key, known in self._known.items() if key in kept}
        self._known.update({names[k]: _Known(one, shown.where(np.arange(len(shown)) == k)) for k, one in sent.items()})
        return objects

    def _send_again(self) -> None:
        self._known = {key: known._replace(body=None) for key, known in self._known.items()}

    def clear(self) -> list[CollisionObject]:
        """Objects that REMOVE all that planners know of."""
        gone, self._known = self._known, {}
        return removals(gone, self._header) if gone else []


def _has_changed(known: SuperquadricArray | None, shown: SuperquadricArray, k: int) -> bool:
    """Return whether the space that a body takes has changed by more than a step since planners were sent it.

    By how far both reach in every direction, the Hausdorff distance of convex bodies: numbers are no measure, as those
    of a round body at rest turn about its axis from frame to frame.
    """
    if known is None:
        return True
    directions = _half_sphere()
    before, now = (
        support(directions @ matrices(unit_quaternions(of.rotation[i])), of.size[i], of.shape[i], of.taper[i])
        for of, i in ((known, 0), (shown, k))
    )
    shift = np.abs(directions @ (shown.translation[k] - known.translation[0]))
    return bool((shift + np.abs(now - before)).max() > 0.002)  # metres: planners' paddings are larger


@cache
def _half_sphere(count: int = 128) -> np.ndarray:
    """Return directions (n, 3) of one half of the sphere, as bodies are symmetric, 13 degrees apart."""
    height, turn = (np.arange(count) + 0.5) / count, np.pi * (1 + np.sqrt(5)) * np.arange(count)
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)


def collision_objects(
    superquadrics: SuperquadricArray, header: Any, *, meshes: Sequence[Mesh] | None = None, prefix: str = PREFIX
) -> list[CollisionObject]:
    """Return one object to ADD for each body that did not fail; one of the same id that is there already is replaced.

    ``header``: std_msgs/Header of the bodies.  ``meshes``: one for each body that did not fail, on its surface and in
    its own frame; they are grown by :func:`~sq_msgs_py.shapes.enclosing_factor`.  None: enclosing primitives.
    ``prefix``: of the ids.  Raises ImportError without moveit_msgs; ValueError if the number of meshes is another, or a
    mesh or body is none.
    """
    from moveit_msgs.msg import CollisionObject

    bodies = superquadrics.recovered
    if meshes is not None and len(meshes) != len(bodies):
        raise ValueError(f"meshes: expected one for each of {len(bodies)} bodies, got {len(meshes)}")
    objects = []
    for k, pose in enumerate(pose_messages(bodies)):
        name = body_name(bodies.id[k], prefix)
        added = CollisionObject(header=header, id=name, pose=pose, operation=CollisionObject.ADD)
        here = Pose(orientation=Quaternion(w=1.0))
        if meshes is None:
            added.primitives, added.primitive_poses = [primitive(bodies.size[k], bodies.shape[k]).message], [here]
        else:
            vertices, faces = meshes[k]
            taper = np.asarray(bodies.taper)[k]
            factor = enclosing_factor(vertices, faces, bodies.size[k], bodies.shape[k], taper)
            added.meshes, added.mesh_poses = [mesh_message(factor * np.asarray(vertices), faces)], [here]
        objects.append(added)
    return objects


def removals(names: Iterable[str], header: Any) -> list[CollisionObject]:
    """Return one object to REMOVE for each name.  Raises ImportError without moveit_msgs; ValueError for an empty name:
    MoveIt would remove every object of the scene."""
    from moveit_msgs.msg import CollisionObject

    names = sorted(names)
    if "" in names:
        raise ValueError("names: expected none to be empty, as MoveIt would remove all objects")
    return [CollisionObject(header=header, id=key, operation=CollisionObject.REMOVE) for key in names]


def planning_scene(objects: Sequence[CollisionObject]) -> PlanningScene:
    """Return the difference that applies the objects and changes nothing else; ImportError without moveit_msgs."""
    from moveit_msgs.msg import PlanningScene

    message = PlanningScene(is_diff=True)
    message.robot_state.is_diff = True
    message.world.collision_objects = list(objects)
    return message
