"""The scene of the page: measured points, bodies with their uncertainty, the camera, and where one looks from.

World frame: the optical frame of the depth image, metres, y down.  The drawing thread alone calls the methods.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from sq_perception.imaging.camera import Camera
from sq_perception.viewing import drawings
from sq_perception.viewing.drawings import Bodies, Cloud
from sq_perception.viewing.server import PageServer

_UP = (0.0, -1.0, 0.0)
_VIEW_ANGLE = np.deg2rad(42.0)
_BACKGROUND = np.full((2, 2, 3), (22, 24, 28), np.uint8)
_BODY_ALPHA, _FADED_ALPHA, _SHELL_ALPHA = 0.85, 0.2, 0.2
_FRUSTUM = (150, 160, 175)
START, CAMERA = "behind", "camera"
PLACES = {
    START: (1.0, np.array([0.28, -0.38, -1.25])),
    CAMERA: (1.0, np.zeros(3)),
    "above": (0.6, np.array([0.0, -1.7, -0.03])),
    "side": (0.55, np.array([1.6, -0.4, -0.2])),
}
"""Where to look from: at what share of the way to the middle of the scene, and from where, in units of that way."""
_FIRST_DISTANCE = 1.0
"""What the start view looks at, metres, until there is an image."""
_NEAR_SHARE = 0.4
"""Length of the view volume that is drawn, of the nearest depth."""


class Scene:
    """What a server of viser draws in three dimensions.

    Parameters
    ----------
    server
        viser's server.
    has_one_node
        Whether ids alone name the bodies.

    Attributes
    ----------
    camera : Camera or None
        Camera of the last depth image.
    """

    def __init__(self, server: PageServer, has_one_node: bool) -> None:
        self._server, self._has_one_node = server, has_one_node
        self.camera: Camera | None = None
        self._target: np.ndarray | None = None
        self._faces = drawings.mesh_faces()
        self._handles: dict[tuple[str, str], Any] = {}
        """What is drawn, by the node that it is of, empty for the camera, and its path."""
        world = server.scene
        world.set_up_direction(_UP)
        world.configure_default_lights(True, cast_shadow=False)
        world.set_background_image(_BACKGROUND, format="png")
        world.add_frame("/optical_frame", axes_length=0.08, axes_radius=0.002)
        self._set_start_view()

    @property
    def is_aimed(self) -> bool:
        """Whether it is known what to look at."""
        return self._target is not None

    def keep(self, node: str, paths: set[str]) -> None:
        """Remove what is drawn of a node, but for these paths."""
        for key in [key for key in self._handles if key[0] == node and key[1] not in paths]:
            self._handles.pop(key).remove()

    def _put(self, node: str, path: str, add: Callable[..., Any], **state: Any) -> str:
        """Draw something, or give what is drawn there another state; returns the path."""
        handle = self._handles.get((node, path))
        if handle is None:
            self._handles[node, path] = add(path, **state)
        else:
            for name, value in state.items():
                setattr(handle, name, value)
        return path

    def draw_cloud(self, points: Cloud, is_wanted: bool) -> None:
        """Draw the measured points."""
        look = {"point_shape": "circle", "point_shading": "flat", "precision": "float32"}
        add = partial(self._server.scene.add_point_cloud, **look)  # type: ignore[arg-type]
        state = {"points": points.points, "colors": points.colours, "point_size": round(points.point_size, 5)}
        self._put("", "/depth", add, **state, visible=is_wanted)

    def draw_camera(self, camera: Camera, span: tuple[float, float], is_wanted: bool) -> None:
        """Draw what a camera sees up to the nearest depths."""
        self.camera = camera
        lines = drawings.view_volume(camera, max(_NEAR_SHARE * span[0] if camera.is_pinhole else 1.0, 1e-3))
        look: dict[str, Any] = {"colors": _FRUSTUM, "thickness": 1.5, "thickness_units": "screen"}
        self._put("", "/camera", partial(self._server.scene.add_line_segments, **look), points=lines, visible=is_wanted)

    def draw_body(self, node: str, bodies: Bodies, k: int, is_silent: bool, wanted: Callable[[str], bool]) -> set[str]:
        """Surface, label and shell of a body, as far as they are wanted and known; their paths."""
        body, sigma, number = bodies.superquadrics[k], bodies.sigma_size[k], int(bodies.ids[k])
        colour: Any = tuple(round(255 * float(channel)) for channel in bodies.colours[k])
        x, y, z, w = body.rotation
        pose = {"position": body.translation, "wxyz": np.array([w, x, y, z])}
        world, path = self._server.scene, f"/bodies{node}/{number}"
        surface = partial(world.add_mesh_simple, faces=self._faces, color=colour)
        # The same id of two nodes is not the same body.
        title = str(number) if self._has_one_node else f"{node.rsplit('/', 1)[-1]} {number}"
        label = partial(world.add_label, text=title, anchor="bottom-center", font_screen_scale=1.4)
        look = {"opacity": _FADED_ALPHA if is_silent else _BODY_ALPHA, "visible": wanted("Bodies")}
        where = {"position": drawings.label_position(body), "visible": wanted("Ids")}
        paths = {
            self._put(node, f"{path}/surface", surface, vertices=drawings.mesh_vertices(body), **look, **pose),
            self._put(node, f"{path}/id", label, **where),
        }
        around = drawings.shell(body, sigma)
        if around is not None and wanted("Shells"):
            add = partial(surface, opacity=_SHELL_ALPHA, side="front")
            paths.add(self._put(node, f"{path}/shell", add, vertices=drawings.mesh_vertices(around), **pose))
        return paths

    def aim(self, target: np.ndarray) -> None:
        """Let every view look at a point of the scene."""
        self._target = np.asarray(target, dtype=float)
        self._set_start_view()
        for client in self._server.get_clients().values():
            self.look(client.camera, START)

    def _from(self, place: str) -> tuple[np.ndarray, np.ndarray]:
        """Position and target of a name in PLACES."""
        share, offset = PLACES[place]
        middle = np.array([0.0, 0.0, _FIRST_DISTANCE]) if self._target is None else self._target
        return share * middle + float(np.linalg.norm(middle)) * offset, share * middle

    def _set_start_view(self) -> None:
        start = self._server.initial_camera
        start.position, start.look_at = self._from(START)
        start.up, start.fov = _UP, float(_VIEW_ANGLE)

    def look(self, view: Any, place: str) -> None:
        """Let a view look from a place, or as the depth camera does."""
        (position, target), angle, camera = self._from(place), _VIEW_ANGLE, self.camera
        if place == CAMERA and camera is not None and camera.is_pinhole:
            angle = 2 * np.arctan(0.5 * camera.height / camera.fy)
            position, target = np.zeros(3), np.array([0.0, 0.0, _FIRST_DISTANCE])
        elif place == CAMERA:
            position, target = np.array([0.5, 0.5, -1.0]), np.array([0.5, 0.5, 1.0])
        view.up_direction, view.fov = _UP, float(angle)
        view.position, view.look_at = position, target
