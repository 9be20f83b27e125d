"""The clock of one session: which frame is on the screen, and when the next one is due."""

import logging
import math
import threading
import time
from collections.abc import Callable

logger = logging.getLogger(__name__)

_MAX_RATE = 30.0
TURN = threading.Lock()
"""Held by the session that draws, of all sessions: Python runs one of them at a time, and many that
wait for it at once hold each other up until hardly a frame is drawn."""
_SHORT_OF = 1e-3
"""The clock stops so much before a frame that is not ready, which is then due at once."""


class Playback:
    """Plays frames in one thread; everything that draws runs in that thread.

    Setters may be called from any thread; they take effect at the next tick.

    Attributes:
        frame_count: Frames of the sequence.
        frame_rate: Frames per second at speed 1 [Hz].
    """

    def __init__(
        self, frame_count: int, frame_rate: float, draw: Callable[[int, bool], None]
    ) -> None:
        """Prepare a stopped clock.

        Args:
            frame_count: Frames of the sequence.
            frame_rate: Frames per second at speed 1 [Hz].
            draw: Draws a frame; gets its number and whether the clock is running.
        """
        self.frame_count = frame_count
        self.frame_rate = frame_rate
        self._draw = draw
        self._condition = threading.Condition()
        self._position = 0.0
        self._limit = frame_count
        self._part: tuple[int, int] | None = None
        self._speed = 1.0
        self._is_playing = False
        self._is_held = False
        self._does_loop = True
        self._needs_drawing = True
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name="viewer-playback", daemon=True)

    @property
    def frame(self) -> int:
        """The frame that is due now."""
        with self._condition:
            return int(self._position)

    @property
    def is_playing(self) -> bool:
        """Whether the clock is running."""
        with self._condition:
            return self._is_playing

    @property
    def speed(self) -> float:
        """Sequence seconds per second."""
        with self._condition:
            return self._speed

    @property
    def does_loop(self) -> bool:
        """Whether playing starts over at the end."""
        with self._condition:
            return self._does_loop

    @property
    def part(self) -> tuple[int, int] | None:
        """First and last frame of the part that is played; None for all."""
        with self._condition:
            return self._part

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """End the thread and wait for it."""
        with self._condition:
            self._is_closed = True
            self._condition.notify_all()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(timeout=5)

    def redraw(self) -> None:
        """Draw the current frame again soon, for example because a layer was switched."""
        self._change()

    def play(self, *, on: bool = True) -> None:
        """Start or stop the clock; starting outside of the part, or at its end, goes to its begin.

        If playing starts over at the end, it may start at the end as well.
        """
        with self._condition:
            begin, end = self._ends()
            last = end if self._does_loop else end - 1
            if on and not begin <= int(self._position) < last:
                self._position = float(begin)
        self._change(_is_playing=on)

    def hold(self) -> None:
        """Stand at this frame, even if the clock is running, until `release`.

        Nobody is looking yet, and would miss the frames that pass until then.
        """
        self._change(_is_held=True)

    def release(self) -> None:
        """Let a running clock go on from where it was held."""
        if self._is_held:
            self._change(_is_held=False)

    def seek(self, frame: int) -> None:
        """Go to a frame; numbers outside the sequence are moved to its ends."""
        self._change(_position=float(min(max(frame, 0), self.frame_count - 1)))

    def toggle(self) -> None:
        """Start the clock if it stands, stop it if it runs."""
        with self._condition:
            self.play(on=not self._is_playing)

    def step(self, count: int) -> None:
        """Stop, and go some frames forward or, if negative, back."""
        with self._condition:
            self.play(on=False)
            self.seek((self.frame + count) % self.frame_count)

    def set_speed(self, speed: float) -> None:
        """Set how many sequence seconds pass in a second."""
        self._change(_speed=speed)

    def set_loop(self, *, on: bool) -> None:
        """Set whether playing starts over at the end."""
        self._change(_does_loop=on)

    def set_part(self, first: int, last: int) -> None:
        """Set which frames are played; any other can still be gone to.

        Args:
            first: First frame of the part.
            last: Last one, not before the first. Numbers outside the sequence mean its ends.
        """
        last = min(max(last, 0), self.frame_count - 1)
        first = min(max(first, 0), last)
        is_all = (first, last) == (0, self.frame_count - 1)
        with self._condition:
            self._part = None if is_all else (first, last)
        self._change()

    def limit(self, frame_count: int) -> None:
        """Keep the running clock inside the first frames, while later ones are being computed.

        Frames that come to be ready are drawn when the clock reaches them, not before.
        """
        with self._condition:
            is_late = self._is_starved()
            self._limit = min(max(frame_count, 1), self.frame_count)
            if self._limit == self.frame_count:
                self._needs_drawing = True
            if self._needs_drawing or is_late:
                self._condition.notify_all()

    def replace(self, frame_count: int, frame_rate: float) -> None:
        """Start over with another sequence."""
        with self._condition:
            self.frame_count, self.frame_rate = frame_count, frame_rate
            self._part = None
        self._change(_position=0.0, _limit=frame_count)

    def _change(self, **values: float | bool) -> None:
        with self._condition:
            for name, value in values.items():
                setattr(self, name, value)
            self._needs_drawing = True
            self._condition.notify_all()

    def _run(self) -> None:
        last = time.monotonic()
        while True:
            with self._condition:
                while not (self._is_closed or self._needs_drawing or self._is_moving()):
                    self._condition.wait()
                    last = time.monotonic()
                if self._is_closed:
                    return
                now = time.monotonic()
                is_new = self._advance(now - last)
                last = now
                is_due = self._needs_drawing or is_new
                self._needs_drawing = False
                frame, is_playing = int(self._position), self._is_playing
                due = now + self._until_next()
            if is_due:
                try:
                    self._draw(frame, is_playing)
                except Exception:
                    logger.exception("drawing frame %d failed", frame)
            with self._condition:
                if self._is_closed:
                    return
                if not self._needs_drawing:
                    self._condition.wait(max(due - time.monotonic(), 0.001))

    def _until_next(self) -> float:
        """Compute the time until the next frame is drawn [s].

        The time is not a fixed period: its errors would add up until a frame is left out.
        """
        rate = self._speed * self.frame_rate
        if self._is_starved():
            return 1.0 / rate
        step = math.ceil(rate / _MAX_RATE - 1e-9)
        return (int(self._position) + step - self._position) / rate

    def _is_moving(self) -> bool:
        """Return whether frames pass."""
        return self._is_playing and not self._is_held

    def _ends(self) -> tuple[int, int]:
        """Give the first frame that is played, and the one after the last."""
        return (0, self.frame_count) if self._part is None else (self._part[0], self._part[1] + 1)

    def _is_starved(self) -> bool:
        """Return whether the clock waits for a frame that is still being computed."""
        is_limited = self._limit < self._ends()[1]
        return is_limited and self._position >= self._limit - _SHORT_OF

    def _advance(self, elapsed: float) -> bool:
        """Move the clock on; returns whether another frame is due."""
        if not self._is_moving():
            return False
        before = int(self._position)
        position = self._position + min(elapsed, 0.5) * self._speed * self.frame_rate
        begin, end = self._ends()
        if self._limit < end:
            position = min(position, self._limit - _SHORT_OF)
        elif position >= end:
            if self._does_loop:
                position = begin + (position - end) % (end - begin)
            else:
                position, self._is_playing = float(end - 1), False
                self._needs_drawing = True
        self._position = position
        return int(position) != before
