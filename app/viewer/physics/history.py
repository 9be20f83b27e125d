"""The parameters that were tried in a session, with undo and redo."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

from physhandi.simulation.parameters import SimulationParameters

_REST = 3.0
"""A slider that rested for longer is moved by another gesture [s]."""


class Setting(NamedTuple):
    """What is simulated."""

    parameters: SimulationParameters
    """Their number of substeps is that in force before the automatic choice."""
    is_automatic: bool = False
    """Whether the number of substeps is chosen automatically."""


class History:
    """The settings that were tried; one gesture is one step.

    A gesture moves one slider, however far and slowly, until another control is used or the slider
    rests. Changed by one thread at a time; `setting` may be read by any.
    """

    def __init__(
        self, start: SimulationParameters, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Begin with the fitted parameters.

        Args:
            start: The fitted parameters, to which `reset` returns.
            clock: Gives the time [s].
        """
        self.start = start
        self.setting = Setting(start)
        """What is in force."""
        self._clock = clock
        self._steps = [self.setting]
        self._index = 0
        self._moved: str | None = None
        self._moved_at = 0.0

    @property
    def current(self) -> SimulationParameters:
        """The parameters in force."""
        return self.setting.parameters

    @property
    def is_automatic(self) -> bool:
        """Whether the number of substeps is chosen automatically."""
        return self.setting.is_automatic

    def set(self, field: str, value: Any) -> Setting:
        """Change one parameter, as a slider does that is being moved."""
        now = self._clock()
        setting = self.setting._replace(parameters=self.current.replace(**{field: value}))
        is_same_gesture = field == self._moved and now - self._moved_at < _REST
        if is_same_gesture and self._index > 0:
            self._steps[self._index :] = [setting]
            self.setting = setting
        else:
            self._add(setting)
        self._moved, self._moved_at = field, now
        return self.setting

    def replace(self, parameters: SimulationParameters, *, is_automatic: bool = False) -> Setting:
        """Change all parameters at once."""
        self._moved = None
        self._add(Setting(parameters, is_automatic))
        return self.setting

    def set_substeps(self, number: int, *, is_automatic: bool = False) -> Setting:
        """Change the number of substeps, and whether it is chosen automatically."""
        changed = self.current.replace(substeps_per_frame=number)
        return self.replace(changed, is_automatic=is_automatic)

    def put_back(self, *fields: str) -> Setting:
        """Give some parameters their fitted values again."""
        fitted = {field: getattr(self.start, field) for field in fields}
        is_automatic = self.is_automatic and "substeps_per_frame" not in fields
        return self.replace(self.current.replace(**fitted), is_automatic=is_automatic)

    def undo(self) -> Setting:
        """Take the last change back."""
        return self._go(self._index - 1)

    def redo(self) -> Setting:
        """Make the change again that was taken back last."""
        return self._go(self._index + 1)

    def reset(self) -> Setting:
        """Return to the fitted parameters; this can be undone."""
        return self.replace(self.start)

    def _add(self, setting: Setting) -> None:
        if setting != self.setting:
            self._steps[self._index + 1 :] = [setting]
            self._index += 1
            self.setting = setting

    def _go(self, index: int) -> Setting:
        self._moved = None
        self._index = min(max(index, 0), len(self._steps) - 1)
        self.setting = self._steps[self._index]
        return self.setting
