"""Choosing how many substeps a frame has, and the warning when those are too few."""

from collections.abc import Callable
from typing import Any

import viser

from app.viewer.followed import FollowedChoice
from app.viewer.guard import Guard
from app.viewer.history import History
from app.viewer.resimulation import Readout

AS_FITTED, AUTOMATIC, BY_HAND = "as fitted", "automatic", "by hand"
_MOST = 100_000


class SubstepsChoice:
    """As fitted, automatic, or a number."""

    def __init__(
        self, gui: viser.GuiApi, guard: Guard, history: History, moved: Callable[[], None]
    ) -> None:
        """Add the choice where the caller stands.

        Args:
            gui: Where to.
            guard: Wraps the callbacks.
            history: Keeps the number, and whether it is chosen automatically.
            moved: Called when a user has chosen another one.
        """
        self._history = history
        self._moved = moved
        self._in_use = history.start.substeps_per_frame
        choice: Any = gui.add_dropdown(
            "substeps",
            (AS_FITTED, AUTOMATIC, BY_HAND),
            hint="Integration steps a frame. Automatic takes as few as are stable at frame 0",
        )
        self._followed = FollowedChoice(choice, guard)
        self._number: Any = gui.add_number(
            "number",
            self._in_use,
            min=1,
            max=_MOST,
            step=1,
            visible=False,
            hint="More are slower and more exact; too few and the object explodes",
        )
        choice.on_update(guard.by_user(lambda _: self._choose()))
        self._number.on_update(guard.by_user(lambda _: self._type()))

    def show(self) -> None:
        """Follow the history."""
        history = self._history
        number = history.current.substeps_per_frame
        is_other = number != history.start.substeps_per_frame
        choice = AUTOMATIC if history.is_automatic else BY_HAND if is_other else AS_FITTED
        self._followed.show(choice)
        if choice == BY_HAND and self._number.value != number:
            self._number.value = number
        self._number.visible = choice == BY_HAND

    def hear(self, readout: Readout) -> None:
        """Remember what is in use, from which typing a number begins."""
        self._in_use = readout.substeps_per_frame

    def _choose(self) -> None:
        history, choice = self._history, self._followed.take()
        if choice == BY_HAND:
            # Nothing is simulated anew before another number is typed.
            self._number.value, self._number.visible = self._in_use, True
            if not history.is_automatic:
                return
            number = self._in_use
        else:
            number = history.start.substeps_per_frame
        history.set_substeps(number, is_automatic=choice == AUTOMATIC)
        self._moved()

    def _type(self) -> None:
        self._history.set_substeps(min(max(int(self._number.value), 1), _MOST))
        self._moved()


def warning(readout: Readout) -> str:
    """Say that the substeps are too few to be stable; empty if they are enough or nobody knows."""
    needed = readout.needed_substeps
    if needed is None or readout.substeps_per_frame >= needed:
        return ""
    return (
        f"**⚠ Too few substeps: {readout.substeps_per_frame} a frame, at least {needed} are needed "
        "to be stable.** Choose automatic ones, or less stiffness or damping."
    )
