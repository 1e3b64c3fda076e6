"""The page: a scene in three dimensions, a column of numbers, and controls for parameters.

World frame of the scene: the optical frame of the depth image, metres, y down.

One thread, the drawing thread, calls the methods; only :attr:`Page.watched` and :meth:`Page.requests` may be called
from others.  What a user does on the page waits in a queue until :meth:`Page.requests` takes it.
"""

from __future__ import annotations

import contextlib
import queue
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from time import monotonic
from typing import Any

import numpy as np
import viser

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera
from sq_perception.viewing import scene, server, tables
from sq_perception.viewing.controls import GROUPS, Control
from sq_perception.viewing.scene import Bodies, Cloud
from sq_perception.viewing.tables import NodeState

TITLE = "sq_perception: superquadrics from depth"
_PANEL_WIDTH = 420
_UP = (0.0, -1.0, 0.0)
_VIEW_ANGLE = np.deg2rad(42.0)
_BACKGROUND = np.full((2, 2, 3), (22, 24, 28), np.uint8)
_BODY_ALPHA, _FADED_ALPHA, _SHELL_ALPHA = 0.85, 0.2, 0.2
_FRUSTUM = (150, 160, 175)
_CAMERA = "camera"
_PLACES = {
    "behind": (1.0, np.array([0.28, -0.38, -1.25])),
    _CAMERA: (1.0, np.zeros(3)),
    "above": (0.6, np.array([0.0, -1.7, -0.03])),
    "side": (0.55, np.array([1.6, -0.4, -0.2])),
}
"""Where to look from: at what share of the way to the middle of the scene, and from where, in units of that way."""
_MUTED = "muted"
_FIRST_DISTANCE = 1.0
"""What the start view looks at, metres, until an image tells."""
_NEAR_SHARE = 0.4
"""Length of the view volume that is drawn, of the nearest depth."""


@dataclass(frozen=True)
class Change:
    """A user wants a parameter of a node to have another value."""

    node: str
    name: str
    value: Any


@dataclass(frozen=True)
class Transition:
    """A user wants a node to go through a lifecycle transition, such as activate."""

    node: str
    label: str


Request = Change | Transition


@dataclass(eq=False)
class _Drawn:
    """The nodes of the scene that belong to one body."""

    surface: Any
    label: Any
    shell: Any = None
    bars: Any = None

    def remove(self) -> None:
        for handle in (self.surface, self.label, self.shell, self.bars):
            if handle is not None:
                handle.remove()


@dataclass(eq=False)
class _Pending:
    """A value that waits for the user to stop typing."""

    value: Any
    due: float


