"""Everything that lets a session's object be read: colors, legend, clicks and their keys."""

from collections.abc import Callable
from typing import Any

import viser

from app.viewer.color_panel import ColorPanel
from app.viewer.content import Content
from app.viewer.framing import Framing
from app.viewer.guard import Guard
from app.viewer.inspector import Inspector
from app.viewer.keyboard import bind
from app.viewer.scene import Scene
from app.viewer.take import Take


class Inspection:
    """The panels of colors and of what was clicked, and the keys that belong to them."""

    def __init__(
        self,
        server: viser.ViserServer,
        guard: Guard,
        redraw: Callable[[], None],
        *,
        reset_view: Callable[[Any], None],
        snapshot: Callable[[Any], None],
    ) -> None:
        """Add the panels where the caller stands.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            redraw: Draws the current frame again.
            reset_view: Puts the camera of the client of an event back.
            snapshot: Saves a picture for the client of an event.
        """
        self.colors = ColorPanel(server, guard, redraw)
        self.inspector = Inspector(server, guard, redraw)
        self._redraw = redraw
        bind(server, guard, "reset", lambda event, _: reset_view(event))
        bind(server, guard, "snapshot", lambda event, _: snapshot(event))
        bind(server, guard, "clear", lambda _, __: self._clear())

    def replace(self, content: Content, scene: Scene, framing: Framing) -> None:
        """Get ready for another content."""
        painter = scene.painter if content.fitted is not None else scene.hand_painter
        self.colors.replace(content, scene.layers, painter)
        self.inspector.replace(content, scene, framing)

    def show(
        self, take: Take | None, frame: int, take_frame: int, *, is_playing: bool, is_hidden: bool
    ) -> None:
        """Follow the clock; see `Inspector.show`."""
        self.colors.show(is_playing=is_playing, is_hidden=is_hidden)
        self.inspector.show(take, frame, take_frame, is_playing=is_playing, is_hidden=is_hidden)

    def _clear(self) -> None:
        self.inspector.clear()
        self._redraw()
