"""The panel of one session: timeline, layers and view."""

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import viser

from app.viewer.content import Content
from app.viewer.dress import set_theme
from app.viewer.framing import Framing
from app.viewer.guard import Guard
from app.viewer.layers import THEMES, Layers, Theme
from app.viewer.playback import Playback
from physhandi.data.view import View

_OVERVIEW = "Overview"
_SPEEDS = (0.1, 2.0)


class TimelinePanel:
    """Play, scrub, step, speed and loop, with hot keys."""

    def __init__(self, server: viser.ViserServer, playback: Playback, guard: Guard) -> None:
        self._playback = playback
        gui = server.gui
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY, hint="Space")
        self._frame = gui.add_slider(
            "Frame", 0, max(playback.frame_count - 1, 1), 1, 0, hint="Arrow keys step by one frame"
        )
        self._written = 0
        step = gui.add_button_group("Step", ("◀ 1", "1 ▶"), hint="Left and right arrow keys")
        speed = gui.add_slider("Speed", *_SPEEDS, 0.1, 1.0, hint="Sequence seconds per second")
        loop = gui.add_checkbox("Loop", initial_value=True)
        self._speed, self._loop = speed, loop

        self._play.on_click(guard(lambda _: self._toggle()))
        self._frame.on_update(self._scrub)
        step.on_click(guard(lambda event: playback.step(1 if event.target.value == "1 ▶" else -1)))
        speed.on_update(guard.by_user(lambda _: playback.set_speed(speed.value)))
        loop.on_update(guard.by_user(lambda _: playback.set_loop(on=loop.value)))
        commands: tuple[tuple[str, Any, Any, Callable[[], None]], ...] = (
            ("Play or pause", "space", None, self._toggle),
            ("Next frame", "arrowright", None, lambda: playback.step(1)),
            ("Previous frame", "arrowleft", None, lambda: playback.step(-1)),
            ("Ten frames on", "arrowright", "shift", lambda: playback.step(10)),
            ("Ten frames back", "arrowleft", "shift", lambda: playback.step(-10)),
        )
        for label, key, modifier, act in commands:
            command = gui.add_command(label, hotkey=key, modifier=modifier)
            command.on_trigger(guard(lambda _, act=act: act()))

    def show(self, frame: int, *, is_playing: bool) -> None:
        """Follow the clock."""
        # Another value than the last one that was written here is a user's, about to be heard.
        if self._frame.value == self._written:
            self._frame.value = self._written = frame
        label = "Pause" if is_playing else "Play"
        if self._play.label != label:
            self._play.label = label
            self._play.icon = viser.Icon.PLAYER_PAUSE if is_playing else viser.Icon.PLAYER_PLAY

    def replace(self, frame_count: int) -> None:
        """Fit the slider to another sequence."""
        self._frame.value = self._written = 0
        self._frame.max = max(frame_count - 1, 1)

    def restore(self, speed: float, *, does_loop: bool) -> None:
        """Run the clock as it ran in another session."""
        self._speed.value, self._loop.value = speed, does_loop
        self._playback.set_speed(speed)
        self._playback.set_loop(on=does_loop)

    def _toggle(self) -> None:
        self._playback.play(on=not self._playback.is_playing)

    async def _scrub(self, event: Any) -> None:
        # At once, in viser's own thread, so that the running clock has no time to interfere.
        frame = event.target.value
        if event.client is not None:
            self._written = frame
            self._playback.play(on=False)
            self._playback.seek(frame)


