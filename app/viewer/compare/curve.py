"""The difference of two rollouts in every frame, measured beside the clock's thread."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from app.viewer.color.difference import FrameDifference, Way, compare_frames, way_of
from physhandi.object_rollout import ObjectRollout

logger = logging.getLogger(__name__)

_REFRESH = 0.25


@dataclass(frozen=True, kw_only=True, eq=False)
class Pairing:
    """The two rollouts that are compared, and pairs of corresponding frames."""

    first: ObjectRollout
    """Rollout of A."""
    second: ObjectRollout
    """Rollout of B."""
    frames: tuple[tuple[int, int], ...]
    """Frames of A and B at every tick of the clock."""


class DifferenceCurve:
    """Measures the difference at every tick as soon as both rollouts have its frame."""

    def __init__(self, on_change: Callable[[], None]) -> None:
        """Prepare; nothing is measured yet.

        Args:
            on_change: Called while measuring, four times a second, and when it is done.
        """
        self._on_change = on_change
        self._condition = threading.Condition()
        self._pairing: Pairing | None = None
        self._way: Way | None = None
        self._measured: list[FrameDifference] = []
        self._is_closed = False
        self._thread: threading.Thread | None = None

    @property
    def way(self) -> Way | None:
        """Method of the comparison; None without a pair."""
        with self._condition:
            return self._way

    @property
    def count(self) -> int:
        """Number of ticks that are measured, from the first one on."""
        with self._condition:
            return len(self._measured)

    @property
    def strong(self) -> float:
        """Difference that few nodes exceed at any tick [m]; NaN if nothing is measured."""
        with self._condition:
            strong = [d.strong for d in self._measured if np.isfinite(d.strong)]
        return max(strong, default=float("nan"))

    def at(self, tick: int) -> FrameDifference | None:
        """Give the difference at a tick; None if it is not measured."""
        with self._condition:
            return self._measured[tick] if 0 <= tick < len(self._measured) else None

    def columns(self) -> tuple[Float[ndarray, " tick"], Float[ndarray, " tick"]]:
        """Give mean and largest difference of the ticks that are measured [m]."""
        with self._condition:
            measured = list(self._measured)
        mean = np.array([d.mean for d in measured], dtype=np.float64)
        return mean, np.array([d.largest for d in measured], dtype=np.float64)

    def follow(self, pairing: Pairing | None) -> None:
        """Measure these rollouts from now on; the same ones go on as their frames get ready."""
        with self._condition:
            now = self._pairing
            is_same = (
                pairing is not None
                and now is not None
                and (pairing.first is now.first and pairing.second is now.second)
                and pairing.frames == now.frames
            )
            if not is_same:
                self._pairing, self._measured = pairing, []
                self._way = None if pairing is None else way_of(pairing.first, pairing.second)
            if self._thread is None and pairing is not None and not self._is_closed:
                self._thread = threading.Thread(target=self._run, name="difference", daemon=True)
                self._thread.start()
            self._condition.notify_all()
        if not is_same:
            self._on_change()

    def close(self) -> None:
        """End the thread."""
        with self._condition:
            self._is_closed = True
            self._condition.notify_all()
        if self._thread is not None and threading.current_thread() is not self._thread:
            self._thread.join(timeout=5)

    def _next(self) -> tuple[Pairing, Way, int] | None:
        """Find the tick to be measured next, if both rollouts have its frames."""
        pairing, way, tick = self._pairing, self._way, len(self._measured)
        if pairing is None or way is None or tick >= len(pairing.frames):
            return None
        first, second = pairing.frames[tick]
        is_ready = first < pairing.first.ready and second < pairing.second.ready
        return (pairing, way, tick) if is_ready else None

    def _patience(self) -> float | None:
        """Tell how long to wait for a call; rollouts that are simulated do not tell of frames."""
        pairing = self._pairing
        is_done = pairing is None or len(self._measured) >= len(pairing.frames)
        return None if is_done else _REFRESH

    def _run(self) -> None:
        last_call = time.monotonic()
        is_news = False
        while True:
            with self._condition:
                while not self._is_closed and self._next() is None and not is_news:
                    self._condition.wait(self._patience())
                if self._is_closed:
                    return
                due = self._next()
            try:
                if due is not None:
                    self._measure(*due)
                    is_news = True
                if is_news and (due is None or time.monotonic() - last_call > _REFRESH):
                    last_call, is_news = time.monotonic(), False
                    self._on_change()
            except Exception:
                logger.exception("measuring the difference failed")
                self.follow(None)

    def _measure(self, pairing: Pairing, way: Way, tick: int) -> None:
        first, second = pairing.frames[tick]
        difference = compare_frames(pairing.first, first, pairing.second, second, way)
        with self._condition:
            if self._pairing is pairing and len(self._measured) == tick:
                self._measured.append(difference)
