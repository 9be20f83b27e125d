"""A run's ticket: its place in line, and how often it was started, as its folder keeps it."""

import hashlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import msgspec

from physhandi.data.files import write_json
from physhandi.data.lease import live_holder, locked
from physhandi.data.run_folder import (
    CANCEL,
    EXIT,
    RESERVE,
    Text,
    WholeNumber,
    is_filled,
    now,
    read_record,
)
from physhandi.errors import RunError
from physhandi.typed import to_typed

QUEUED = "queued.json"
"""File in a run's folder that puts it into the queue; the queue survives a restart."""
STARTED = "started.json"
"""File of a run that the queue has started and that has not ended."""
MOST_STARTS = 2
"""Most starts of a run that loses its process through no fault of its own."""

Priority = Literal["low", "normal", "high"]
_EARLIER_S = {"low": -86_400.0, "normal": 0.0, "high": 86_400.0}
"""By how much a run of each priority counts as put in line earlier than it was [s]."""


@dataclass(frozen=True)
class Ticket:
    """Entry of the queue for a run that waits or is at work."""

    time: float = 0.0
    """Time at which it was put in line [s since 1970]."""
    starts: int = 0
    """Number of times that it was started."""
    why: str = ""
    """Why it was started again."""
    device: str = ""
    """Warp device that it was started on."""
    engine: str = ""
    """Name of the engine that it was started with; see `Engine.name`."""
    priority: Priority = "normal"
    """Its priority."""
    who: str = ""
    """`Visitor.name` of who asked for it; empty if unknown."""

    @property
    def turn(self) -> float:
        """Sort key of the queue [s since 1970]; it is constant while the run waits.

        One of high priority passes those of normal priority that came up to a day before it, and
        nothing that came earlier, so that whoever has waited for long enough is passed by nobody.
        """
        return self.time - _EARLIER_S[self.priority]

    @property
    def remark(self) -> str:
        """Sentence about earlier starts; empty for a run that is started for the first time."""
        if not self.why:
            return ""
        return f"{self.why} It was started again ({self.starts} of {MOST_STARTS})."


_Field = TypeVar("_Field")


def read_ticket(path: Path) -> Ticket | None:
    """Read a ticket; None if there is none. Fields that are damaged are as in a new one."""
    try:
        if (content := read_record(path, dict[str, Any])) is None:
            return None
    except RunError:
        return Ticket()
    priority = content.get("priority")
    return Ticket(
        time=_field_of(content, "time", float, 0.0),
        starts=_field_of(content, "starts", WholeNumber, 0),
        why=_field_of(content, "why", Text, ""),
        device=_field_of(content, "device", Text, ""),
        engine=_field_of(content, "engine", Text, ""),
        priority=next((level for level in get_args(Priority) if level == priority), "normal"),
        who=_field_of(content, "who", Text, ""),
    )


def _field_of(content: dict[str, Any], name: str, kind: Any, otherwise: _Field) -> _Field:
    """Take a field if it is what it has to be."""
    try:
        return to_typed(content.get(name), kind)
    except msgspec.ValidationError:
        return otherwise


def nonce_of(run_folder: Path, ticket: Ticket) -> str:
    """Name one start of a run; who starts it twice by mistake gives both the same name."""
    text = f"{run_folder}:{ticket.time!r}:{ticket.starts}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def put_in_line(run_folder: Path, ticket: Ticket) -> None:
    """Put a run in line."""
    write_json(run_folder / QUEUED, asdict(ticket))


def change_priority(run_folder: Path, priority: Priority) -> Ticket | None:
    """Give a run in line another priority; returns its ticket, None if it is not in line."""
    with locked(run_folder):  # Its supervisor may take it out of line just now.
        ticket = read_ticket(run_folder / QUEUED)
        if ticket is None:
            return None
        changed = replace(ticket, priority=priority)
        put_in_line(run_folder, changed)
        return changed


def note_start(run_folder: Path, device: str, engine: str = "") -> Ticket:
    """Note that a run is about to be started once more; it stays in line until it has begun."""
    ticket = read_ticket(run_folder / QUEUED) or Ticket()
    started = replace(ticket, starts=ticket.starts + 1, device=device, engine=engine)
    write_json(run_folder / STARTED, asdict(started))
    return started


def is_begun(run_folder: Path) -> bool:
    """Tell whether the next start of a run in line was noted already.

    A server noted it that was killed before it could take the run out of line, or whose wish was
    not answered.
    """
    queued, started = read_ticket(run_folder / QUEUED), read_ticket(run_folder / STARTED)
    return (
        queued is not None
        and started is not None
        and (queued.time, queued.starts + 1) == (started.time, started.starts)
    )


def begin_start(run_folder: Path, nonce: str) -> bool:
    """Take a run out of line because its start has begun.

    Args:
        run_folder: The run.
        nonce: Name of the start.

    Returns:
        Whether it may go on. It may not if the run is to end, has ended or was started anew since:
        a cluster may begin a job long after it was cancelled.
    """
    with locked(run_folder):
        ticket = read_ticket(run_folder / STARTED)
        is_valid = ticket is not None and nonce_of(run_folder, ticket) == nonce
        if not is_valid or (run_folder / CANCEL).exists():
            return False
        # A server that was killed just now has not done so.
        (run_folder / QUEUED).unlink(missing_ok=True)
        (run_folder / EXIT).unlink(missing_ok=True)
    return True


def start_again_or_end(run_folder: Path, why: str) -> None:
    """Put a run that lost its process back to its old place, once; then it has failed.

    Args:
        run_folder: The run; nothing of it is at work any more.
        why: How it lost its process, as a sentence.
    """
    ticket = read_ticket(run_folder / STARTED) or Ticket(starts=MOST_STARTS)
    if any((run_folder / mark).exists() for mark in (EXIT, CANCEL)) or is_filled(run_folder):
        note_end(run_folder, why)
    elif ticket.starts < MOST_STARTS:
        put_in_line(run_folder, replace(ticket, why=why))
    else:
        times = "twice" if MOST_STARTS == 2 else f"{MOST_STARTS} times"
        note_end(run_folder, f"{why} That happened {times}, so it is not started again.")


def note_end(run_folder: Path, error: str, kind: str = "") -> None:
    """Write how a run ended for a worker that could not; what it wrote itself stays.

    Args:
        run_folder: The run.
        error: What went wrong; a run that was to be cancelled is cancelled whatever it is, and one
            whose results are published has succeeded.
        kind: Name of the error's class, if it is known.
    """
    is_cancelled = (run_folder / CANCEL).exists()
    with locked(run_folder):
        if live_holder(run_folder) is not None:
            return
        (run_folder / RESERVE).unlink(missing_ok=True)
        if not (run_folder / EXIT).is_file():
            end: dict[str, str] = {"state": "failed", "error": error, "error_type": kind}
            if is_filled(run_folder):
                end = {"state": "succeeded"}
            elif is_cancelled:
                end = {"state": "cancelled", "error": "Cancelled.", "error_type": ""}
            write_json(run_folder / EXIT, {**end, "time": now()})
        (run_folder / STARTED).unlink(missing_ok=True)


def is_lost(run_folder: Path) -> bool:
    """Tell whether a run was started and is neither in line nor ended; if nobody works on it."""
    return (
        (run_folder / STARTED).is_file()
        and not (run_folder / QUEUED).is_file()
        and not (run_folder / EXIT).is_file()
    )
