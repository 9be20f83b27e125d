"""The panel of a comparison: how both are shown, what the colors mean, and the difference."""

import threading
from collections.abc import Callable
from html import escape
from typing import Any

import viser

from app.viewer.color.legend import Legend, legend_html, swatches_html
from app.viewer.compare.curve import DifferenceCurve
from app.viewer.compare.drawing import (
    FIGURE_STYLE,
    MODES,
    STYLES,
    TINTS,
    Look,
    difference_scale,
)
from app.viewer.compare.request import Mode
from app.viewer.compare.sides import SIDE_KEYS
from app.viewer.ui.guard import Guard, without_markup
from app.viewer.ui.keyboard import bind
from app.viewer.ui.plot import FramePlot, PlotCurve, rounded_up

_STYLE = "font-size:0.8em;line-height:1.5;padding:0 0.6em"
_MEAN, _LARGEST = "rgb(132,94,194)", "rgb(200,70,120)"
_NOW = "rgba(120,130,145,0.9)"
_CURVES = (PlotCurve(label="mean", color=_MEAN), PlotCurve(label="max", color=_LARGEST))
_COMPARED = {
    "nodes": "Each node of A from the same node of B.",
    "surface": "Each node from the other's surface: A and B are made of different nodes.",
}


class ComparePanel:
    """Switches of the look, the legend, and the difference at every tick as a plot.

    Clock, measuring and users write from threads of their own.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        guard: Guard,
        look: Look,
        curve: DifferenceCurve,
        *,
        change: Callable[[], None],
    ) -> None:
        """Add the panel.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            look: What the switches change.
            curve: The difference.
            change: Called when the look has changed.
        """
        self._look = look
        self._curve = curve
        self._change = change
        self._names = dict.fromkeys(SIDE_KEYS, "")
        self._notes: tuple[str, ...] = ()
        self._length_unit, self._unit, self._factor = "m", "mm", 1e3
        self._tick: int | None = None  # None until the clock tells it.
        self._plotted: int | None = None
        # What is written must not be older than what it replaces.
        self._lock = threading.RLock()
        gui = server.gui
        self.folder = gui.add_folder("A and B")
        with self.folder:
            self._legend = gui.add_html("")
            self._mode = gui.add_dropdown(
                "Show", tuple(MODES.values()), initial_value=MODES[look.mode], hint="M: the next"
            )
            self._tint = gui.add_dropdown(
                "Colors of A and B",
                tuple(TINTS.values()),
                initial_value=TINTS[look.tint],
                hint="C: the next. Beside each other, both can have those of the paper's figure",
            )
            self._fade = gui.add_slider(
                "A ↔ B", 0.0, 1.0, 0.01, look.fade, hint="Left: A alone, right: B alone"
            )
            self._wipe = gui.add_slider(
                "Line", 0.0, 1.0, 0.01, look.wipe, hint="Left of the line is A, right of it B"
            )
            self._swap = gui.add_button(
                "Swap sides", icon=viser.Icon.ARROWS_LEFT_RIGHT, color="gray", hint="X"
            )
            self._text = gui.add_html("")
            self._plot = FramePlot(gui, _CURVES, frame_count=1, unit="", mark_color=_NOW, height=96)
        self._mode.on_update(guard.by_user(lambda _: self._choose()))
        self._tint.on_update(guard.by_user(lambda _: self._choose()))
        self._fade.on_update(guard.by_user(lambda _: self._choose()))
        self._wipe.on_update(guard.by_user(lambda _: self._choose()))
        self._swap.on_click(guard(lambda _: self.swap()))
        self._commands = bind(server, guard, "swap", lambda _, __: self.swap())
        self._commands += bind(server, guard, "compare_mode", lambda _, __: self.next_mode())
        self._dress()

    def remove(self) -> None:
        """Take the panel and its keys away."""
        self.folder.remove()
        for command in self._commands:
            command.remove()

    def name(
        self, names: dict[str, str], notes: tuple[str, ...], *, unit: str, tick_count: int
    ) -> None:
        """Name A and B.

        Args:
            names: Name of each side; of a user's text only what `without_markup` leaves of it.
            notes: What a user should know of the pair, as sentences.
            unit: Unit of lengths.
            tick_count: Number of ticks of the clock.
        """
        self._names, self._notes = names, notes
        self._unit, self._factor = ("mm", 1e3) if unit == "m" else (unit, 1.0)
        self._length_unit = unit
        self._plot.measure_in(self._unit, tick_count)
        self._dress()
        self.follow()

    def follow(self) -> bool:
        """Show what is measured by now; for any thread. Tells whether the color scale changed."""
        with self._lock:
            before = self._look.scale
            self._look.scale = rounded_up(self._curve.strong * self._factor) / self._factor
            self._draw_plot()
            self._write()
            return self._look.scale != before

    def show(self, tick: int, *, is_playing: bool) -> None:
        """Tell which tick is on the screen."""
        with self._lock:
            if tick != self._tick:
                self._tick = tick
                self._write()
            # A clock that stops may leave behind what was not worth drawing while it ran.
            if tick != self._plotted and (not is_playing or tick % 5 == 0):
                self._draw_plot()

    def swap(self) -> None:
        """Let A and B change their places."""
        self._look.is_swapped = not self._look.is_swapped
        self._dress()
        self._change()

    def next_mode(self) -> None:
        """Go to the next way of showing both."""
        modes = list(MODES)
        self.show_mode(modes[(modes.index(self._look.mode) + 1) % len(modes)])

    def show_mode(self, mode: Mode) -> None:
        """Show both in a way."""
        self._mode.value = MODES[mode]
        self._choose()

    def next_tint(self, step: int) -> None:
        """Go to the next meaning of the colors, or to one before."""
        tints = list(TINTS)
        self._tint.value = TINTS[tints[(tints.index(self._look.tint) + step) % len(tints)]]
        self._choose()

    def _choose(self) -> None:
        look = self._look
        with self._lock:  # What is taken last must be what was read last.
            look.mode = next(mode for mode, label in MODES.items() if label == self._mode.value)
            look.tint = next(tint for tint, label in TINTS.items() if label == self._tint.value)
            look.fade, look.wipe = self._fade.value, self._wipe.value
            self._dress()
        self._change()

    def _dress(self) -> None:
        with self._lock:
            self._fade.visible = self._look.mode == "overlay"
            self._wipe.visible = self._look.mode == "wipe"
            self._write()

    def _write(self) -> None:
        """Write the legend and the difference of the tick on the screen."""
        styles = dict.fromkeys(SIDE_KEYS, FIGURE_STYLE) if self._look.is_figure else STYLES
        names = [(styles[name].node, f"{name.upper()} {self._names[name]}") for name in SIDE_KEYS]
        if self._look.is_swapped:
            names.reverse()
        written = swatches_html(names, is_list=True)
        if self._look.tint == "difference" and self._curve.way is not None:
            scale = difference_scale(self._look.scale, self._length_unit)
            written += legend_html(Legend(scale=scale))
        self._set(self._legend, written)
        self._set(self._text, f'<div style="{_STYLE}">{"<br/>".join(self._lines())}</div>')

    def _lines(self) -> list[str]:
        """Say how far A and B are apart, how that is measured, and what the pair's notes are."""
        way = self._curve.way
        difference = None if self._tick is None else self._curve.at(self._tick)
        lines: list[str] = []
        if difference is not None:
            mean, largest = (
                f"{v * self._factor:.3g}" for v in (difference.mean, difference.largest)
            )
            lines.append(
                f"{_mark(_MEAN)} mean {mean} {without_markup(self._unit)} "
                f"{_mark(_LARGEST)} max {largest} {without_markup(self._unit)} between A and B"
            )
        elif way is not None:
            lines.append("measuring the difference …")
        lines += [without_markup(_COMPARED[way])] if way else []
        return lines + [f"<em>{escape(note)}</em>" for note in self._notes]

    @staticmethod
    def _set(place: Any, content: str) -> None:
        if place.content != content:
            place.content = content

    def _draw_plot(self) -> None:
        self._plotted = self._tick
        self._plot.offer(on=self._curve.way is not None)
        if self._tick is not None:
            self._plot.show([curve * self._factor for curve in self._curve.columns()], self._tick)


def _mark(color: str) -> str:
    return f'<span style="color:{color}">●</span>'
