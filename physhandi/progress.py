"""How long work tells what it is doing, and learns that it should stop."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from jaxtyping import Float
from numpy import ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class Preview:
    """What a stage has in hand at the moment, to be looked at while it goes on."""

    stage: str
    """Name of the stage."""
    sequence: str
    """Name of the sequence that is shown."""
    loss: float
    """Loss of what is shown."""
    frame_rate: float
    """Frames a second [Hz]."""
    points: Mapping[str, Float[ndarray, "frame _ 3"]]
    """Moving points by what they are: ``object control seen`` or ``joints``, which are 21 for each
    hand. NaN where a point is not known in a frame [m]."""


class Progress:
    """Receives the state of a running stage; the base class ignores it.

    Long loops call `report` once an iteration. Subclasses may raise
    `CancelledError` from `check_cancelled` when the user asked to stop.
    """

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,
        message: str = "",
    ) -> None:
        """Tell that `iteration` of `total` of a stage is finished.

        Args:
            stage: Name of the stage, for example ``"hand_reconstruction"``.
            iteration: Finished iterations.
            total: Iterations that the stage is going to need.
            loss: Loss after this iteration, if the stage has one.
            message: One line for the user.
        """

    def wants_preview(self) -> bool:
        """Tell whether somebody would look at a preview now; making one costs time."""
        return False

    def preview(self, make: Callable[[], Preview]) -> None:
        """Show what the stage has in hand.

        Args:
            make: Gives what is shown; the time that it takes counts as the preview's.
        """

    def check_cancelled(self) -> None:
        """Raise `CancelledError` if the user asked to stop."""


class NullProgress(Progress):
    """Progress of work that nobody watches."""
