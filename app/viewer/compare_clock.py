"""One clock for two recordings that may differ in length and frame rate."""

import math
from dataclasses import dataclass

from app.viewer.content import Content

_ROUNDING = 1e-6


@dataclass(frozen=True, kw_only=True)
class CompareClock:
    """Shows both sides at the same time after their first frame, as long as both have one.

    It ticks as fast as the faster recording; the slower one shows the frame that is nearest.
    """

    rates: tuple[float, float]
    """Frames per second of both sides [Hz]."""
    counts: tuple[int, int]
    """Number of frames of both sides."""

    @classmethod
    def of(cls, first: Content, second: Content) -> "CompareClock":
        """Make the clock of two contents."""
        return cls(
            rates=(first.frame_rate, second.frame_rate),
            counts=(first.frame_count, second.frame_count),
        )

    @property
    def rate(self) -> float:
        """Ticks per second [Hz]."""
        return max(self.rates)

    @property
    def durations(self) -> tuple[float, float]:
        """Time from the first to the last frame of both sides [s]."""
        first, second = ((n - 1) / rate for n, rate in zip(self.counts, self.rates, strict=True))
        return first, second

    @property
    def tick_count(self) -> int:
        """Number of ticks at which both sides have a frame."""
        return math.floor(min(self.durations) * self.rate + _ROUNDING) + 1

    def frames(self, tick: int) -> tuple[int, int]:
        """Find the frames of both sides that are shown at a tick."""
        seconds = tick / self.rate
        first, second = (
            min(math.floor(seconds * rate + 0.5 + _ROUNDING), count - 1)
            for rate, count in zip(self.rates, self.counts, strict=True)
        )
        return first, second

    @property
    def note(self) -> str:
        """Say what is not the same on both sides and what follows; empty if all is."""
        parts: list[str] = []
        if self.rates[0] != self.rates[1]:
            a, b = self.rates
            parts.append(f"A has {a:g} and B {b:g} frames/s; equal times are shown together.")
        if abs(self.durations[0] - self.durations[1]) > 0.5 / self.rate:
            a, b = self.durations
            parts.append(f"A lasts {a:.3g} s and B {b:.3g} s; the common {min(a, b):.3g} s play.")
        return " ".join(parts)
