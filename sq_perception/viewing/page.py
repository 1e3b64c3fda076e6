"""The page: a scene in three dimensions, a column of numbers, and controls for parameters.

World frame of the scene: the optical frame of the depth image, metres, y down.

One thread, the drawing thread, calls the methods; only :attr:`Page.watched` and :meth:`Page.requests` may be called
from others.  What a user does on the page waits in a queue until :meth:`Page.requests` takes it.
"""

from __future__ import annotations

import contextlib
import queue
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from time import monotonic
from typing import Any

import numpy as np
import viser

from sq_perception.imaging.camera import Camera
from sq_perception.viewing import drawings, server, tables
from sq_perception.viewing.controls import GROUPS, Control
from sq_perception.viewing.drawings import Bodies, Cloud
from sq_perception.viewing.tables import NodeState

TITLE = "sq_perception: superquadrics from depth"
_PANEL_WIDTH = 420
_UP = (0.0, -1.0, 0.0)
_VIEW_ANGLE = np.deg2rad(42.0)
_BACKGROUND = np.full((2, 2, 3), (22, 24, 28), np.uint8)
_BODY_ALPHA, _FADED_ALPHA, _SHELL_ALPHA = 0.85, 0.2, 0.2
_FRUSTUM, _BARS = (150, 160, 175), (245, 245, 245)
_START, _CAMERA = "behind", "camera"
_PLACES = {
    _START: (1.0, np.array([0.28, -0.38, -1.25])),
    _CAMERA: (1.0, np.zeros(3)),
    "above": (0.6, np.array([0.0, -1.7, -0.03])),
    "side": (0.55, np.array([1.6, -0.4, -0.2])),
}
"""Where to look from: at what share of the way to the middle of the scene, and from where, in units of that way."""
_MUTED = "muted"
_SHOWN = {
    "Points": "The measured depth",
    "Bodies": None,
    "Ids": None,
    "Shells": f"The body with half sizes {drawings.SHELL_SIGMAS:g} standard deviations larger",
    "Error bars": f"± {drawings.SHELL_SIGMAS:g} standard deviations of each half size",
    "Camera": "What the camera sees, and its optical frame",
    "Depth image": None,
}
"""Check boxes of what is drawn, with their hints."""
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
        self._faces = drawings.mesh_faces()
        self._handles: dict[tuple[str, str], Any] = {}
        """What is drawn, by the node that it is of, empty for the camera, and its path."""
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
        span = drawings.depth_span(depth)
        if span is not None:
            self._span = drawings.steady_span(self._span, span)
        shown = self._span or (0.0, 1.0)
        points = drawings.cloud(depth, camera, shown, self._most_points, is_muted=self._point_colours.value == _MUTED)
        with self._server.atomic():
            self._draw_cloud(points)
            self._draw_view_volume(camera, shown)
        if self._wanted["Depth image"].value:
            self._picture.image = drawings.picture(depth, shown)
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
        with self._server.atomic():
            kept: set[str] = set()
            for k in range(len(drawn) if drawn is not None else 0):
                assert drawn is not None
                kept |= self._draw_body(node, drawn, k, state.is_silent)
            for key in [key for key in self._handles if key[0] == node and key[1] not in kept]:
                self._handles.pop(key).remove()
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
        self._point_colours = gui.add_dropdown("Point colours", (_MUTED, "depth"), initial_value=_MUTED)
        self._wanted = {name: gui.add_checkbox(name, True, hint=hint) for name, hint in _SHOWN.items()}
        if len(self._nodes) > 1:
            for part in self._nodes.values():
                part.wanted = gui.add_checkbox(part.name, True, hint="The bodies of this node")

        @places.on_click
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None and (places.value != _CAMERA or self._camera is not None):
                self._look(event.client.camera, places.value)

        @self._wanted["Depth image"].on_update
        def _(_: viser.GuiEvent) -> None:
            self._picture.visible = self._wanted["Depth image"].value
            self._legend.visible = self._wanted["Depth image"].value

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

    def _put(self, node: str, path: str, add: Callable[..., Any], **state: Any) -> str:
        """Draw something, or give what is drawn there another state; returns the path."""
        handle = self._handles.get((node, path))
        if handle is None:
            self._handles[node, path] = add(path, **state)
        else:
            for name, value in state.items():
                setattr(handle, name, value)
        return path

    def _draw_cloud(self, points: Cloud) -> None:
        look = {"point_shape": "circle", "point_shading": "flat", "precision": "float32"}
        add = partial(self._server.scene.add_point_cloud, **look)  # type: ignore[arg-type]
        state = {"points": points.points, "colors": points.colours, "point_size": round(points.point_size, 5)}
        self._put("", "/depth", add, **state, visible=self._wanted["Points"].value)

    def _draw_view_volume(self, camera: Camera, span: tuple[float, float]) -> None:
        length = max(_NEAR_SHARE * span[0] if camera.is_pinhole else 1.0, 1e-3)
        state: dict[str, Any] = {"visible": self._wanted["Camera"].value}
        if camera != self._camera:
            self._camera, state["points"] = camera, drawings.view_volume(camera, length)
        self._put("", "/camera", partial(self._add_lines, _FRUSTUM, 1.5), **state)

    def _add_lines(self, colour: tuple[int, int, int], width: float, path: str, **state: Any) -> Any:
        look: dict[str, Any] = {"colors": colour, "thickness": width, "thickness_units": "screen"}
        return self._server.scene.add_line_segments(path, **look, **state)

    def _draw_body(self, node: str, bodies: Bodies, k: int, is_silent: bool) -> set[str]:
        """Surface, label, shell and error bars of a body, as far as they are wanted and known; their paths."""
        body, sigma, number = bodies.superquadrics[k], bodies.sigma_size[k], int(bodies.ids[k])
        colour: Any = tuple(round(255 * float(channel)) for channel in bodies.colours[k])
        x, y, z, w = body.rotation
        pose = {"position": body.translation, "wxyz": np.array([w, x, y, z])}
        world, path = self._server.scene, f"/bodies{node}/{number}"
        surface = partial(world.add_mesh_simple, faces=self._faces, color=colour)
        # The same id of two nodes is not the same body.
        title = str(number) if len(self._nodes) == 1 else f"{node.rsplit('/', 1)[-1]} {number}"
        label = partial(world.add_label, text=title, anchor="bottom-center", font_screen_scale=1.4)
        look = {"opacity": _FADED_ALPHA if is_silent else _BODY_ALPHA, "visible": self._wanted["Bodies"].value}
        where = {"position": drawings.label_position(body), "visible": self._wanted["Ids"].value}
        paths = {
            self._put(node, f"{path}/surface", surface, vertices=drawings.mesh_vertices(body), **look, **pose),
            self._put(node, f"{path}/id", label, **where),
        }
        around, bars = drawings.shell(body, sigma), drawings.error_bars(body, sigma)
        if around is not None and self._wanted["Shells"].value:
            add = partial(surface, opacity=_SHELL_ALPHA, side="front")
            paths.add(self._put(node, f"{path}/shell", add, vertices=drawings.mesh_vertices(around), **pose))
        if len(bars) and self._wanted["Error bars"].value:
            paths.add(self._put(node, f"{path}/bars", partial(self._add_lines, _BARS, 2.5), points=bars, **pose))
        return paths

    # Views

    def _aim(self, target: np.ndarray) -> None:
        """Let every view look at a point of the scene."""
        self._target = np.asarray(target, dtype=float)
        self._set_start_view()
        for client in self._server.get_clients().values():
            self._look(client.camera, _START)

    def _from(self, place: str) -> tuple[np.ndarray, np.ndarray]:
        """Position and target of a name in _PLACES."""
        share, offset = _PLACES[place]
        middle = np.array([0.0, 0.0, _FIRST_DISTANCE]) if self._target is None else self._target
        return share * middle + float(np.linalg.norm(middle)) * offset, share * middle

    def _set_start_view(self) -> None:
        start = self._server.initial_camera
        start.position, start.look_at = self._from(_START)
        start.up, start.fov = _UP, float(_VIEW_ANGLE)

    def _look(self, view: Any, place: str) -> None:
        """Let a view look from a place, or as the depth camera does."""
        (position, target), angle, camera = self._from(place), _VIEW_ANGLE, self._camera
        if place == _CAMERA and camera is not None and camera.is_pinhole:
            angle = 2 * np.arctan(0.5 * camera.height / camera.fy)
            position, target = np.zeros(3), np.array([0.0, 0.0, _FIRST_DISTANCE])
        elif place == _CAMERA:
            position, target = np.array([0.5, 0.5, -1.0]), np.array([0.5, 0.5, 1.0])
        view.up_direction, view.fov = _UP, float(angle)
        view.position, view.look_at = position, target


@dataclass(eq=False)
class _NodePart:
    """What belongs to one node on the page."""

    name: str
    status: Any = None
    table: Any = None
    tab: Any = None
    answer: Any = None
    wanted: Any = None
    buttons: dict[str, Any] = field(default_factory=dict)
    folders: list[Any] = field(default_factory=list)
    controls: dict[str, Control] = field(default_factory=dict)
    handles: dict[str, Any] = field(default_factory=dict)
    known: dict[str, Any] = field(default_factory=dict)
    pending: dict[str, _Pending] = field(default_factory=dict)


_TRANSITIONS: dict[str, tuple[str, ...]] = {
    "unconfigured": ("configure",),
    "inactive": ("activate", "cleanup"),
    "active": ("deactivate",),
}
