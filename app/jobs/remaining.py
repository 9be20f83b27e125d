"""What pages say about the time that a run still takes."""

from typing import Any

from app.jobs.estimate import Estimate
from app.jobs.forecast import Forecast
from app.jobs.scheduler import JobView, Scheduler
from physhandi.run import Run


def with_time(
    described: dict[str, Any], run: Run | None, view: JobView, scheduler: Scheduler
) -> dict[str, Any]:
    """Add to a run's description how long it still takes.

    Args:
        described: What `describe_run` says of it.
        run: The run; None if it is damaged.
        view: How far the queue says it is.
        scheduler: Knows what is at work and in line.

    Returns:
        The description with ``estimate`` (see `time_of_running` and `time_of_waiting`, else none)
        and, as ``eta_s`` of its ``progress``, the time that the stage at work still takes.
    """
    estimate = None
    if run is not None and view.state in {"starting", "running"}:
        estimate = time_of_running(run, scheduler.forecast)
    elif run is not None and view.state == "queued":
        line = scheduler.in_line()
        ids = [other.id for other in line]
        if run.id in ids:
            ahead, busy = line[: ids.index(run.id)], scheduler.at_work()
            estimate = time_of_waiting(run, ahead, busy, scheduler.slots, scheduler.forecast)
    progress = dict(described["progress"])
    if progress and estimate and "stage_left_s" in estimate:
        progress["eta_s"] = estimate["stage_left_s"]
    return described | {"estimate": estimate, "progress": progress}


def time_of_running(run: Run, forecast: Forecast) -> dict[str, Any] | None:
    """Describe how far a run at work is.

    Returns:
        ``left_s stage_left_s share basis`` (see `Estimate`); none if nothing is known.
    """
    found = forecast.of_run(run)
    return None if found is None else _rounded(found)


def time_of_waiting(
    run: Run, ahead: list[Run], at_work: list[Run], slots: int, forecast: Forecast
) -> dict[str, Any] | None:
    """Describe when a run in line is going to begin and to end.

    Args:
        run: The run that waits.
        ahead: Those before it in line.
        at_work: Those that have a place.
        slots: How many have a place at a time.
        forecast: Knows earlier fits.

    Returns:
        ``starts_in_s``, ``left_s`` until it has ended and ``basis``; none if nothing is known of
        one of them.
    """
    plan = forecast.of_waiting(run)
    free: list[float] = []
    for other in at_work:
        found = forecast.of_run(other)
        expected = forecast.of_waiting(other)
        if found is None and expected is None:
            return None
        free.append(found.left_s if found else expected.seconds if expected else 0.0)
    free += [0.0] * (slots - len(free))
    for other in ahead:
        expected = forecast.of_waiting(other)
        if expected is None:
            return None
        free.sort()
        free[0] += expected.seconds
    if plan is None:
        return None
    start = min(free)
    return {
        "starts_in_s": float(round(start)),
        "left_s": float(round(start + plan.seconds)),
        "basis": plan.basis,
    }


def _rounded(found: Estimate) -> dict[str, Any]:
    """Leave out digits that nobody reads, so that what is shown changes once a second."""
    return {
        "left_s": float(round(found.left_s)),
        "stage_left_s": float(round(found.stage_left_s)),
        "share": round(found.share, 3),
        "basis": found.basis,
    }
