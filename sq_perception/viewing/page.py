"""The page: a scene in three dimensions (:mod:`~sq_perception.viewing.scene`), numbers, and controls for parameters.

One thread, the drawing thread, calls the methods; only :attr:`Page.watched` and :meth:`Page.changes` may be called from
others.  What a user does on the page waits until :meth:`Page.changes` takes it.
"""

from __future__ import annotations

import socket
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from time import monotonic
from typing import Any

import numpy as np
import viser

from sq_perception.imaging.camera import Camera
from sq_perception.viewing import drawings, scene, server, tables
from sq_perception.viewing.controls import Control
from sq_perception.viewing.drawings import Bodies
from sq_perception.viewing.scene import Scene
from sq_perception.viewing.tables import NodeState

TITLE = "sq_perception: superquadrics from depth"
_PANEL_WIDTH = 420
_DECIMALS = 7
"""Decimals of a number that is shown or typed; viser would cut off those that the value at the beginning has not."""
_TYPING = 0.8
"""Seconds without another change after which the typing of a value has ended."""
_SHOWN = {
    "Points": "The measured depth",
    "Bodies": None,
    "Ids": None,
    "Shells": f"The body with half sizes {drawings.SHELL_SIGMAS:g} standard deviations larger",
    "Camera": "What the camera sees, and its optical frame",
    "Depth image": None,
}
"""Check boxes of what is drawn, with their hints."""


@dataclass(frozen=True)
class Change:
    """A user wants a parameter of a node to have another value."""

    node: str
    name: str
    value: Any


