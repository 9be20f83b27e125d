"""Reads what was clicked: its values now, one of them over all frames, and a mark in the scene."""

import dataclasses
import html
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from jaxtyping import Float
from numpy import ndarray

from app.viewer.content.content import Content
from app.viewer.inspect.picking import Pick, Ray, Target, pick, pick_dot
from app.viewer.inspect.readings import HISTORIES, HistoryQuantity, Readings, Rows, follow, unit_of
from app.viewer.scene.framing import Framing
from app.viewer.scene.nodes import SceneNodes
from app.viewer.scene.scene import SceneDrawing
from app.viewer.ui.guard import Guard
from app.viewer.ui.keyboard import bind
from app.viewer.ui.plot import FramePlot, PlotCurve
from physhandi.object_rollout import ObjectRollout

MARK = (233, 30, 180)
"""Color of what was clicked, which no scale has."""
_REFRESH = 0.25
_LINE, _NOW = "rgb(47,111,222)", "rgba(233,30,180,0.9)"
_NONE = '<div style="font-size:0.8em;padding:0 0.9em 0.4em;opacity:0.8">Click {} to read it.</div>'


def clickable(content: Content) -> str:
    """Name what can be clicked in a content; empty if there is nothing."""
    has_object = content.fitted is not None
    things = ["a node", "a spring"] if has_object else []
    if not has_object and content.control is not None:
        things.append("a control point" if content.markers is None else "a gripper")
    if content.markers is not None:
        things.append("a marker")
    if content.hands:
        things.append("the hand")
    return " or ".join([", ".join(things[:-1]), things[-1]] if len(things) > 1 else things)


TakeClick = Callable[[viser.SceneClickEvent, int | None, int | None], None]
"""Takes a click, and the number of the node or that of the spring under it, if there is one."""


