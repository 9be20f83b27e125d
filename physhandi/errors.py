"""Every error that PhysHanDI raises on purpose; its first line is what the user reads."""


class PhysHandiError(Exception):
    """Base of all errors whose message is written for the user."""


class UsageError(PhysHandiError):
    """A command or request was given values that make no sense (exit code 2)."""


class SequenceError(PhysHandiError):
    """A sequence folder breaks the format; the message names sequence, file, frame and field."""


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
