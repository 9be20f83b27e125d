"""What the server remembers of earlier fits, and what it expects of those at work and in line."""

import threading
import time
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

from app.jobs.catalog import Catalog, RunItem
from app.jobs.effort import Extent
from app.jobs.estimate import Estimate, Plan, estimate, plan_from
from app.jobs.reference import Reference, scaled_plan
from app.jobs.timeline import Timeline
from physhandi.data.environment import ENVIRONMENT
from physhandi.data.files import named_fields
from physhandi.data.run_folder import ATTEMPTS, CURRENT, EXIT, OUT, read_events, read_mapping
from physhandi.errors import PhysHandiError
from physhandi.run import Run

_REFERENCES = 5
"""Most earlier fits that one plan is made of."""
_CLOSE = 0.1
"""Fits whose numbers of frames differ by less than this share count as alike."""
_KEPT_S = 10.0
"""How long the list of earlier fits is used before the folders are looked at again."""
_MACHINE = ("device", "device_name", "cpu_count")


class Forecast:
    """Estimates how long fits still take; safe to use from several threads.

    Run folders are its whole memory: every published fit tells when it was how far, on which
    device, with which settings and on how many frames.
    """

    def __init__(self, catalog: Catalog, device: str) -> None:
        """Prepare; nothing is read yet.

        Args:
            catalog: Finds runs and sequences.
            device: Warp device that fits use.
        """
        self._catalog = catalog
        self._device = device
        self._lock = threading.Lock()
        self._references: dict[str, tuple[object, Reference | None]] = {}
        self._listed: list[Reference] = []
        self._listed_at = -_KEPT_S
        self._followed: dict[str, tuple[int, int, Timeline]] = {}
        self._plans: dict[tuple[str, object], Plan | None] = {}

    def of_run(self, run: Run, now: float | None = None) -> Estimate | None:
        """Estimate a run that is at work.

        Args:
            run: The run.
            now: Time now [s since the epoch]; None asks the clock.

        Returns:
            None if it is no fit, has not begun, or no earlier fit is known.
        """
        number = run.attempt
        begun = _begin_of(run, number)
        profile = named_fields(run.config.get("profile"))
        if run.kind != "reconstruction" or begun is None or not profile:
            return None
        with self._lock:
            timeline = self._follow(run, int(number or 0), begun[0])
            plan = self._plan_of(run, profile, begun[1])
            return plan and estimate(plan, timeline, time.time() if now is None else now)

    def of_waiting(self, run: Run) -> Plan | None:
        """Tell what a run that waits in line is expected to go through."""
        profile = named_fields(run.config.get("profile"))
        if run.kind != "reconstruction" or not profile:
            return None
        with self._lock:
            return self._plan_of(run, profile, None)

    def of_order(self, profile: Mapping[str, Any], frame_counts: Sequence[int]) -> Plan | None:
        """Tell what a fit of sequences of so many frames is expected to go through."""
        with self._lock:
            return self._plan(profile, Extent(sum(frame_counts), len(frame_counts)), None)

    def _plan_of(
        self, run: Run, profile: Mapping[str, Any], machine: tuple[Any, ...] | None
    ) -> Plan | None:
        """Make the plan of a run, or give the one that was made of the same earlier fits."""
        self._known()
        key = (str(run.folder), machine)
        if key not in self._plans:
            self._plans[key] = self._plan(profile, self._extent_of(run), machine)
        return self._plans[key]

    def _plan(
        self, profile: Mapping[str, Any], extent: Extent | None, machine: tuple[Any, ...] | None
    ) -> Plan | None:
        references = self._known()
        if extent is None or not references:
            return None
        machine = machine or next(
            (r.machine for r in references if r.machine[0] == self._device), (self._device,)
        )
        same = [
            r
            for r in references
            if r.machine == machine
            and _settings(r.profile) == _settings(profile)
            and r.extent.sequences == extent.sequences
            and abs(r.extent.frames - extent.frames) <= _CLOSE * extent.frames
        ]
        if same:
            return plan_from([(r.timeline, r.end) for r in same[:_REFERENCES]], "same")
        return scaled_plan(references, profile, extent, machine)

    def _known(self) -> list[Reference]:
        """List earlier fits, the newest first."""
        if time.monotonic() - self._listed_at < _KEPT_S:
            return self._listed
        found: dict[str, tuple[object, Reference | None]] = {}
        for item in self._catalog.runs():
            stamp = _stamp_of(item)
            if stamp is None:
                continue
            known = self._references.get(str(item.folder))
            if known is None or known[0] != stamp:
                known = (stamp, self._read(item))
            found[str(item.folder)] = known
        self._references = found
        self._plans.clear()
        references = [reference for _, reference in found.values() if reference is not None]
        self._listed = sorted(references, key=lambda reference: -reference.end)
        self._listed_at = time.monotonic()
        return self._listed

    def _read(self, item: RunItem) -> Reference | None:
        """Read when a finished fit was how far; none if it was interrupted or is damaged."""
        run = item.run
        profile = named_fields(run.config.get("profile")) if run else None
        if run is None or run.kind != "reconstruction" or not profile:
            return None
        try:
            number = int((run.folder / CURRENT).read_text(encoding="ascii"))
            begun, extent = _begin_of(run, number), self._extent_of(run)
            events, _ = read_events(run.folder)
            ended = read_mapping(run.folder / EXIT)
            end = datetime.fromisoformat(str(ended["time"])).timestamp()
        except (PhysHandiError, OSError, ValueError, KeyError):
            return None
        attempts = {event.get("attempt") for event in events}
        if begun is None or extent is None or attempts != {number}:
            return None
        timeline = Timeline(begun[0]).add_all(events)
        return Reference(profile, extent, begun[1], timeline, end) if timeline.parts else None

    def _extent_of(self, run: Run) -> Extent | None:
        """Count the frames of a run's sequences; none if one of them is gone."""
        counts: dict[str, int] = {}
        for item in self._catalog.sequences():
            if item.sequence is not None:
                counts[str(item.folder)] = item.sequence.frame_count
                counts.setdefault(item.sequence.name, item.sequence.frame_count)
        frames = [
            counts.get(folder, counts.get(name))
            for folder, name in zip(run.sequences, run.sequence_names, strict=True)
        ]
        known = [count for count in frames if count is not None]
        return Extent(sum(known), len(known)) if len(known) == len(frames) > 0 else None

    def _follow(self, run: Run, number: int, begin: float) -> Timeline:
        """Take in the reports of the attempt at work that came since the last time."""
        attempt, offset, timeline = self._followed.get(run.id, (-1, 0, Timeline(begin)))
        if attempt != number:
            offset, timeline = 0, Timeline(begin)
        events, offset = read_events(run.folder, offset)
        timeline.add_all(event for event in events if event.get("attempt") == number)
        self._followed[run.id] = (number, offset, timeline)
        if len(self._followed) > 256:
            del self._followed[next(iter(self._followed))]
        return timeline


def _settings(profile: Mapping[str, Any]) -> dict[str, Any]:
    """Give what decides about the work: all settings but the words for people."""
    return {key: value for key, value in profile.items() if key not in {"profile", "description"}}


def _begin_of(run: Run, number: int | None) -> tuple[float, tuple[Any, ...]] | None:
    """Tell when an attempt began [s since the epoch] and on which machine."""
    if number is None:
        return None
    try:
        about = read_mapping(run.folder / ATTEMPTS / str(number) / OUT / ENVIRONMENT)
        started = datetime.fromisoformat(str(about["started"])).timestamp()
    except (PhysHandiError, ValueError, KeyError, OSError):
        return None
    return started, tuple(about.get(name) for name in _MACHINE)


def _stamp_of(item: RunItem) -> tuple[int, int] | None:
    """Summarise what would change with a new result of a run; none if it has no result."""
    try:
        result, end = (item.folder / CURRENT).stat(), (item.folder / EXIT).stat()
    except OSError:
        return None
    return result.st_mtime_ns, end.st_mtime_ns