class LayersPanel:
    """What is shown, and from where."""

    def __init__(
        self, server: viser.ViserServer, content: Content, guard: Guard, redraw: Callable[[], None]
    ) -> None:
        self._server = server
        self._guard = guard
        self._redraw = redraw
        self._layers = Layers()
        self._switches: dict[str, viser.GuiCheckboxHandle] = {}
        self._views: dict[str, View] = {}
        self._framing: Framing | None = None
        gui = server.gui
        with gui.add_folder("Layers", expand_by_default=content.fitted is None):
            for field, label in (
                ("hands", "Hands"),
                ("nodes", "Object nodes"),
                ("controls", "Control nodes"),
                ("all_controls", "All control nodes"),
                ("virtual_springs", "Virtual springs"),
                ("object_springs", "Object springs"),
                ("forces", "Force arrows"),
                ("observed", "Observed points"),
                ("cameras", "Cameras"),
                ("ground", "Grid"),
            ):
                switch = gui.add_checkbox(label, initial_value=True)
                switch.on_update(guard.by_user(self._switch(field)))
                self._switches[field] = switch
            self._scale = gui.add_slider(
                "Arrow scale", 0.1, 5.0, 0.1, 1.0, hint="Length of the force arrows"
            )
            self._scale.on_update(guard.by_user(self._rescale))
            self._place: Any = gui.add_dropdown("View from", (_OVERVIEW,))
            self._place.on_update(guard.by_user(self._look))
            self._theme = gui.add_dropdown("Background", THEMES)
            self._theme.on_update(guard.by_user(lambda _: self._dress()))
        self._prefers_dark = False

    def replace(self, content: Content, layers: Layers, framing: Framing) -> None:
        """Show the switches that a content needs, as its layers stand."""
        self._layers, self._framing = layers, framing
        layers.dark, layers.force_scale = self._is_dark, self._scale.value
        has_object = content.fitted is not None
        has_control = content.control is not None
        is_there = {
            "hands": bool(content.hands or content.skeletons),
            "nodes": has_object,
            "controls": has_control,
            "all_controls": has_object,
            "virtual_springs": has_object,
            "object_springs": has_object,
            "forces": has_object,
            "observed": content.observed is not None,
            "cameras": bool(content.views),
            "ground": True,
        }
        for field, switch in self._switches.items():
            switch.visible = is_there[field]
            switch.value = getattr(layers, field)
        self._scale.visible = has_object
        self._views = {view.name: view for view in content.views}
        self._place.options = (_OVERVIEW, *self._views)
        self._place.visible = bool(self._views)

    @property
    def theme(self) -> tuple[Theme, bool]:
        """The background that was chosen, and whether the browser asks for a dark one."""
        return self._theme.value, self._prefers_dark

    @property
    def _is_dark(self) -> bool:
        return self._prefers_dark if self._theme.value == THEMES[0] else self._theme.value == "dark"

    def prefer_dark(self, *, on: bool) -> None:
        """Follow the browser, unless a background was chosen."""
        if on != self._prefers_dark:
            self._prefers_dark = on
            self._dress()

    def restore(self, layers: Layers, theme: Theme, *, prefers_dark: bool) -> None:
        """Show what another session shows of the same content."""
        self._theme.value, self._prefers_dark = theme, prefers_dark
        self._scale.value = layers.force_scale
        for field in fields(layers):
            setattr(self._layers, field.name, getattr(layers, field.name))
        for field, switch in self._switches.items():
            switch.value = getattr(layers, field)
        self._place.value = layers.looks_from or _OVERVIEW
        self._dress()

    def _switch(self, field: str) -> Callable[[Any], None]:
        def switch(event: Any) -> None:
            setattr(self._layers, field, event.target.value)
            self._redraw()

        return switch

    def _dress(self) -> None:
        self._layers.dark = self._is_dark
        set_theme(self._server, dark=self._layers.dark)
        self._redraw()

    def _rescale(self, event: Any) -> None:
        self._layers.force_scale = event.target.value
        self._redraw()

    def _look(self, event: Any) -> None:
        framing, eye = self._framing, event.client.camera
        if framing is None:
            return
        view = self._views.get(self._place.value)
        self._layers.looks_from = view.name if view is not None else None
        self._redraw()
        with event.client.atomic():
            if view is None:
                eye.up_direction = (0.0, 0.0, 1.0)
                eye.fov = framing.fov
                eye.position, eye.look_at = framing.camera, framing.look_at
                return
            camera = view.camera
            _, down, ahead, origin = camera.T_world_camera[:3].T
            distance = max(float((framing.center - origin) @ ahead), 0.1 * framing.extent)
            eye.fov = float(2 * np.arctan2(camera.height / 2, camera.K[1, 1]))
            eye.up_direction = -down
            eye.position, eye.look_at = origin, origin + distance * ahead