class Inspector:
    """The panel of the thing that was clicked; clicks and the clock come in different threads."""

    def __init__(
        self,
        server: viser.ViserServer,
        guard: Guard,
        redraw: Callable[[], None],
        *,
        open_tab: Callable[[], None] = lambda: None,
        instead: Callable[[], TakeClick | None] = lambda: None,
    ) -> None:
        """Add the panel, which says what to do until something is clicked.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            redraw: Draws the current frame again.
            open_tab: Brings the panel into sight.
            instead: Finds what takes clicks in the place of this panel, if anything does now.
        """
        self._instead = instead
        self._server = server
        self._redraw = redraw
        self._open_tab = open_tab
        self._lock = threading.RLock()
        self._nodes = SceneNodes(server)
        self._content: Content | None = None
        self._scene: SceneDrawing | None = None
        self._readings: Readings | None = None
        self._framing: Framing | None = None
        self._pick: Pick | None = None
        self._shown: tuple[ObjectRollout | None, int, int] = (None, 0, 0)
        self._grab: Callable[[int], None] | None = None
        self._dots: tuple[Float[ndarray, "dot 3"], Callable[[int], None]] | None = None
        self._measured: tuple[Any, ...] | None = None
        self._curve: Float[ndarray, " frame"] = np.zeros(0)
        self._refreshed = 0.0
        self._invitation = ""
        gui = server.gui
        self._folder = gui.add_folder(None)
        with self._folder:
            self._text = gui.add_html("")
            self._kind: Any = gui.add_dropdown("History of", ("speed",), visible=False)
            self._plot: FramePlot | None = None
            self._clear = gui.add_button("Clear", color="gray", hint="Esc", visible=False)
        self._kind.on_update(guard.by_user(lambda _: self._choose_history()))
        self._clear.on_click(guard(lambda _: self.clear()))
        bind(server, guard, "clear", lambda _, __: self.clear())
        server.scene.on_click()(guard(lambda event: self._click(event, prefers_hand=False)))
        server.scene.on_click(modifier="shift")(
            guard(lambda event: self._click(event, prefers_hand=True))
        )

    @property
    def pick(self) -> Pick | None:
        """The clicked thing."""
        return self._pick

    def replace(self, content: Content, scene: SceneDrawing, framing: Framing) -> None:
        """Get ready for another content."""
        with self._lock:
            things = clickable(content)
            self._folder.visible = bool(things)
            self._invitation = _NONE.format(things)
            self.clear()
            self._content, self._scene, self._framing = content, scene, framing
            self._readings = Readings(content, scene.painter)

    def clear(self) -> None:
        """Forget what was clicked."""
        with self._lock:
            self._pick = None
            self._nodes.clear()
            self._text.content = self._invitation
            self._kind.visible = self._clear.visible = False
            self._remove_plot()

    def rest(
        self,
        rollout: ObjectRollout,
        rollout_frame: int,
        grab: Callable[[int], None],
        dots: Float[ndarray, "dot 3"],
        choose_dot: Callable[[int], None],
    ) -> None:
        """Read nothing until the clock shows a frame again, because hands are being steered.

        Args:
            rollout: The object that is drawn.
            rollout_frame: Which of its frames.
            grab: Called with a node of it that is clicked, in the place of reading that.
            dots: Where there are dots that are clicked first [m].
            choose_dot: Called with the number of one that is clicked.
        """
        with self._lock:
            if self._pick is not None:
                self.clear()
            self._shown, self._grab = (rollout, 0, rollout_frame), grab
            self._dots = dots, choose_dot

    def look_at(self, thing: Pick | None) -> None:
        """Read a thing, or nothing."""
        with self._lock:
            if thing is None or self._readings is None:
                self.clear()
                return
            self._pick = self._readings.settle(thing)
            options = HISTORIES[self._pick.kind]
            color = self._scene.layers.color if self._scene is not None else "plain"
            before = self._kind.value
            self._kind.options = options
            wanted = color if color in options else before
            self._kind.value = wanted if wanted in options else options[0]
            self._kind.visible = self._clear.visible = True
            self._measured = None
            self._remove_plot()
        self._redraw()

    def show(
        self,
        rollout: ObjectRollout | None,
        frame: int,
        rollout_frame: int,
        *,
        is_playing: bool,
        is_hidden: bool,
    ) -> None:
        """Follow the clock.

        Args:
            rollout: The rollout that is drawn.
            frame: Frame of the hands.
            rollout_frame: Frame of the rollout.
            is_playing: Whether the clock is running, so that less may be sent.
            is_hidden: Whether something else is shown instead of the scene.
        """
        with self._lock:
            self._shown, self._grab = (rollout, frame, rollout_frame), None
            self._dots = None
            chosen, readings = self._pick, self._readings
            if chosen is None or readings is None:
                return
            if not readings.exists(chosen, rollout):
                self.clear()
                return
            self._mark(chosen, readings, rollout, frame, rollout_frame, is_hidden=is_hidden)
            now = time.monotonic()
            if is_playing and now - self._refreshed < _REFRESH:
                return
            self._refreshed = now
            title = readings.title(chosen, rollout)
            rows = readings.rows(chosen, rollout, frame, rollout_frame)
            self._text.content = _table(title, rows)
            self._draw_history(chosen, rollout, rollout_frame if chosen.kind != "hand" else frame)

    def _click(self, event: viser.SceneClickEvent, *, prefers_hand: bool) -> None:
        camera = event.client.camera
        ray = Ray(
            origin=np.asarray(event.ray_origin, dtype=np.float64),
            direction=np.asarray(event.ray_direction, dtype=np.float64),
            pixel=float(camera.fov) / max(int(camera.image_height), 1),
        )
        with self._lock:
            dots = self._dots
        if dots is not None:
            dot = pick_dot(ray, dots[0])
            if dot is not None:
                dots[1](dot)
                return
        with self._lock:
            content, scene, framing = self._content, self._scene, self._framing
            if content is None or scene is None or framing is None:
                return
            rollout, frame, rollout_frame = self._shown
            grab, take = self._grab, self._instead()
            if grab is not None or take is not None:
                # They are not where they were, or in the way.
                content = dataclasses.replace(content, hands=())
            target = Target(
                content=content,
                rollout=rollout,
                frame=frame,
                rollout_frame=rollout_frame,
                layers=scene.layers,
                spacing=framing.spacing,
            )
            thing = pick(ray, target, prefers_hand=prefers_hand)
        if take is not None:
            numbers = {} if thing is None else {thing.kind: thing.index}
            take(event, numbers.get("node"), numbers.get("spring"))
        elif thing is not None and grab is not None and rollout is not None:
            if thing.kind == "node":
                grab(thing.index)
            elif thing.kind == "spring":  # An end that is a control node has the higher number.
                grab(int(rollout.model.spring_nodes[thing.index].min()))
        elif thing is not None:
            self.look_at(thing)
            self._open_tab()

    def _mark(
        self,
        chosen: Pick,
        readings: Readings,
        rollout: ObjectRollout | None,
        frame: int,
        rollout_frame: int,
        *,
        is_hidden: bool,
    ) -> None:
        """Mark the thing in the scene, with the virtual springs that hold it."""
        framing = self._framing
        if framing is None:
            return
        place = readings.place(chosen, rollout, frame, rollout_frame)
        links = readings.links(chosen, rollout, rollout_frame)
        size = 1.6 if rollout is None and chosen.kind != "hand" else 0.46
        with self._server.atomic():
            self._nodes.points(
                "/picked/point", place, MARK, size * framing.spacing, is_visible=not is_hidden
            )
            self._nodes.segments("/picked/links", links, MARK, 3.0, is_visible=not is_hidden)
            name = readings.title(chosen, rollout).partition(" (")[0]
            if is_hidden:
                self._nodes.show("/picked/name", is_visible=False)
                return
            above = place.mean(axis=0) + np.array([0.0, 0.0, 0.9 * framing.spacing])
            self._nodes.label(
                "/picked/name",
                name,
                above,
                anchor="bottom-center",
                height=0.02 * framing.extent,
            )

    def _choose_history(self) -> None:
        self._measured = None
        with self._lock:
            self._remove_plot()
        self._redraw()

    def _draw_history(self, chosen: Pick, rollout: ObjectRollout | None, frame: int) -> None:
        """Bring the curve to what is simulated, and its mark to the frame on the screen."""
        content, scene = self._content, self._scene
        if content is None or scene is None:
            return
        kind: HistoryQuantity = self._kind.value
        unit, factor = unit_of(kind, content, scene.painter)
        state = (
            chosen,
            kind,
            rollout,
            rollout.ready if rollout is not None else 0,
            scene.painter.reference,
            factor,
        )
        if state != self._measured:
            self._curve = factor * follow(chosen, kind, rollout, content, scene.painter)
            self._measured = state
        if self._plot is None:
            with self._folder:
                self._plot = FramePlot(
                    self._server.gui,
                    (PlotCurve(label=kind, color=_LINE),),
                    frame_count=content.frame_count,
                    unit=unit,
                    quantity=kind,
                    mark_color=_NOW,
                    starts_at_zero=False,
                    height=90,
                    order=self._kind.order + 0.1,
                )
        self._plot.show((self._curve,), frame)

    def _remove_plot(self) -> None:
        if self._plot is not None:
            self._plot.remove()
            self._plot = None


def _table(title: str, rows: Rows) -> str:
    """Lay out names and values; all text is the program's, and escaped all the same."""
    lines = "".join(
        '<tr><td style="opacity:0.75;padding:0 0.8em 0 0;vertical-align:top;white-space:nowrap">'
        f'{html.escape(name)}</td><td style="padding:0;font-variant-numeric:tabular-nums">'
        f"{html.escape(value)}</td></tr>"
        for name, value in rows
    )
    color = "rgb({},{},{})".format(*MARK)
    return (
        '<div style="font-size:0.8em;line-height:1.25;padding:0 0.9em 0.4em" data-reading>'
        f'<b><span style="color:{color}">●</span> {html.escape(title)}</b>'
        f"<table>{lines}</table></div>"
    )
