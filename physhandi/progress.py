"""How long work tells what it is doing, and learns that it should stop."""


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

    def check_cancelled(self) -> None:
        """Raise `CancelledError` if the user asked to stop."""


class NullProgress(Progress):
    """Progress of work that nobody watches."""
