"""The parameters that were tried in a session, with undo and redo."""

import math
import time
from collections.abc import Callable
from dataclasses import replace

from physhandi.simulation.model import SimulationParameters

_COALESCE = 1.0


class History:
    """The parameters that were tried, with undo and redo."""

    def __init__(
        self, start: SimulationParameters, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Begin with the fitted parameters.

        Args:
            start: The fitted parameters, to which `reset` returns.
            clock: Tells the time [s].
        """
        self.start = start
        self._clock = clock
        self._entries = [start]
        self._index = 0
        self._last: tuple[str, float] = ("", -math.inf)

    @property
    def current(self) -> SimulationParameters:
        """The parameters in force."""
        return self._entries[self._index]

    @property
    def can_undo(self) -> bool:
        """Whether there is something to take back."""
        return self._index > 0

    @property
    def can_redo(self) -> bool:
        """Whether something was taken back."""
        return self._index < len(self._entries) - 1

    def set(self, field: str, value: float) -> SimulationParameters:
        """Change one parameter; changes of the same one in quick succession count as one."""
        now = self._clock()
        changed = replace(self.current, **{field: value})
        is_same_drag = self._last[0] == field and now - self._last[1] < _COALESCE
        self._last = (field, now)
        if is_same_drag and self._index > 0:
            self._entries[self._index :] = [changed]
        elif changed != self.current:
            self._entries[self._index + 1 :] = [changed]
            self._index += 1
        return self.current

    def replace(self, parameters: SimulationParameters) -> SimulationParameters:
        """Change all parameters at once."""
        self._last = ("", -math.inf)
        if self.current != parameters:
            self._entries[self._index + 1 :] = [parameters]
            self._index += 1
        return self.current

    def undo(self) -> SimulationParameters:
        """Take the last change back."""
        return self._go(self._index - 1)

    def redo(self) -> SimulationParameters:
        """Make the change again that was taken back last."""
        return self._go(self._index + 1)

    def reset(self) -> SimulationParameters:
        """Return to the fitted parameters; this can be undone."""
        return self.replace(self.start)

    def _go(self, index: int) -> SimulationParameters:
        self._last = ("", -math.inf)
        self._index = min(max(index, 0), len(self._entries) - 1)
        return self.current
