"""How long a fit is still going to take, from its own reports and from earlier fits."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from app.jobs.timeline import Part, Timeline

_TRUST = {"same": 0.12, "scaled": 0.02}
"""Weight of "as fast as the earlier fits" beside what was seen, as a share of the whole fit."""
_PART_TRUST = {"same": 0.5, "scaled": 0.1}
"""Weight of "this stage is as slow as the others were", as a share of the stage."""


@dataclass(frozen=True)
class Plan:
    """What a fit is expected to go through."""

    parts: tuple[Part, ...]
    """The parts in their order, as long as they are expected to take."""
    closing_s: float
    """What follows on the last report until the results are published [s]."""
    kind: str
    """``same`` if fits with these settings on this device were measured, ``scaled`` if others."""
    count: int
    """How many fits it was taken from."""

    @property
    def seconds(self) -> float:
        """How long the whole fit is expected to take [s]."""
        return sum(part.seconds for part in self.parts) + self.closing_s

    @property
    def basis(self) -> str:
        """What it was taken from, in words."""
        if self.kind == "scaled":
            return "roughly, from fits with other settings or on another machine"
        if self.count == 1:
            return "from an earlier fit with these settings"
        return f"from {self.count} earlier fits with these settings"


@dataclass(frozen=True)
class Estimate:
    """How far a fit is and how long it still takes."""

    left_s: float
    """Until its results are published [s]."""
    stage_left_s: float
    """Until the stage at work has ended [s]."""
    share: float
    """Finished share of the whole time, from 0 to 1."""
    basis: str
    """What it was estimated from, in words."""


def plan_from(timelines: Sequence[tuple[Timeline, float]], kind: str) -> Plan:
    """Make a plan of finished fits: medians of their durations, the course of the newest.

    Args:
        timelines: Each fit with the time of its end [s since the epoch], the newest first.
        kind: See `Plan.kind`.
    """
    newest, _ = timelines[0]
    parts: list[Part] = []
    for part in newest.parts:
        known = [
            other.seconds
            for timeline, _ in timelines
            for other in timeline.parts
            if (other.stage, other.visit) == (part.stage, part.visit)
        ]
        factor = statistics.median(known) / part.seconds if part.seconds > 0 else 1.0
        parts.append(part.stretched(factor))
    closing = statistics.median(max(0.0, end - timeline.end) for timeline, end in timelines)
    return Plan(tuple(parts), closing, kind, len(timelines))


def estimate(plan: Plan, timeline: Timeline, now: float) -> Estimate:
    """Tell how long a fit still takes.

    It is taken to go through the plan at a speed of its own: that at which it went through the
    plan's parts until now, and within a part more and more that of the part itself.

    Args:
        plan: What it is expected to go through.
        timeline: Its reports until now; there may be none yet.
        now: Time now [s since the epoch].
    """
    parts = {(part.stage, part.visit): i for i, part in enumerate(plan.parts)}
    seen = [parts.get((part.stage, part.visit)) for part in timeline.parts]
    spent = planned = 0.0
    for part, index in zip(timeline.parts, seen, strict=True):
        if index is not None:
            took, expected = _since_set_up(part, plan.parts[index])
            spent += took
            planned += expected
    trust = _TRUST[plan.kind] * plan.seconds
    pace = (spent + trust) / (planned + trust) if planned + trust > 0 else 1.0
    stage_left, pause = _left_in_part(plan, timeline, seen, pace)
    following = 1 + max((index for index in seen if index is not None), default=-1)
    later = sum(part.seconds for part in plan.parts[following:]) + plan.closing_s
    if stage_left <= 0.0:
        # The next report is the first one of what follows.
        rest = plan.parts[following : following + 1]
        pause = pace * (rest[0].times[1] if rest else plan.closing_s)
    waited = min(max(0.0, now - timeline.end), pause)
    left = max(0.0, stage_left + pace * later - waited)
    stage_left = max(0.0, stage_left - waited)
    elapsed = max(0.0, now - timeline.begin)
    share = elapsed / (elapsed + left) if elapsed + left > 0 else 1.0
    return Estimate(left, stage_left, share, plan.basis)


def _left_in_part(
    plan: Plan, timeline: Timeline, seen: list[int | None], pace: float
) -> tuple[float, float]:
    """Give what the part at work takes from its last report on, and until the next one [s]."""
    if not timeline.parts:
        return 0.0, 0.0
    part, index = timeline.parts[-1], seen[-1]
    share = part.shares[-1]
    following = min(1.0, share + timeline.step)
    if index is None:
        # No earlier fit had it, so it is taken to go on as it went.
        rest = part.seconds / share if share > 0 else 0.0
        return rest * (1.0 - share), rest * (following - share)
    known = plan.parts[index]
    done = known.time_at(share)
    trust = _PART_TRUST[plan.kind] * known.seconds
    took, expected = _since_set_up(part, known)
    own = (took + trust * pace) / (expected + trust) if expected + trust > 0 else pace
    return own * (known.seconds - done), own * (known.time_at(following) - done)


def _since_set_up(part: Part, known: Part) -> tuple[float, float]:
    """Give how long a part took from its first report to its last, and was expected to [s].

    What goes before (reading files, the first compilation) does not tell how fast the rest goes.
    """
    if len(part.shares) < 3:
        return 0.0, 0.0
    took = part.times[-1] - part.times[1]
    return took, known.time_at(part.shares[-1]) - known.time_at(part.shares[1])
