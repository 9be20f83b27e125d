"""When a fit was how far: its reports laid out as a sequence of parts with a clock each."""

from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(kw_only=True)
class Part:
    """One visit of a stage, from the report before it to its last one."""

    stage: str
    """Name of the stage."""
    visit: int
    """How often the stage was begun before: with two sequences a stage is visited twice."""
    shares: list[float] = field(default_factory=lambda: [0.0])
    """Finished shares of the part that were reported, growing from 0."""
    times: list[float] = field(default_factory=lambda: [0.0])
    """When each share was reached, counted from the part's begin [s]."""

    @property
    def seconds(self) -> float:
        """How long the part took, or has taken until its last report [s]."""
        return self.times[-1]

    def time_at(self, share: float) -> float:
        """Tell when a share was finished, counted from the part's begin [s].

        Between reports time is shared out evenly. What a report of no progress took (setting up)
        counts as spent by then.
        """
        after = bisect_right(self.shares, share)
        if after == len(self.shares):
            return self.times[-1]
        first, last = self.shares[after - 1], self.shares[after]
        way = (share - first) / (last - first)
        return self.times[after - 1] + way * (self.times[after] - self.times[after - 1])

    def stretched(self, factor: float, *, set_up: float | None = None) -> "Part":
        """Give the part as if everything in it took so many times as long.

        Args:
            factor: How many times as long.
            set_up: How many times as long what goes before the first report takes; none if that
                is no exception.
        """
        set_up = factor if set_up is None else set_up
        first = self._set_up()
        times = [factor * max(0.0, time - first) + set_up * min(time, first) for time in self.times]
        return Part(stage=self.stage, visit=self.visit, shares=self.shares, times=times)

    def _set_up(self) -> float:
        """Tell how long it took before the work of the first report began [s]."""
        if len(self.times) < 3:
            return 0.0
        pace = (self.times[-1] - self.times[1]) / max(self.shares[-1] - self.shares[1], 1e-9)
        return max(0.0, self.times[1] - pace * self.shares[1])

    def bent(self, knee: float, to: float, factors: tuple[float, float]) -> "Part":
        """Give a part of two halves that each take another time, as a stage with two loops has.

        Args:
            knee: Share at which the first half ended.
            to: Share at which it is going to end.
            factors: How many times as long each half is going to take.
        """
        bend = self.time_at(knee)
        shares, times = [0.0], [0.0]
        for share, time in [*zip(self.shares, self.times, strict=True), (knee, bend)]:
            if share <= knee:
                shares.append(share / knee * to)
                times.append(factors[0] * min(time, bend))
            else:
                shares.append(to + (share - knee) / (1.0 - knee) * (1.0 - to))
                times.append(factors[0] * bend + factors[1] * (time - bend))
        return Part(
            stage=self.stage, visit=self.visit, shares=sorted(shares[1:]), times=sorted(times[1:])
        )


class Timeline:
    """The parts of one attempt, as its reports come in."""

    def __init__(self, begin: float) -> None:
        """Prepare.

        Args:
            begin: When the attempt began [s since the epoch].
        """
        self.begin = begin
        self.end = begin
        """Time of the latest report [s since the epoch]."""
        self.parts: list[Part] = []
        self.step = 0.0
        """How much of its part the latest report finished."""
        self._part_begin = begin

    def add(self, report: Mapping[str, Any]) -> None:
        """Take in the next report; a stage that starts over begins a new part.

        A line of the log that is no whole report is passed over.
        """
        stage, time = str(report.get("stage", "")), report.get("time")
        iteration, total = report.get("iteration"), report.get("total")
        numbers = [v for v in (time, iteration, total) if isinstance(v, int | float)]
        if not stage or len(numbers) < 3:
            return
        time, iteration, total = numbers
        share = min(1.0, max(0.0, iteration / max(1, total)))
        part = self.parts[-1] if self.parts else None
        if part is None or part.stage != stage or share < part.shares[-1]:
            visit = sum(other.stage == stage for other in self.parts)
            part = Part(stage=stage, visit=visit)
            self.parts.append(part)
            self._part_begin = self.end
        self.step = share - part.shares[-1]
        passed = max(time - self._part_begin, part.times[-1])
        if part.shares[-1] == share and len(part.shares) > 1:
            part.times[-1] = passed  # It says the same again, later.
        else:
            part.shares.append(share)
            part.times.append(passed)
        self.end = max(time, self.end)

    def add_all(self, reports: Iterable[Mapping[str, Any]]) -> "Timeline":
        """Take in several reports, and return this timeline."""
        for report in reports:
            self.add(report)
        return self
