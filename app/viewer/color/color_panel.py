"""The panel that chooses the coloring, shows its legend and holds its range."""

import math
import threading
from collections.abc import Callable
from typing import Any

import viser

from app.viewer.color.coloring import Painter
from app.viewer.color.hand_coloring import HandPainter
from app.viewer.color.legend import legend_head, legend_html
from app.viewer.content.content import Content
from app.viewer.content.layers import Coloring, Layers
from app.viewer.ui.followed import FollowedChoice
from app.viewer.ui.guard import Guard
from app.viewer.ui.keyboard import bind

_LIGHTEST, _HEAVIEST = 1e-3, 1e7
"""Ends of what an object may weigh [g]."""


class ColorPanel:
    """A choice, a legend and a range that follows the sequence or is held."""

    def __init__(
        self,
        server: viser.ViserServer,
        guard: Guard,
        redraw: Callable[[], None],
        *,
        color_instead: Callable[[int], bool],
    ) -> None:
        """Add the panel, hidden until there is something to color.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            redraw: Draws the current frame again.
            color_instead: Gives what is shown instead of the scene its next colors, or those
                before; False if it is the scene.
        """
        self._redraw = redraw
        self._color_instead = color_instead
        self._layers = Layers()
        self._painter: Painter | HandPainter | None = None
        self._written = ""
        self._turn = threading.Lock()
        gui = server.gui
        self._folder = gui.add_folder(None, visible=False)
        with self._folder:
            self._choice: Any = gui.add_dropdown(
                "Color by", ("plain",), hint="C: the next one, shift C: the one before"
            )
            self._legend = gui.add_html("")
            self._hold = gui.add_checkbox(
                "Hold range", initial_value=False, hint="Keep the ends when the rollout changes"
            )
            self._range = FollowedChoice(
                gui.add_vector2(
                    "Range", (0.0, 1.0), step=1e-4, hint="Values at the ends; typing holds them"
                ),
                guard,
            )
            self._fit: Any = gui.add_button(
                "Fit range to this frame",
                color="gray",
                hint="Hold the range that nearly all values of this frame lie in",
            )
            self._mass = FollowedChoice(
                gui.add_number(
                    "Mass [g]",
                    1.0,
                    min=_LIGHTEST,
                    max=_HEAVIEST,
                    step=_LIGHTEST,
                    hint="What the object weighs. Forces, stiffness and damping are written for "
                    "it; its motion stays the same",
                ),
                guard,
            )
        self._fit.on_click(guard(lambda _: self._fit_range()))
        self._mass.handle.on_update(guard.by_user(lambda _: self._weigh()))
        self._choice.on_update(guard.by_user(lambda _: self.choose(self._choice.value)))
        self._hold.on_update(guard.by_user(lambda _: self._toggle_hold()))
        self._range.handle.on_update(guard.by_user(lambda _: self._type()))
        bind(server, guard, "color", lambda _, __: self.next(1))
        bind(server, guard, "color_back", lambda _, __: self.next(-1))
        self._show_range_fields()

    def replace(self, content: Content, layers: Layers, painter: Painter | HandPainter) -> None:
        """Offer the colorings of a content."""
        before = self._layers
        self._layers, self._painter = layers, painter
        self._mass.handle.visible = isinstance(painter, Painter) and content.is_metric
        self._folder.visible = self.is_there
        self._choice.options = ("plain", *painter.offered)
        layers.color = before.color if before.color in self._choice.options else "plain"
        layers.color_range = before.color_range if layers.color == before.color else None
        self._follow()

    @property
    def is_there(self) -> bool:
        """Whether there is something to color."""
        return self._painter is not None and bool(self._painter.offered)

    def restore(self) -> None:
        """Show what the layers say now."""
        if self._layers.color not in self._choice.options:
            self._layers.color, self._layers.color_range = "plain", None
        self._follow()

    def choose(self, coloring: Coloring) -> None:
        """Color by another quantity, in the range of its sequence."""
        if coloring != self._layers.color:
            self._layers.color, self._layers.color_range = coloring, None
        self._follow()
        self._redraw()

    def next(self, step: int) -> None:
        """Color by the next quantity of the list, or by one before."""
        if self._color_instead(step):
            return
        options = list(self._choice.options)
        with self._turn:  # Two quick presses are heard in threads of their own.
            if self.is_there:
                at = options.index(self._layers.color)
                self.choose(options[(at + step) % len(options)])

    def show(self, *, is_playing: bool, is_hidden: bool) -> None:
        """Follow what was painted last, or hide while something else is shown."""
        painter = self._painter
        is_shown = self.is_there and not is_hidden
        if self._folder.visible != is_shown:
            self._folder.visible = is_shown
        legend = painter.legend if painter is not None and not is_hidden else None
        if isinstance(painter, Painter):
            self._mass.show(_rounded(1e3 * painter.kilograms))
        written = "" if legend is None else legend_html(legend, highest=not is_playing)
        if is_playing and legend_head(written) == legend_head(self._written):
            return
        if written != self._written:
            self._written = written
            self._legend.content = written
        if legend is None or painter is None:
            return
        factor = painter.quantity(self._layers.color).factor
        low, high = (_rounded(end * factor) for end in legend.scale.limits)
        self._range.show((low, high))

    def _follow(self) -> None:
        self._choice.value = self._layers.color
        self._hold.value = self._layers.color_range is not None
        self._show_range_fields()

    def _show_range_fields(self) -> None:
        is_colored = self._layers.color != "plain"
        self._hold.visible = self._range.handle.visible = self._fit.visible = is_colored
        self._legend.visible = is_colored

    def _toggle_hold(self) -> None:
        legend = self._painter.legend if self._painter is not None else None
        if self._hold.value and legend is not None:
            self._layers.color_range = legend.scale.limits
        else:
            self._layers.color_range = None
        self._redraw()

    def _fit_range(self) -> None:
        """Hold the range of what the frame on the screen shows."""
        legend = self._painter.legend if self._painter is not None else None
        if legend is not None and legend.frame_limits is not None:
            self._layers.color_range = legend.frame_limits
            self._hold.value = True
            self._redraw()

    def _weigh(self) -> None:
        """Take over what a user says the object weighs."""
        grams = float(self._mass.read())
        if _LIGHTEST <= grams <= _HEAVIEST:  # Half-typed numbers wait until they make sense.
            self._layers.mass = 1e-3 * grams
            self._redraw()

    def _type(self) -> None:
        """Take over the ends that a user typed, and hold them."""
        painter = self._painter
        low, high = (float(end) for end in self._range.read())
        if painter is None or self._layers.color == "plain":
            return
        factor = painter.quantity(self._layers.color).factor
        if not (math.isfinite(low) and math.isfinite(high)) or high <= low:
            return  # Half-typed numbers; the scale waits until they make sense.
        self._layers.color_range = (low / factor, high / factor)
        self._hold.value = True
        self._redraw()


def _rounded(value: float) -> float:
    """Keep four digits."""
    return float(f"{value:.4g}")
