"""Whether a process hangs: judged by the signs of life that it gives, and by what it computes."""

_IDLE_SHARE = 0.02
"""A process that computes for less of the time does nothing."""
_BUSY_FACTOR = 20.0
_STALL_FACTOR = 40.0


class Vigil:
    """Watches over one process, in time in which the watcher itself was awake.

    A process that was stopped gives no sign and computes nothing. One that computes without a sign
    may be in a library that lets no other thread of it run, so it has `_BUSY_FACTOR` times as long.
    One that gives signs, but neither gets on nor computes, waits for what does not come.
    """

    def __init__(self, limit_s: float, *, now: float) -> None:
        """Begin.

        Args:
            limit_s: Time without a sign of life after which an idle process hangs [s].
            now: Time of a clock that stands still while the machine sleeps [s].
        """
        self.interval_s = min(5.0, limit_s / 10.0)
        """How often to look [s]."""
        self._limit_s = limit_s
        self._time = now
        self._silent_s = self._still_s = 0.0
        self._silent_cpu_s = self._still_cpu_s = 0.0
        self._steps: int = 0
        self._heard: int | None = None

    def hear(self, steps: int) -> None:
        """Take a sign of life; from any thread.

        Args:
            steps: How far the process is, in steps of any kind.
        """
        self._heard = steps

    def look(self, now: float, cpu_s: float) -> str | None:
        """Judge.

        Args:
            now: As at the beginning [s].
            cpu_s: What the process has computed so far [s].

        Returns:
            Why it hangs, as a sentence; None if it does not.
        """
        # Who slept for longer was stopped too, or the whole machine was.
        passed = min(now - self._time, 2.0 * self.interval_s)
        self._time = now
        self._silent_s += passed
        self._still_s += passed
        heard, self._heard = self._heard, None
        if heard is not None:
            self._silent_s, self._silent_cpu_s = 0.0, cpu_s
            if heard != self._steps:
                self._steps, self._still_s, self._still_cpu_s = heard, 0.0, cpu_s
        is_idle = cpu_s - self._silent_cpu_s < _IDLE_SHARE * self._silent_s
        limit = self._limit_s if is_idle else _BUSY_FACTOR * self._limit_s
        if self._silent_s >= limit:
            did = " and did nothing" if is_idle else ""
            return f"Its process hung: it gave no sign of life for {_text(self._silent_s)}{did}."
        is_idle = cpu_s - self._still_cpu_s < _IDLE_SHARE * self._still_s
        if is_idle and self._still_s >= _STALL_FACTOR * self._limit_s:
            return (
                f"Its process hung: it got no further for {_text(self._still_s)} and did nothing."
            )
        return None


def _text(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 180.0 else f"{seconds / 60.0:.0f} min"
