"""The sliders and tick boxes of the physics panel, which follow the parameters in force."""

import threading
from collections.abc import Callable
from typing import Any

import viser

from app.viewer.contact_knobs import HeightKnob
from app.viewer.guard import Guard
from app.viewer.history import History
from app.viewer.parameters import Knob, Switch

_CHANGED = "● "


class SliderSet:
    """One control for each parameter that people may move."""

    def __init__(
        self, gui: viser.GuiApi, guard: Guard, history: History, moved: Callable[[], None]
    ) -> None:
        """Prepare; `add` makes the controls where the caller stands.

        Args:
            gui: Where to.
            guard: Wraps the callbacks.
            history: Keeps the parameters.
            moved: Called when a user has changed a parameter.
        """
        self._gui = gui
        self._guard = guard
        self._history = history
        self._moved = moved
        # Each slider is heard in a thread of its own.
        self._lock = threading.Lock()
        self._controls: list[tuple[Knob | Switch, Any]] = []

    @property
    def knobs(self) -> tuple[Knob | Switch, ...]:
        """What can be moved."""
        return tuple(knob for knob, _ in self._controls)

    def add(self, *knobs: Knob | Switch) -> None:
        """Add a control for each of some parameters."""
        for knob in knobs:
            control = self._make(knob)
            control.on_update(
                self._guard.by_user(lambda _, knob=knob, control=control: self._move(knob, control))
            )
            self._controls.append((knob, control))

    def show(self) -> None:
        """Follow the history; what is not as fitted gets a dot before its name."""
        for knob, control in self._controls:
            value = knob.to_slider(self._history.current)
            if control.value != value:
                control.value = value
        self.mark()

    def mark(self) -> None:
        """Put a dot before the name of whatever is not as fitted."""
        start, now = self._history.start, self._history.current
        for knob, control in self._controls:
            label = f"{_CHANGED}{knob.label}" if knob.differs(start, now) else knob.label
            if control.label != label:
                control.label = label
            if isinstance(knob, HeightKnob) and control.disabled != (now.ground_height is None):
                control.disabled = now.ground_height is None

    def _make(self, knob: Knob | Switch) -> Any:
        start = knob.to_slider(self._history.start)
        if isinstance(knob, Switch):
            return self._gui.add_checkbox(knob.label, bool(start), hint=knob.hint)
        if knob.is_integer:
            low, high = int(knob.low), int(knob.high)
            return self._gui.add_slider(knob.label, low, high, 1, int(start), hint=knob.hint)
        slider = self._gui.add_slider(
            knob.label, knob.low, knob.high, knob.step, start, hint=knob.hint
        )
        slider.precision = min(slider.precision + 1, 7)  # Typed values may be finer.
        return slider

    def _move(self, knob: Knob | Switch, control: Any) -> None:
        with self._lock:  # What is set last must be what was read last.
            before = self._history.current
            has_changed = self._history.set(knob.field, knob.from_slider(control.value)) != before
        if has_changed:
            self._moved()
