"""The two runs of a comparison, and notes about the pair."""

import math
from dataclasses import dataclass

from app.viewer.compare.curve import Pairing
from app.viewer.compare.request import CompareAsk
from app.viewer.content.content import Content, ContentSource, open_run_content
from physhandi.data.layout import SequenceFiles
from physhandi.errors import UsageError
from physhandi.run import Run

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """Two runs that are shown together."""

    contents: tuple[Content, Content]
    """Contents of A and B."""
    clock: CompareClock
    """The time that both share."""
    notes: tuple[str, ...]
    """Warnings about the comparison."""
    can_measure: bool
    """Whether the difference means something."""

    @property
    def title(self) -> str:
        """Both names."""
        first, second = self.contents
        return f"{first.title} and {second.title}"


def open_pair(catalog: ContentSource, ask: CompareAsk) -> Pair:
    """Open both runs at a sequence that they share, if there is one.

    Args:
        catalog: Finds the runs.
        ask: Which ones.

    Raises:
        UsageError: If the sequence is not in both; names those that are.
        PhysHandiError: If a run cannot be found or shown.
    """
    first, second = catalog.run(ask.a), catalog.run(ask.b)
    names = chosen_sequences(first, second, ask.sequence)
    contents = (
        open_run_content(catalog, ask.a, names[0]),
        open_run_content(catalog, ask.b, names[1]),
    )
    clock = CompareClock.of(*contents)
    notes: list[str] = []
    if names[0] != names[1]:
        notes.append(
            f"A shows '{names[0]}' and B '{names[1]}', other recordings: hands differ too."
        )
    notes += [clock.note] if clock.note else []
    lacking = [name for name, c in zip("AB", contents, strict=True) if c.fitted is None]
    if lacking:
        has = "have" if len(lacking) == 2 else "has"
        notes.append(f"{' and '.join(lacking)} {has} no fitted object to compare.")
    units = [content.length_unit for content in contents]
    if units[0] != units[1]:
        notes.append(f"A is in {units[0]} and B in {units[1]}: lengths cannot be compared.")
    return Pair(
        contents=contents,
        clock=clock,
        notes=tuple(notes),
        can_measure=not lacking and units[0] == units[1],
    )


def pairing_of(pair: Pair) -> Pairing | None:
    """Tell which rollouts and frames are measured against each other; None if none can be."""
    first, second = (content.fitted for content in pair.contents)
    if not pair.can_measure or first is None or second is None:
        return None
    frames = tuple(pair.clock.frames(tick) for tick in range(pair.clock.tick_count))
    return Pairing(first=first, second=second, frames=frames)


def chosen_sequences(first: Run, second: Run, wanted: str | None) -> tuple[str, str]:
    """Choose what two runs show: the sequence that is wanted, a common one, or the first of each.

    Raises:
        UsageError: If the wanted one is not in both; names those that are.
    """
    shared = [name for name in first.sequence_names if name in second.sequence_names]
    if wanted is not None and wanted not in shared:
        names = ", ".join(shared) or "none"
        raise UsageError(f"sequence: '{wanted[:80]}' is not in both runs. In both: {names}.")
    if wanted is not None or shared:
        name = wanted or next((n for n in shared if _has(first, n) and _has(second, n)), shared[0])
        return name, name
    return first.sequence_names[0], second.sequence_names[0]


def _has(run: Run, name: str) -> bool:
    return run.has(SequenceFiles(name).meta)
