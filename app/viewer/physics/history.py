"""The parameters that were tried in a session, with undo and redo."""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from physhandi.simulation.parameters import SimulationParameters

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
        self._entries = [(start, False)]
        self._index = 0
        self._last: tuple[str, float] = ("", -math.inf)
        # Each slider is heard in a thread of its own.
        self._lock = threading.RLock()

    @property
    def current(self) -> SimulationParameters:
        """The parameters in force."""
        return self._entries[self._index][0]

    @property
    def is_automatic(self) -> bool:
        """Whether the number of substeps is chosen automatically."""
        return self._entries[self._index][1]

    @property
    def is_changed(self) -> bool:
        """Whether anything is not as fitted."""
        return self._entries[self._index] != (self.start, False)

    @property
    def can_undo(self) -> bool:
        """Whether there is something to take back."""
        return self._index > 0

    @property
    def can_redo(self) -> bool:
        """Whether something was taken back."""
        return self._index < len(self._entries) - 1

    def set(self, field: str, value: float | None) -> SimulationParameters:
        """Change one parameter; changes of the same one in quick succession count as one."""
        now = self._clock()
        with self._lock:
            changed = replace(self.current, **{field: value})
            is_same_drag = self._last[0] == field and now - self._last[1] < _COALESCE
            self._last = (field, now)
            if is_same_drag and self._index > 0:
                self._entries[self._index :] = [(changed, self.is_automatic)]
            elif changed != self.current:
                self._add(changed, self.is_automatic)
            return self.current

    def replace(
        self, parameters: SimulationParameters, *, is_automatic: bool = False
    ) -> SimulationParameters:
        """Change all parameters at once."""
        with self._lock:
            self._last = ("", -math.inf)
            if self._entries[self._index] != (parameters, is_automatic):
                self._add(parameters, is_automatic)
            return self.current

    def set_substeps(self, number: int, *, is_automatic: bool = False) -> SimulationParameters:
        """Change the number of substeps, and whether it is chosen automatically."""
        with self._lock:
            changed = replace(self.current, substeps_per_frame=number)
            return self.replace(changed, is_automatic=is_automatic)

    def put_back(self, *fields: str) -> SimulationParameters:
        """Give some parameters their fitted values again."""
        fitted = {field: getattr(self.start, field) for field in fields}
        with self._lock:
            is_automatic = self.is_automatic and "substeps_per_frame" not in fields
            return self.replace(replace(self.current, **fitted), is_automatic=is_automatic)

    def undo(self) -> SimulationParameters:
        """Take the last change back."""
        return self._go(self._index - 1)

    def redo(self) -> SimulationParameters:
        """Make the change again that was taken back last."""
        return self._go(self._index + 1)

    def reset(self) -> SimulationParameters:
        """Return to the fitted parameters; this can be undone."""
        return self.replace(self.start)

    def _add(self, parameters: SimulationParameters, is_automatic: bool) -> None:
        self._entries[self._index + 1 :] = [(parameters, is_automatic)]
        self._index += 1

    def _go(self, index: int) -> SimulationParameters:
        with self._lock:
            self._last = ("", -math.inf)
            self._index = min(max(index, 0), len(self._entries) - 1)
            return self.current
