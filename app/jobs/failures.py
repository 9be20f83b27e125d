"""What went wrong with a run, in words for its user."""

import builtins
from dataclasses import dataclass

from physhandi import errors
from physhandi.data.run import Run
from physhandi.data.run_files import EXIT, read_mapping

_ADVICE = {
    "MissingInputError": "Choose a recording that has this part, or import it again with it.",
    "SequenceError": (
        "Repair the named file of the sequence and resume, or import the recording again."
    ),
    "UsageError": "Launch a new fit with a value that the message allows.",
    "FitError": (
        "Look at the recording first: is the hand or object seen in most frames? "
        "Then launch a fit with another profile."
    ),
    "SimulationDivergedError": (
        "Launch a fit with a profile that searches softer springs or takes more substeps."
    ),
    "RunError": "Resume goes on after the last finished stage.",
    "": "Resume goes on after the last finished stage.",
}
_DEFECT = (
    "This is a mistake of the program, not of your recording. Resume tries the stage again; "
    "if it stays, report it together with the downloaded log."
)


@dataclass(frozen=True)
class Failure:
    """Why a run failed."""

    message: str
    """What happened."""
    advice: str
    """What the user can do."""


def explain(run: Run | None, reason: str) -> Failure:
    """Tell why a run failed and what to do.

    Args:
        run: The failed run; None if its folder is damaged.
        reason: What the queue knows of it.
    """
    if run is None:
        return Failure(reason, "Repair the named file, or delete the run's folder.")
    kind = str(read_mapping(run.folder / EXIT).get("error_type", ""))
    if kind in _ADVICE:
        return Failure(reason, _ADVICE[kind])
    if hasattr(errors, kind):
        return Failure(reason, _ADVICE["RunError"])
    if kind == "MemoryError":
        return Failure(
            "There was not enough memory.",
            "End other programs or use a profile with fewer nodes, then resume.",
        )
    known = getattr(builtins, kind, None)
    if isinstance(known, type) and issubclass(known, OSError):
        return Failure(reason, "Check the disk and the data folder, then resume.")
    return Failure(f"The program stopped at a mistake of its own ({kind}: {reason}).", _DEFECT)
