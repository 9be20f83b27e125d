"""Where a run is on its way through the stages."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

from app.jobs.scheduler import AT_WORK
from physhandi.data.atomic import named_fields
from physhandi.data.environment import ENVIRONMENT
from physhandi.data.run import Run
from physhandi.fitting.stage_names import SIMULATION, STAGES


@dataclass(frozen=True)
class StageView:
    """One stage of a run, for people."""

    name: str
    """Name of the stage."""
    state: str
    """``done``, ``passed`` (nothing to do), ``at-work``, ``failed``, ``stopped`` or ``to-come``."""
    seconds: float | None = None
    """How long it took, or has taken so far."""
    before: float | None = None
    """Loss at its start."""
    after: float | None = None
    """Loss at its end."""
    note: str = ""
    """What there is to know about how it ended."""


def stages_of(run: Run, state: str) -> list[dict[str, Any]]:
    """Tell for each stage of a run how far it is.

    Args:
        run: The run.
        state: State of the run, as the queue knows it.
    """
    if run.attempt is None:
        return [asdict(StageView(name, "to-come")) for name in _names(run.kind)]
    finished = run.stages()
    progress = run.progress
    is_current = progress.get("attempt") == run.attempt
    latest = str(progress["stage"]) if is_current else None
    views = stage_views(_names(run.kind), finished, state, latest)
    begun = _running_since(run, finished)
    now = datetime.now(UTC).timestamp()
    return [
        asdict(view)
        | ({"seconds": now - begun} if view.state == "at-work" and begun is not None else {})
        for view in views
    ]


def stage_views(
    names: Sequence[str],
    finished: Sequence[Mapping[str, Any]],
    state: str,
    latest: str | None,
) -> list[StageView]:
    """Tell for each stage whether it is done, at work, failed, stopped or still to come.

    A stage that was passed over because the sequences lack what it needs is left out.

    Args:
        names: Stages that such a run usually has, in their order.
        finished: Finished stages: ``name summary``, and ``seconds`` if they were measured.
        state: State of the run.
        latest: Stage of the latest report of this attempt.
    """
    done: dict[str, Mapping[str, Any]] = {str(stage["name"]): stage for stage in finished}
    known: list[str] = [*names, *done, *([latest] if latest else [])]
    order = list(dict.fromkeys(known))
    last_done = max((order.index(name) for name in done), default=-1)
    # A stage may fail before it reports anything: then it is the one after the last finished.
    current = latest if latest and latest not in done else next(iter(order[last_done + 1 :]), None)
    mark = (
        "at-work" if state in AT_WORK else {"failed": "failed", "cancelled": "stopped"}.get(state)
    )
    views: list[StageView] = []
    for position, name in enumerate(order):
        if name in done:
            summary = named_fields(done[name].get("summary")) or {}
            views.append(
                StageView(
                    name,
                    "done" if _has_worked(name, done[name]) else "passed",
                    done[name].get("seconds"),
                    summary.get("before"),
                    summary.get("after"),
                    str(summary.get("note", "")),
                )
            )
        elif state != "succeeded" and name == current and mark:
            views.append(StageView(name, mark))
        elif state != "succeeded" and position > last_done:
            views.append(StageView(name, "to-come"))
    return views


def _has_worked(name: str, finished: Mapping[str, Any]) -> bool:
    """Tell whether a stage had anything to do: those of hands write nothing of hands if not."""
    files = named_fields(finished.get("files"))
    if files is None or not name.startswith("hand_"):
        return True
    if not files:  # Stage 1 notes at least which sequences there are.
        return name != "hand_refinement"
    return any("/hand_" in file for file in files)


def _names(kind: str) -> list[str]:
    return [SIMULATION] if kind == "simulation" else list(STAGES)


def _running_since(run: Run, finished: Sequence[Mapping[str, Any]]) -> float | None:
    """When the stage that is at work began: at the end of the one before, or of this attempt."""
    environment = named_fields(run.json(ENVIRONMENT)) if run.has(ENVIRONMENT) else None
    times = [(environment or {}).get("started"), *(stage.get("time") for stage in finished[-1:])]
    known = [datetime.fromisoformat(time).timestamp() for time in times if isinstance(time, str)]
    return max(known, default=None)
