"""The panel that changes the physics: sliders, undo, pace, and what the simulation says."""

import math
import threading
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import viser

from app.keys import Action
from app.viewer.content.content import Content
from app.viewer.live.client import STARTING, LiveRollouts, Readout
from app.viewer.physics.history import History, TriedSetting
from app.viewer.physics.keep_panel import KeepPanel, PresetChoice, UserStorage
from app.viewer.physics.parameters import (
    FACTOR_MARKS,
    POWER_DIGITS,
    HeightKnob,
    Knob,
    Switch,
    changes_in,
    edits_text,
    ground_knobs,
    knobs_of,
)
from app.viewer.ui.followed import FollowedChoice
from app.viewer.ui.gestures import Gestures
from app.viewer.ui.guard import Guard
from app.viewer.ui.keyboard import bind
from app.viewer.ui.tabs import Tabs
from physhandi.errors import UsageError
from physhandi.object_rollout import ObjectRollout
from physhandi.run import Run
from physhandi.simulation.edits import MOST_EDITS, AnyEdit, Edits
from physhandi.simulation.parameters import PARAMETERS, SimulationParameters

_CHANGED = "● "


class SliderSet:
    """One control for each parameter that people may move."""

    def __init__(
        self,
        gui: viser.GuiApi,
        guard: Guard,
        history: History,
        gestures: Gestures,
        move: Callable[[Knob | Switch, FollowedChoice, int], None],
    ) -> None:
        """Prepare; `add` makes the controls where the caller stands.

        Args:
            gui: Where to.
            guard: Wraps the callbacks.
            history: Keeps the parameters.
            gestures: Tells which movements are one.
            move: Called with a parameter, its control and the number of the gesture when a user
                has moved it.
        """
        self._gui = gui
        self._guard = guard
        self._history = history
        self._gestures = gestures
        self._move = move
        self._controls: list[tuple[Knob | Switch, FollowedChoice]] = []

    @property
    def knobs(self) -> tuple[Knob | Switch, ...]:
        """Controls that change parameters."""
        return tuple(knob for knob, _ in self._controls)

    def add(self, *knobs: Knob | Switch) -> None:
        """Add a control for each of some parameters."""
        for knob in knobs:
            control = FollowedChoice(self._make(knob), self._guard)
            self._listen(knob, control)
            self._controls.append((knob, control))

    def show(self) -> None:
        """Move the controls to the parameters in force, but none that a user is moving."""
        for knob, control in self._controls:
            control.show(knob.to_slider(self._history.current))

    def mark(self) -> None:
        """Put a dot before the name of whatever is not as fitted."""
        start, now = self._history.start, self._history.current
        for knob, followed in self._controls:
            control = followed.handle
            label = f"{_CHANGED}{knob.label}" if knob.differs(start, now) else knob.label
            if control.label != label:
                control.label = label
            if isinstance(knob, HeightKnob) and control.disabled != (now.ground_height is None):
                control.disabled = now.ground_height is None

    def _listen(self, knob: Knob | Switch, control: FollowedChoice) -> None:
        gesture = self._gestures.follow(control.handle)
        control.handle.on_update(
            self._guard.by_user(lambda _: self._move(knob, control, gesture()))
        )

    def _make(self, knob: Knob | Switch) -> Any:
        start = knob.to_slider(self._history.start)
        if isinstance(knob, Switch):
            return self._gui.add_checkbox(knob.label, bool(start), hint=knob.hint)
        if knob.is_integer:
            low, high = int(knob.low), int(knob.high)
            return self._gui.add_slider(knob.label, low, high, 1, int(start), hint=knob.hint)
        marks = FACTOR_MARKS if knob.is_logarithm else None
        slider = self._gui.add_slider(
            knob.label, knob.low, knob.high, knob.step, start, hint=knob.hint, marks=marks
        )
        # Typed values may be finer.
        slider.precision = POWER_DIGITS if knob.is_logarithm else min(slider.precision + 1, 7)
        return slider


SUBSTEPS_AS_FITTED, SUBSTEPS_AUTOMATIC, SUBSTEPS_BY_HAND = "as fitted", "automatic", "by hand"
_MOST = 100_000


