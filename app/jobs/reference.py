"""What a finished fit tells about how long others will take."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from app.jobs.effort import Extent, effort_of
from app.jobs.estimate import Plan, plan_from
from app.jobs.timeline import Timeline


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
    parts = [
        part.stretched(
            after[part.stage] / before[part.stage]
            if after.get(part.stage) is not None and before.get(part.stage, 0.0) > 0.0
            else frames
        )
        for part in plan.parts
    ]
    return Plan(tuple(parts), plan.closing_s * frames, plan.kind, plan.count)
