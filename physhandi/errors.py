"""Every error that PhysHanDI raises on purpose; its first line is what the user reads."""

import errno
import os
import re
from collections.abc import Mapping

_REMEDIES = {
    errno.ENOSPC: "Free some space on this disk, or choose another folder",
    errno.EDQUOT: "Free some of your quota on this disk, or choose another folder",
    errno.EACCES: "Choose a place that you may use, or change its permissions",
    errno.EPERM: "Choose a place that you may use, or change its permissions",
    errno.EROFS: "Choose a place that can be written to",
    errno.ENOTDIR: "There is a file where a folder is needed; choose another place",
    errno.EEXIST: "There is a file where a folder is needed; choose another place",
    errno.EISDIR: "There is a folder where a file is needed; choose another place",
    errno.EFBIG: "This disk, or a limit of this process, allows no larger file",
    errno.ENOENT: "Check the path",
}
# What is written beside its place at first is told by the name of the place.
_TEMPORARY = re.compile(r"\.([^/]+)\.\w+-\d+-[0-9a-f]{8}\.tmp")


def describe(error: BaseException) -> str:
    """Put an error into words for the user; the operating system's get their file and a remedy."""
    if not isinstance(error, OSError) or error.errno is None:
        return str(error) or type(error).__name__
    reason = error.strerror or os.strerror(error.errno)
    has_name = isinstance(error.filename, str | bytes | os.PathLike)
    where = _TEMPORARY.sub(r"\1", os.fsdecode(error.filename)) + ": " if has_name else ""
    remedy = _REMEDIES.get(error.errno)
    return f"{where}{reason}." + (f" {remedy}." if remedy else "")


class PhysHandiError(Exception):
    """Base of all errors whose message is written for the user."""


class UsageError(PhysHandiError):
    """A command or request was given values that make no sense (exit code 2)."""


class SettingsError(UsageError):
    """Some settings of a fit make no sense; all of them are named at once."""

    def __init__(self, fields: Mapping[str, str]) -> None:
        """Tell what is wrong.

        Args:
            fields: For each setting what is wrong with it, as a sentence.
        """
        self.fields = dict(fields)
        """For each setting what is wrong with it."""
        super().__init__(" ".join(self.fields.values()))


class SequenceError(PhysHandiError):
    """A sequence folder breaks the format; the message names sequence, file, frame and field.

    Attributes:
        file: File or folder below that of the sequence; empty where no single one is to blame.
        frame: Frame of it.
        field: Field of ``sequence.yaml``, or place in an array.
        remedy: What to do, as part of a sentence.
    """

    def __init__(
        self,
        message: str,
        *,
        file: str = "",
        frame: int | None = None,
        field: str = "",
        remedy: str = "",
    ) -> None:
        super().__init__(message)
        self.file = file
        self.frame = frame
        self.field = field
        self.remedy = remedy


class RunError(PhysHandiError):
    """A run folder is missing, damaged or in use."""


class ImportFailedError(PhysHandiError):
    """A foreign recording could not be converted into a sequence."""


class MissingInputError(PhysHandiError):
    """A stage needs a part of the sequence that is not there."""


class FitError(PhysHandiError):
    """An optimisation could not produce a usable result."""


class CancelledError(PhysHandiError):
    """The user asked for the work to stop."""


class SimulationError(PhysHandiError):
    """The parameters ask for more than the simulator can hold; names the one to change."""


class SimulationDivergedError(PhysHandiError):
    """A node left the range of sane motion; names frame, substep and node.

    Attributes:
        frame: Frame in which it happened.
        substep: Substep of that frame.
        node: Object node that went wrong first.
    """

    def __init__(self, message: str, *, frame: int, substep: int, node: int) -> None:
        super().__init__(message)
        self.frame = frame
        self.substep = substep
        self.node = node