class SubstepsChoice:
    """As fitted, automatic, or a number."""

    def __init__(
        self,
        gui: viser.GuiApi,
        guard: Guard,
        history: History,
        gestures: Gestures,
        change: Callable[[Callable[[], TriedSetting]], None],
    ) -> None:
        """Add the choice where the caller stands.

        Args:
            gui: Where to.
            guard: Wraps the callbacks.
            history: Keeps the number, and whether it is chosen automatically.
            gestures: Tells what is typed at one go.
            change: Makes a change of the history, and what follows from it.
        """
        self._history = history
        self._change = change
        self._in_use = history.start.substeps_per_frame
        choice: Any = gui.add_dropdown(
            "substeps",
            (SUBSTEPS_AS_FITTED, SUBSTEPS_AUTOMATIC, SUBSTEPS_BY_HAND),
            hint="Integration steps a frame. Automatic takes as few as are stable at frame 0",
        )
        self._followed = FollowedChoice(choice, guard)
        number: Any = gui.add_number(
            "number",
            self._in_use,
            min=1,
            max=_MOST,
            step=1,
            visible=False,
            hint=PARAMETERS["substeps_per_frame"].about,
        )
        self._number = FollowedChoice(number, guard)
        gesture = gestures.follow(number)
        choice.on_update(guard.by_user(lambda _: self._take_choice()))
        number.on_update(guard.by_user(lambda _: self._take_number(gesture())))

    def show(self) -> None:
        """Follow the history."""
        history = self._history
        number = history.current.substeps_per_frame
        is_other = number != history.start.substeps_per_frame
        choice = (
            SUBSTEPS_AUTOMATIC
            if history.is_automatic
            else SUBSTEPS_BY_HAND
            if is_other
            else SUBSTEPS_AS_FITTED
        )
        self._followed.show(choice)
        if choice == SUBSTEPS_BY_HAND:
            self._number.show(number)
        self._number.handle.visible = choice == SUBSTEPS_BY_HAND

    def follow(self, readout: Readout) -> None:
        """Remember what is in use, from which typing a number begins."""
        self._in_use = readout.substeps_per_frame

    def _take_choice(self) -> None:
        history, choice = self._history, self._followed.read()
        if choice != SUBSTEPS_BY_HAND:
            is_automatic = choice == SUBSTEPS_AUTOMATIC
            self._change(lambda: history.choose_substeps(is_automatic=is_automatic))
            return
        # Nothing is simulated anew before another number is typed.
        number = self._in_use
        self._number.show(number)
        self._number.handle.visible = True
        if history.is_automatic:
            changed = history.current.replace(substeps_per_frame=number)
            self._change(lambda: history.replace(changed))

    def _take_number(self, gesture: int) -> None:
        def take() -> TriedSetting:
            number = min(max(int(self._number.read()), 1), _MOST)
            return self._history.set("substeps_per_frame", number, gesture=gesture)

        self._change(take)


def warning(readout: Readout) -> str:
    """Warn of too few substeps to be stable; empty if they are enough or the limit is unknown."""
    needed = readout.needed_substeps
    if needed is None or readout.substeps_per_frame >= needed:
        return ""
    return (
        f"**⚠ Too few substeps: {readout.substeps_per_frame} a frame, at least {needed} are needed "
        "to be stable.** Choose automatic ones, or less stiffness or damping."
    )


_REFRESH = 0.2
_UNDO, _REDO, _RESET = "Undo", "Redo", "Reset"
_HOLD, _STEP, _GO = "Hold", "1 frame", "Go"
_PUT_BACK = "choose…"
_LONGEST_STEP = 60
"""Characters of a step in the list of steps."""