class Page:
    """Serves the page of some nodes on a bound socket.

    Parameters
    ----------
    bound
        Of :func:`sq_perception.viewing.server.listening_socket`.
    nodes
        Fully qualified names.
    most_points
        Of the cloud.
    parameters
        Whether the nodes have any, so that there is a place for them.

    Raises
    ------
    ServerError
        If it cannot be served.
    """

    def __init__(
        self, bound: socket.socket, nodes: Sequence[str], most_points: int = 40000, *, parameters: bool = True
    ) -> None:
        self._most_points = most_points
        self._requests: queue.SimpleQueue[Request] = queue.SimpleQueue()
        self._span: tuple[float, float] | None = None
        self._target: np.ndarray | None = None
        self._aimed_at_bodies = False
        self._camera: Camera | None = None
        self._cloud: Any = None
        self._frustum: Any = None
        self._faces = scene.mesh_faces()
        self._drawn: dict[tuple[str, int], _Drawn] = {}
        self._server = server.serve(bound)
        self._nodes = {name: _NodePart(name) for name in nodes}
        self._furnish(parameters)

    @property
    def watched(self) -> bool:
        """Whether a browser shows the page."""
        return bool(self._server.get_clients())

    @property
    def server(self) -> viser.ViserServer:
        """viser's server."""
        return self._server

    def close(self) -> None:
        """Stop serving; browsers say that the connection is lost."""
        self._server.stop()

    def requests(self) -> list[Request]:
        """What users have asked for since the last call, in order; of several values of a parameter the last."""
        now, ready = monotonic(), []
        with contextlib.suppress(queue.Empty):
            while True:
                ready.append(self._requests.get_nowait())
        changes: list[Request] = list(ready)
        for part in self._nodes.values():
            for name, pending in list(part.pending.items()):
                if now >= pending.due:
                    # A newer value that comes this instant has replaced the entry and stays.
                    if part.pending.get(name) is pending:
                        del part.pending[name]
                    changes.append(Change(part.name, name, pending.value))
        return changes

    # The scene

    def show_depth(self, depth: np.ndarray, camera: Camera) -> None:
        """Draw a depth image (height, width), metres, NaN where nothing was measured: cloud, picture, view volume."""
        span = scene.depth_span(depth)
        if span is not None:
            self._span = scene.steady_span(self._span, span)
        shown = self._span or (0.0, 1.0)
        points = scene.cloud(depth, camera, shown, self._most_points, is_muted=self._point_colours.value == _MUTED)
        with self._server.atomic():
            self._draw_cloud(points)
            self._draw_view_volume(camera, shown)
        if self._picture_wanted.value:
            self._picture.image = scene.picture(depth, shown)
        self._legend.content = tables.legend(shown, "m" if camera.is_pinhole else "")
        if span is not None and self._target is None:
            self._aim(np.median(points.points, axis=0))

    def show_bodies(self, node: str, bodies: Bodies | None, stamp: float, state: NodeState) -> None:
        """Draw the bodies of a node, remove those that are gone, and fill its table.

        ``bodies`` is None while no result came.  They are not drawn if ``state.remark`` says why.
        """
        part = self._nodes[node]
        if bodies is not None and len(bodies) and not state.remark and not self._aimed_at_bodies:
            self._aimed_at_bodies = True
            self._aim(bodies.superquadrics.translation.mean(axis=0))
        is_wanted = part.wanted is None or part.wanted.value
        drawn = bodies if bodies is not None and not state.remark and is_wanted else None
        wanted = {} if drawn is None else {int(number): k for k, number in enumerate(drawn.ids)}
        with self._server.atomic():
            for key in [key for key in self._drawn if key[0] == node and key[1] not in wanted]:
                self._drawn.pop(key).remove()
            if drawn is not None:
                for number, k in wanted.items():
                    self._draw_body(node, number, drawn, k, state.is_silent)
        is_cube = self._camera is not None and not self._camera.is_pinhole
        part.table.content = tables.bodies_table(node, bodies, stamp, state, is_cube=is_cube)

    def show_state(self, state: NodeState) -> None:
        """Write how a node is doing; its lifecycle buttons appear with its state."""
        part = self._nodes[state.name]
        part.status.content = tables.node_status(state)
        possible = _TRANSITIONS.get(state.lifecycle, ())
        for label, button in part.buttons.items():
            button.visible = label in possible

    def show_source(self, text: str) -> None:
        """Write where the depth comes from, as HTML of :mod:`sq_perception.viewing.tables`."""
        self._source.content = text

    # The controls

    def show_controls(self, node: str, controls: Sequence[Control]) -> None:
        """Replace the controls of a node; where only values differ, only these."""
        part = self._nodes[node]
        if [replace(one, value=None) for one in controls] == [
            replace(one, value=None) for one in part.controls.values()
        ]:
            self.show_values(node, {one.name: one.value for one in controls})
            return
        for folder in part.folders:
            folder.remove()
        part.folders, part.handles, part.controls = [], {}, {one.name: one for one in controls}
        part.pending.clear()
        for group, title in GROUPS.items():
            members = [one for one in controls if one.group == group]
            if not members:
                continue
            with part.tab:
                folder = self._server.gui.add_folder(title, expand_by_default=group == "live")
            part.folders.append(folder)
            with folder:
                for one in members:
                    part.handles[one.name] = self._add_control(part, one)

    def show_values(self, node: str, values: Mapping[str, Any]) -> None:
        """Put the node's values into its controls; unknown names are left aside."""
        part = self._nodes[node]
        for name, value in values.items():
            about, handle = part.controls.get(name), part.handles.get(name)
            if about is None or handle is None or name in part.pending:
                continue
            with contextlib.suppress(TypeError, ValueError):
                # A setter runs the callbacks of the control; they are not to take this for the user's wish.
                part.known[name] = about.shown(value)
                handle.value = part.known[name]

    def show_answer(self, node: str, words: str, good: bool) -> None:
        """Write what a node said to a change."""
        self._nodes[node].answer.content = tables.answer(words, good)

    # Furniture

    def _furnish(self, parameters: bool) -> None:
        gui, world = self._server.gui, self._server.scene
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(64, 130, 200))
        gui.set_panel_label(TITLE)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_PANEL_WIDTH)
        world.set_up_direction(_UP)
        world.configure_default_lights(True, cast_shadow=False)
        world.set_background_image(_BACKGROUND, format="png")
        world.add_frame("/optical_frame", axes_length=0.08, axes_radius=0.002)
        self._set_start_view()

        self._source = gui.add_html("")
        for part in self._nodes.values():
            part.status = gui.add_html(tables.node_status(NodeState(part.name)) if parameters else "")
        tabs = gui.add_tab_group()
        for part in self._nodes.values():
            short = part.name.rsplit("/", 1)[-1]
            titles = ("Bodies", "Parameters")
            if len(self._nodes) > 1:
                titles = (short, f"{short}: parameters")
            with tabs.add_tab(titles[0]):
                part.table = gui.add_html("")
            if not parameters:
                continue
            part.tab = tabs.add_tab(titles[1])
            with part.tab:
                part.answer = gui.add_html("")
                for label in ("configure", "activate", "deactivate", "cleanup"):
                    part.buttons[label] = self._add_button(part, label)
        with tabs.add_tab("View"):
            self._furnish_view()
        with gui.add_folder("Depth image"):
            self._picture = gui.add_image(np.full((6, 8, 3), 38, np.uint8), jpeg_quality=85, format="jpeg")
            self._legend = gui.add_html("")

    def _furnish_view(self) -> None:
        gui = self._server.gui
        places = gui.add_button_group("Look from", tuple(_PLACES), hint="Camera: as the depth camera sees it")
        self._points_wanted = gui.add_checkbox("Points", True, hint="The measured depth")
        self._point_colours = gui.add_dropdown("Point colours", (_MUTED, "depth"), initial_value=_MUTED)
        self._bodies_wanted = gui.add_checkbox("Bodies", True)
        self._labels_wanted = gui.add_checkbox("Ids", True)
        self._shells_wanted = gui.add_checkbox(
            "Shells", True, hint=f"The body with half sizes {scene.SHELL_SIGMAS:g} standard deviations larger"
        )
        self._bars_wanted = gui.add_checkbox(
            "Error bars", True, hint=f"± {scene.SHELL_SIGMAS:g} standard deviations of each half size"
        )
        if len(self._nodes) > 1:
            for part in self._nodes.values():
                part.wanted = gui.add_checkbox(part.name, True, hint="The bodies of this node")
        self._volume_wanted = gui.add_checkbox("Camera", True, hint="What the camera sees, and its optical frame")
        self._picture_wanted = gui.add_checkbox("Depth image", True)

        @places.on_click
        def _(event: viser.GuiEvent) -> None:
            if event.client is None:
                return
            if places.value == _CAMERA:
                self._look_through(event.client.camera)
            else:
                self._look(event.client.camera, *self._from(_PLACES[places.value]))

        @self._picture_wanted.on_update
        def _(_: viser.GuiEvent) -> None:
            self._picture.visible = self._picture_wanted.value
            self._legend.visible = self._picture_wanted.value

    def _add_button(self, part: _NodePart, label: str) -> Any:
        button = self._server.gui.add_button(label.capitalize(), visible=False)

        @button.on_click
        def _(_: viser.GuiEvent) -> None:
            self._requests.put(Transition(part.name, label))

        return button

    def _add_control(self, part: _NodePart, about: Control) -> Any:
        gui, value = self._server.gui, about.value
        common: dict[str, Any] = {"hint": about.hint or None}
        part.known[about.name] = value
        if about.kind == "bool":
            handle: Any = gui.add_checkbox(about.name, value, **common)
        elif about.kind == "choice":
            handle = gui.add_dropdown(about.name, about.choices, initial_value=value, **common)
        elif about.kind == "slider":
            handle = gui.add_slider(about.name, about.low, about.high, about.step, value, **common)
        elif about.kind == "number":
            handle = gui.add_number(about.name, value, min=about.low, max=about.high, **common)
        else:
            handle = gui.add_text(about.name, value, disabled=not about.can_change, **common)
        if about.can_change:

            @handle.on_update
            def _(_: viser.GuiEvent) -> None:
                wanted = about.wanted(handle.value)
                if wanted is not None and wanted != part.known.get(about.name):
                    part.pending[about.name] = _Pending(wanted, monotonic() + about.patience)

        return handle

    # Drawing

    def _draw_cloud(self, points: Cloud) -> None:
        if self._cloud is None:
            self._cloud = self._server.scene.add_point_cloud(
                "/depth",
                points.points,
                points.colours,
                point_size=points.point_size,
                point_shape="circle",
                point_shading="flat",
                precision="float32",
            )
        else:
            self._cloud.points, self._cloud.colors = points.points, points.colours
            self._cloud.point_size = round(points.point_size, 5)
        self._cloud.visible = self._points_wanted.value

    def _draw_view_volume(self, camera: Camera, span: tuple[float, float]) -> None:
        if camera != self._camera:
            self._camera = camera
            length = _NEAR_SHARE * span[0] if camera.is_pinhole else 1.0
            lines = scene.view_volume(camera, max(length, 1e-3))
            self._frustum = self._server.scene.add_line_segments(
                "/camera", lines, _FRUSTUM, thickness=1.5, thickness_units="screen"
            )
        if self._frustum is not None:
            self._frustum.visible = self._volume_wanted.value

    def _draw_body(self, node: str, number: int, bodies: Bodies, k: int, is_silent: bool) -> None:
        body = bodies.superquadrics[k]
        red, green, blue = (round(255 * float(channel)) for channel in bodies.colours[k])
        colour = red, green, blue
        x, y, z, w = body.rotation
        pose: dict[str, Any] = {"position": body.translation, "wxyz": np.array([w, x, y, z])}
        vertices = scene.mesh_vertices(body)
        around = scene.shell(body, bodies.sigma_size[k])
        bars = scene.error_bars(body, bodies.sigma_size[k])
        world, path = self._server.scene, f"/bodies{node}/{number}"
        drawn = self._drawn.get((node, number))
        if drawn is None:
            surface = world.add_mesh_simple(
                f"{path}/surface", vertices, self._faces, color=colour, opacity=_BODY_ALPHA, **pose
            )
            label = world.add_label(
                f"{path}/id",
                self._title(node, number),
                position=scene.label_position(body),
                anchor="bottom-center",
                font_screen_scale=1.4,
            )
            drawn = self._drawn[node, number] = _Drawn(surface, label)
        else:
            drawn.surface.vertices = vertices
            drawn.surface.position, drawn.surface.wxyz = pose["position"], pose["wxyz"]
            drawn.label.position = scene.label_position(body)
        drawn.surface.opacity = _FADED_ALPHA if is_silent else _BODY_ALPHA
        drawn.surface.visible = self._bodies_wanted.value
        drawn.label.visible = self._labels_wanted.value
        drawn.shell = self._draw_shell(drawn.shell, f"{path}/shell", around, colour, pose)
        drawn.bars = self._draw_bars(drawn.bars, f"{path}/bars", bars, pose)

    def _title(self, node: str, number: int) -> str:
        """What a label says; the same id of two nodes is not the same body."""
        return str(number) if len(self._nodes) == 1 else f"{node.rsplit('/', 1)[-1]} {number}"

    def _draw_shell(
        self, drawn: Any, path: str, around: Superquadric | None, colour: tuple[int, int, int], pose: dict[str, Any]
    ) -> Any:
        if around is None or not self._shells_wanted.value:
            if drawn is not None:
                drawn.remove()
            return None
        vertices = scene.mesh_vertices(around)
        if drawn is None:
            return self._server.scene.add_mesh_simple(
                path, vertices, self._faces, color=colour, opacity=_SHELL_ALPHA, side="front", **pose
            )
        drawn.vertices, drawn.position, drawn.wxyz = vertices, pose["position"], pose["wxyz"]
        return drawn

    def _draw_bars(self, drawn: Any, path: str, bars: np.ndarray, pose: dict[str, Any]) -> Any:
        if not len(bars) or not self._bars_wanted.value:
            if drawn is not None:
                drawn.remove()
            return None
        if drawn is None:
            return self._server.scene.add_line_segments(
                path, bars, (245, 245, 245), thickness=2.5, thickness_units="screen", **pose
            )
        drawn.points, drawn.position, drawn.wxyz = bars, pose["position"], pose["wxyz"]
        return drawn

    # Views

    def _aim(self, target: np.ndarray) -> None:
        """Let every view look at a point of the scene."""
        self._target = np.asarray(target, dtype=float)
        self._set_start_view()
        for client in self._server.get_clients().values():
            self._look(client.camera, *self._overview())

    def _overview(self) -> tuple[np.ndarray, np.ndarray]:
        """Position and target: from behind the camera, a little above and to the right of its axis."""
        return self._from(_PLACES["behind"])

    def _from(self, place: tuple[float, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Position and target, from an entry of _PLACES."""
        share, offset = place
        middle = np.array([0.0, 0.0, _FIRST_DISTANCE]) if self._target is None else self._target
        return share * middle + float(np.linalg.norm(middle)) * offset, share * middle

    def _set_start_view(self) -> None:
        start = self._server.initial_camera
        start.position, start.look_at = self._overview()
        start.up, start.fov = _UP, float(_VIEW_ANGLE)

    def _look(self, camera: Any, position: np.ndarray, target: np.ndarray, angle: float = float(_VIEW_ANGLE)) -> None:
        camera.up_direction, camera.fov = _UP, angle
        camera.position, camera.look_at = position, target

    def _look_through(self, camera: Any) -> None:
        seen = self._camera
        if seen is None:
            return
        if seen.is_pinhole:
            angle = 2 * np.arctan(0.5 * seen.height / seen.fy)
            self._look(camera, np.zeros(3), np.array([0.0, 0.0, _FIRST_DISTANCE]), float(angle))
        else:
            self._look(camera, np.array([0.5, 0.5, -1.0]), np.array([0.5, 0.5, 1.0]))


class _NodePart:
    """What belongs to one node on the page."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.status: Any = None
        self.table: Any = None
        self.tab: Any = None
        self.answer: Any = None
        self.wanted: Any = None
        self.buttons: dict[str, Any] = {}
        self.folders: list[Any] = []
        self.controls: dict[str, Control] = {}
        self.handles: dict[str, Any] = {}
        self.known: dict[str, Any] = {}
        self.pending: dict[str, _Pending] = {}


_TRANSITIONS: dict[str, tuple[str, ...]] = {
    "unconfigured": ("configure",),
    "inactive": ("activate", "cleanup"),
    "active": ("deactivate",),
}