class Page:
    """Serves the page of some nodes on a bound socket.

    Parameters
    ----------
    bound
        A socket of :func:`sq_perception.viewing.server.listening_socket`.
    nodes
        Fully qualified names.
    most_points
        The most points of the cloud that are drawn.
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
        self._span: tuple[float, float] | None = None
        self._aimed_at_bodies = False
        self.server = server.serve(bound)
        """viser's."""
        self._scene = Scene(self.server, has_one_node=len(nodes) == 1)
        self._nodes = {name: _NodePart(name) for name in nodes}
        self._add_widgets(parameters)

    @property
    def watched(self) -> bool:
        """Whether a browser shows the page."""
        return bool(self.server.get_clients())

    def close(self) -> None:
        """Stop serving; browsers show that the connection is lost."""
        self.server.stop()

    def changes(self) -> list[Change]:
        """What users have asked for since the last call; of several values of a parameter the last."""
        now = monotonic()
        wanted = []
        for part in self._nodes.values():
            for name, pending in list(part.pending.items()):
                value, due = pending
                if now >= due:
                    # A newer value that comes this instant has replaced the entry and stays.
                    if part.pending.get(name) is pending:
                        del part.pending[name]
                    wanted.append(Change(part.name, name, value))
        return wanted

    # The scene

    def show_depth(self, depth: np.ndarray, camera: Camera) -> None:
        """Draw a depth image (height, width), metres, NaN where nothing was measured: cloud, picture, view volume."""
        span = drawings.depth_span(depth)
        if span is not None:
            self._span = drawings.steady_span(self._span, span)
        shown = self._span or (0.0, 1.0)
        points = drawings.cloud(depth, camera, shown, self._most_points)
        with self.server.atomic():
            self._scene.draw_cloud(points, self._is_wanted("Points"))
            self._scene.draw_camera(camera, shown, self._is_wanted("Camera"))
        if self._is_wanted("Depth image"):
            self._picture.image = drawings.picture(depth, shown)
        self._legend.content = tables.legend(shown, "m" if camera.is_pinhole else "")
        if span is not None and not self._scene.is_aimed:
            self._scene.aim(np.median(points.points, axis=0))

    def show_bodies(self, bodies: Bodies | None, state: NodeState) -> None:
        """Draw the bodies of a node, remove those that are gone, fill its table, and write how it is doing.

        ``bodies`` is None while no result came, and where it cannot be drawn, for the reason in ``state.remark``.
        """
        part = self._nodes[state.name]
        if bodies is not None and len(bodies) and not self._aimed_at_bodies:
            self._aimed_at_bodies = True
            self._scene.aim(bodies.superquadrics.translation.mean(axis=0))
        with self.server.atomic():
            kept: set[str] = set()
            if bodies is not None and (part.wanted is None or part.wanted.value):
                for k in range(len(bodies)):
                    kept |= self._scene.draw_body(state.name, bodies, k, state.is_silent, self._is_wanted)
            self._scene.keep(state.name, kept)
        is_cube = self._scene.camera is not None and not self._scene.camera.is_pinhole
        part.table.content = tables.bodies_table(bodies, state, is_cube=is_cube)
        if part.status is not None:
            part.status.content = tables.node_status(state)

    def show_source(self, text: str) -> None:
        """Write where the depth comes from, as HTML of :mod:`sq_perception.viewing.tables`."""
        self._source.content = text

    # The controls

    def show_controls(self, node: str, controls: Sequence[Control]) -> None:
        """Replace the controls of a node; where only values differ, only these."""
        part = self._nodes[node]
        if [replace(control, value=None) for control in controls] == [
            replace(control, value=None) for control in part.controls.values()
        ]:
            self._show_values(part, controls)
            return
        for handle in part.handles.values():
            handle.remove()
        part.controls = {control.name: control for control in controls}
        part.pending.clear()
        with part.tab:
            part.handles = {control.name: self._add_control(part, control) for control in controls}

    def _show_values(self, part: _NodePart, controls: Sequence[Control]) -> None:
        """Put the node's values into its controls, but for one that a user is changing."""
        for control in controls:
            if control.name not in part.pending:
                # A setter runs the callbacks of the control; they are not to take this for a change by the user.
                part.known[control.name] = control.value
                part.handles[control.name].value = control.value

    def show_answer(self, node: str, text: str, good: bool) -> None:
        """Show the answer of a node to a change."""
        self._nodes[node].answer.content = tables.answer(text, good)

    # Widgets

    def _add_widgets(self, parameters: bool) -> None:
        gui = self.server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(64, 130, 200))
        gui.set_panel_label(TITLE)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_PANEL_WIDTH)

        self._source = gui.add_html("")
        for part in self._nodes.values() if parameters else ():
            part.status = gui.add_html(tables.node_status(NodeState(part.name)))
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
        with tabs.add_tab("View"):
            self._add_view_controls()
        with gui.add_folder("Depth image"):
            self._picture = gui.add_image(np.full((6, 8, 3), 38, np.uint8), jpeg_quality=85, format="jpeg")
            self._legend = gui.add_html("")

    def _add_view_controls(self) -> None:
        gui = self.server.gui
        places = gui.add_button_group("Look from", tuple(scene.PLACES), hint="Camera: as the depth camera sees it")
        self._wanted = {name: gui.add_checkbox(name, True, hint=hint) for name, hint in _SHOWN.items()}
        if len(self._nodes) > 1:
            for part in self._nodes.values():
                part.wanted = gui.add_checkbox(part.name, True, hint="The bodies of this node")

        @places.on_click
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None and (places.value != scene.CAMERA or self._scene.camera is not None):
                self._scene.look(event.client.camera, places.value)

        @self._wanted["Depth image"].on_update
        def _(_: viser.GuiEvent) -> None:
            self._picture.visible = self._legend.visible = self._is_wanted("Depth image")

    def _is_wanted(self, what: str) -> bool:
        return bool(self._wanted[what].value)

    def _add_control(self, part: _NodePart, about: Control) -> Any:
        gui, value = self.server.gui, about.value
        common: dict[str, Any] = {"hint": about.hint or None}
        part.known[about.name] = value
        if about.kind == "bool":
            handle: Any = gui.add_checkbox(about.name, value, **common)
        elif about.kind == "choice":
            handle = gui.add_dropdown(about.name, about.choices, initial_value=value, **common)
        elif about.kind == "number":
            handle = gui.add_number(about.name, value, min=about.low, max=about.high, **common)
            if about.type is float:
                handle.precision = _DECIMALS
        else:
            handle = gui.add_text(about.name, value, **common)

        @handle.on_update
        def _(_: viser.GuiEvent) -> None:
            wanted = about.wanted(handle.value)
            if wanted is not None and wanted != part.known.get(about.name):
                is_typed = about.kind in ("text", "number")
                part.pending[about.name] = wanted, monotonic() + (_TYPING if is_typed else 0.0)

        return handle


@dataclass(eq=False)
class _NodePart:
    """What belongs to one node on the page."""

    name: str
    status: Any = None
    table: Any = None
    tab: Any = None
    answer: Any = None
    wanted: Any = None
    controls: dict[str, Control] = field(default_factory=dict)
    handles: dict[str, Any] = field(default_factory=dict)
    known: dict[str, Any] = field(default_factory=dict)
    pending: dict[str, tuple[Any, float]] = field(default_factory=dict)
    """Values that wait for the user to stop typing, and when they are sent."""