class PhysicsPanel:
    """Sliders that re-simulate the object, and the readout above them.

    A value goes straight down: the control, the history, the rollouts, the process that simulates.
    One lock is held on this way, so that what is asked for last is what was moved last: viser calls
    every control in a thread of its own.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        guard: Guard,
        content: Content,
        rollouts: LiveRollouts,
        *,
        tabs: Tabs,
        run: Run,
        storage: UserStorage | None = None,
    ) -> None:
        """Add the panel.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            content: What is shown.
            rollouts: Simulate what the sliders say.
            tabs: Where the panel goes, and what keeps its parameters.
            run: The run whose object is simulated.
            storage: Where presets and runs are kept; None where nothing can be kept.
        """
        fitted = rollouts.fitted
        self.history = History(fitted.parameters, fitted.edits)
        self._gestures = Gestures(server.gui)
        self._step_texts: dict[tuple[TriedSetting, TriedSetting], str] = {}
        self._rollouts = rollouts
        self._listener: Callable[[], None] = lambda: None
        self._is_held = False
        self._changed: dict[str, tuple[str, ...]] = {}
        self._is_metric = content.is_metric
        self._unit = "mm" if content.is_metric else content.length_unit
        self._refreshed = -math.inf
        self._lock = threading.Lock()
        self._readout_lock = threading.Lock()
        self.keep: KeepPanel | None = None
        gui, unit = server.gui, content.length_unit
        store = None if storage is None else storage.presets
        with tabs["Physics"]:
            self._folder = gui.add_folder(None)
        with self._folder:
            self._status = gui.add_markdown("")
            self._presets = PresetChoice(
                gui, guard, self.history, length_unit=unit, store=store, choose=self._replace
            )
            self._sliders = SliderSet(gui, guard, self.history, self._gestures, self._move)
            self._substeps = self._add_sliders(gui, guard, fitted, unit)
            self._steps = self._add_steps(gui, guard)
            pace = gui.add_button_group(
                "Simulation",
                (_HOLD, _STEP, _GO),
                hint="Hold it, compute one frame (N), or let it go on (H)",
            )
            pace.on_click(guard(lambda event: self._set_pace(event.target.value)))
            self._changes = gui.add_markdown("")
            self._put_back = FollowedChoice(
                gui.add_dropdown(
                    "Put back",
                    (_PUT_BACK,),
                    visible=False,
                    hint="Give one parameter its fitted value again",
                ),
                guard,
            )
            self._put_back.handle.on_update(guard.by_user(lambda _: self._put_one_back()))
        if storage is not None:
            with tabs["Export"]:
                self.keep = KeepPanel(
                    gui,
                    guard,
                    self.history,
                    rollouts,
                    choice=self._presets,
                    content=content,
                    run=run,
                    storage=storage,
                )
        self._commands = self._add_keys(server, guard)

    def restore(
        self, parameters: SimulationParameters, *, is_automatic: bool, edits: Edits | None = None
    ) -> None:
        """Simulate what another session of the same object simulates; None for its own edits."""
        self._replace(parameters, is_automatic)
        if edits is not None:
            self._change(lambda: self.history.edit(edits))

    def edit(self, *edits: AnyEdit) -> None:
        """Do something more to single springs and nodes, as one step.

        Raises:
            UsageError: If there are too many edits.
        """
        self._change(lambda: self.history.edit(_with(self.history.setting.edits, edits)))

    def put_edits(self, edits: Edits, title: str) -> None:
        """Have other edits in place of all in force, as one step.

        Args:
            edits: What is to be done to single springs and nodes, and nothing else.
            title: What the list of steps calls it.
        """

        def put() -> TriedSetting:
            before = self.history.setting
            after = self.history.edit(edits)
            self._step_texts[before, after] = title
            return after

        self._change(put)

    def follow(self, listener: Callable[[], None]) -> None:
        """Call a function whenever another setting is in force; it must not change one."""
        self._listener = listener

    def remove(self) -> None:
        """Take the panel away."""
        self.close()
        for command in self._commands:
            command.remove()
        self._gestures.remove()
        if self.keep is not None:
            self.keep.remove()
        self._folder.remove()

    def close(self) -> None:
        """Stop listening to what others keep."""
        if self.keep is not None:
            self.keep.close()

    def show(self, readout: Readout, *, at_once: bool) -> None:
        """Write the readout, not more often than people can read.

        Args:
            readout: What to say.
            at_once: Whether to write it even if the last one is fresh.
        """
        now = time.monotonic()
        with self._readout_lock:
            if not at_once and now - self._refreshed < _REFRESH:
                return
            self._refreshed = now
        self._is_held = readout.is_held
        self._substeps.follow(readout)
        text = self._text(readout)
        if self._status.content != text:
            self._status.content = text

    def _text(self, readout: Readout) -> str:
        pace = ""
        if math.isfinite(readout.frame_duration):
            rate = 1.0 / max(readout.frame_duration, 1e-6)
            pace = f" · {readout.frame_duration * 1e3:.3g} ms a frame · {rate:.0f} frames/s"
        lines = [
            f"object springs {readout.object_spring_count} · "
            f"virtual springs {readout.virtual_spring_count}",
            f"nodes {readout.node_count} · substeps {readout.substeps_per_frame}",
            f"simulated {readout.simulated_count}/{readout.frame_count} frames{pace}",
        ]
        if readout.is_starting:
            lines.insert(0, STARTING)
        if math.isfinite(readout.difference):
            value = readout.difference * (1e3 if self._is_metric else 1.0)
            lines.append(f"{value:.3g} {self._unit} from the fitted rollout (mean)")
        if readout.virtual_spring_count == 0:
            lines.append("**⚠ No virtual spring: nothing holds the object.** Raise δ virtual.")
        if unstable := warning(readout):
            lines.append(unstable)
        if readout.error is not None:
            lines.append(f"**Stopped at frame {readout.simulated_count}; last good state shown**")
        elif readout.is_held and readout.is_busy:
            lines.append(f"**Held at frame {max(readout.simulated_count - 1, 0)}**")
        elif readout.is_held:
            lines.append("**Held: the next simulation waits at frame 0**")
        return "<br/>".join(lines)

    def _add_sliders(
        self, gui: viser.GuiApi, guard: Guard, fitted: ObjectRollout, unit: str
    ) -> SubstepsChoice:
        """Add the sliders, a tab for each group of them."""
        parameters = fitted.parameters
        height = np.asarray(fitted.position[0])[:, 2]
        low, high = float(height.min()), float(height.max())
        groups = gui.add_tab_group()
        with groups.add_tab("Springs"):
            self._sliders.add(*knobs_of("springs", parameters, length_unit=unit))
        with groups.add_tab("More"):
            self._sliders.add(*knobs_of("more", parameters, length_unit=unit))
            substeps = SubstepsChoice(gui, guard, self.history, self._gestures, self._change)
        with groups.add_tab("Ground"):
            self._sliders.add(*ground_knobs(parameters, length_unit=unit, low=low, high=high))
        with groups.add_tab("Collisions"):
            self._sliders.add(*knobs_of("self-collision", parameters, length_unit=unit))
        if len(fitted.model.hand_face):
            with groups.add_tab("Hands"):
                self._sliders.add(*knobs_of("hands", parameters, length_unit=unit))
        return substeps

    def _add_steps(self, gui: viser.GuiApi, guard: Guard) -> FollowedChoice:
        """Add undo, redo, reset and the list of steps."""
        buttons = gui.add_button_group(
            "Steps", (_UNDO, _REDO, _RESET), hint="Ctrl+Z and Ctrl+Shift+Z"
        )
        buttons.on_click(guard(lambda event: self._press(event.target.value)))
        steps = FollowedChoice(
            gui.add_dropdown(
                "History", _numbered(["as fitted"]), hint="What was tried; go to any of it"
            ),
            guard,
        )
        steps.handle.on_update(guard.by_user(lambda _: self._go_to_step()))
        return steps

    def _add_keys(self, server: viser.ViserServer, guard: Guard) -> list[viser.CommandHandle]:
        actions: dict[Action, Callable[[], None]] = {
            "undo": lambda: self._press(_UNDO),
            "redo": lambda: self._press(_REDO),
            "one_frame": lambda: self._set_pace(_STEP),
            "hold": lambda: self._set_pace(_GO if self._is_held else _HOLD),
        }
        return [
            command
            for action, act in actions.items()
            for command in bind(server, guard, action, lambda _, __, act=act: act())
        ]

    def _move(self, knob: Knob | Switch, control: FollowedChoice, gesture: int) -> None:
        with self._lock:
            before = self.history.setting
            value = knob.from_slider(control.read())
            setting = self.history.set(knob.field, value, gesture=gesture)
            if setting != before:
                self._simulate(setting)

    def _replace(self, parameters: SimulationParameters, is_automatic: bool) -> None:
        self._change(lambda: self.history.replace(parameters, is_automatic=is_automatic))

    def _go_to_step(self) -> None:
        index = int(self._steps.read().partition(" ")[0])
        self._change(lambda: self.history.go(index))

    def _put_one_back(self) -> None:
        fields = self._changed.get(self._put_back.read())
        if fields:
            self._change(lambda: self.history.put_back(*fields))

    def _press(self, name: str) -> None:
        history = self.history
        change = {_UNDO: history.undo, _REDO: history.redo, _RESET: history.reset}[name]
        # Stepping simulates the fitted parameters, too: a reset shows what was stored of them.
        self._change(change, always=name == _RESET)

    def _change(self, change: Callable[[], TriedSetting], *, always: bool = False) -> None:
        """Simulate what a change of the history puts in force, and move the controls to it."""
        with self._lock:
            before = self.history.setting
            setting = change()
            if setting != before or always:
                self._simulate(setting)
            self._sliders.show()
            self._substeps.show()

    def _simulate(self, setting: TriedSetting) -> None:
        """Simulate a setting and say what it changes, leaving the controls alone."""
        self._rollouts.request(
            setting.parameters, automatic_substeps=setting.is_automatic, edits=setting.edits
        )
        self._sliders.mark()
        self._presets.show()
        if self.keep is not None:
            self.keep.show()
        self._listener()
        self._show_changes()
        self._show_steps()

    def _set_pace(self, name: str) -> None:
        """Hold the simulation, compute one frame of it or let it run."""
        with self._lock:
            if name == _STEP:
                self._rollouts.step()
            else:
                self._rollouts.hold(on=name == _HOLD)

    def _show_changes(self) -> None:
        history = self.history
        changes = changes_in(
            self._sliders.knobs, history.start, history.current, is_automatic=history.is_automatic
        )
        self._changed = {change.name: change.fields for change in changes}
        edits = edits_text(history.begin.edits, history.setting.edits)
        text = ", ".join([*(change.text for change in changes), *edits])
        self._put_back.offer((_PUT_BACK, *self._changed))
        self._put_back.show(_PUT_BACK)
        self._put_back.handle.visible = bool(changes)
        self._changes.content = f"Changed: {text or 'nothing: parameters as fitted'}"

    def _show_steps(self) -> None:
        """List the steps, each by what it changed."""
        history, earlier = self.history, self._step_texts
        pairs = list(pairwise(history.steps))
        self._step_texts = {
            pair: earlier.get(pair) or step_text(self._sliders.knobs, *pair) for pair in pairs
        }
        begins = "as fitted" if history.steps[0] == history.begin else "before"
        names = _numbered([begins, *(self._step_texts[pair] for pair in pairs)])
        self._steps.offer(names)
        self._steps.show(names[history.index])


def step_text(knobs: tuple[Knob | Switch, ...], before: TriedSetting, after: TriedSetting) -> str:
    """Say what a step changed, for example ``δ object [mm] 20 → 35``.

    Args:
        knobs: The sliders and boxes.
        before: What was in force before it.
        after: What is in force after it.
    """
    is_automatic = after.is_automatic and not before.is_automatic
    changes = changes_in(knobs, before.parameters, after.parameters, is_automatic=is_automatic)
    texts = [change.text for change in changes]
    if before.is_automatic and not after.is_automatic:
        texts.append(f"substeps automatic → {after.parameters.substeps_per_frame}")
    texts.extend(edits_text(before.edits, after.edits))
    text = ", ".join(texts)
    return text if len(text) <= _LONGEST_STEP else f"{text[: _LONGEST_STEP - 1]}…"


def _with(edits: Edits, more: Edits) -> Edits:
    if len(edits) + len(more) > MOST_EDITS:
        raise UsageError(f"{MOST_EDITS} edits are the most that an object can have.")
    return (*edits, *more)


def _numbered(texts: list[str]) -> tuple[str, ...]:
    """Number the steps, so that no two are called the same."""
    return tuple(f"{number} · {text}" for number, text in enumerate(texts))
