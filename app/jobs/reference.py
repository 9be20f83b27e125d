"""What a finished fit tells about how long others will take."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from app.jobs.effort import Extent, effort_of, hand_halves
from app.jobs.estimate import Plan, plan_from
from app.jobs.timeline import Part, Timeline
from physhandi.fitting.config import HANDS


@dataclass(frozen=True)
class Reference:
    """A finished fit, and when it was how far."""

    profile: Mapping[str, Any]
    """Its settings, as a run stores them."""
    extent: Extent
    """What it looked at."""
    machine: tuple[Any, ...]
    """Device, what that calls itself, and the number of processors."""
    timeline: Timeline
    """When it was how far."""
    end: float
    """When its results were published [s since the epoch]."""


def scaled_plan(
    references: Sequence[Reference],
    profile: Mapping[str, Any],
    extent: Extent,
    machine: tuple[Any, ...],
) -> Plan:
    """Stretch the stages of the fit that is most alike by how much more work they are.

    Args:
        references: Earlier fits, at least one; of equally alike ones the first is taken.
        profile: Settings of the fit to plan.
        extent: What it looks at.
        machine: What it runs on, as `Reference.machine`.
    """

    def likeness(reference: Reference) -> tuple[bool, bool, bool]:
        return (
            reference.machine == machine,
            reference.profile.get("profile") == profile.get("profile"),
            reference.extent.sequences == extent.sequences,
        )

    nearest = max(references, key=likeness)
    plan = plan_from([(nearest.timeline, nearest.end)], "scaled")
    before, after = effort_of(nearest.profile, nearest.extent), effort_of(profile, extent)
    frames = extent.frames / max(1, nearest.extent.frames)
    halves = hand_halves(nearest.profile, nearest.extent)
    own_halves = hand_halves(profile, extent)
    parts: list[Part] = []
    for part in plan.parts:
        old, new = before.get(part.stage, 0.0), after.get(part.stage)
        if part.stage == HANDS and halves and own_halves:
            factors = own_halves[1] / halves[1], own_halves[2] / halves[2]
            parts.append(part.bent(halves[0], own_halves[0], factors))
        else:
            factor = new / old if new is not None and old > 0.0 else frames
            parts.append(part.stretched(factor, set_up=frames))
    return Plan(tuple(parts), plan.closing_s * frames, plan.kind, plan.count)
