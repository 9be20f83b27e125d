"""Progress of long work, and requests to stop it."""

import sys
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, TextIO

from jaxtyping import Float
from numpy import ndarray

from physhandi.errors import UsageError

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID


@dataclass(frozen=True, kw_only=True, eq=False)
class Preview:
    """Intermediate result of a stage that is running."""

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


class RelayedProgress(Progress):
    """Passes everything on to another one; a subclass changes reports."""

    def __init__(self, progress: Progress) -> None:
        """Pass on to `progress`."""
        self._progress = progress

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,
        message: str = "",
    ) -> None:
        """Pass it on; see `Progress.report`."""
        self._progress.report(stage, iteration, total, loss, message)

    def wants_preview(self) -> bool:
        """Ask the other one."""
        return self._progress.wants_preview()

    def preview(self, make: Callable[[], Preview]) -> None:
        """Pass it on; see `Progress.preview`."""
        self._progress.preview(make)

    def check_cancelled(self) -> None:
        """Ask the other one."""
        self._progress.check_cancelled()


_QUARTERS = 4
_LONGEST_SILENCE_S = 60.0
"""Time after which a line is printed although no further quarter is done [s]."""


class ToldProgress(Progress):
    """Hands reports on, not more often than anybody can read; the end of a stage always.

    What a child process tells its parent by (`physhandi.child.Channel.tell`).
    """

    def __init__(
        self,
        tell: Callable[..., None],
        least_pause_s: float,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Hand on the first report at once.

        Args:
            tell: Is given ``stage``, ``iteration``, ``total`` and ``message`` by name.
            least_pause_s: Time between two reports within a stage [s].
            clock: Tells the time [s].
        """
        self._clock = clock
        self._tell = tell
        self._least_pause_s = least_pause_s
        self._last = 0.0

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,  # noqa: ARG002
        message: str = "",
    ) -> None:
        """Hand it on, if it is time; see `Progress.report`."""
        now = self._clock()
        if iteration >= total or now - self._last >= self._least_pause_s:
            self._last = now
            self._tell(stage=stage, iteration=iteration, total=total, message=message)


class PrintedProgress(Progress):
    """Shows the running stage on standard error: a bar on a terminal, else lines.

    There is a line for each quarter of a stage, and one a minute while that is not reached.
    """

    def __init__(
        self,
        stream: TextIO | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
        has_bar: bool = True,
    ) -> None:
        """Show nothing until the first report.

        Args:
            stream: Where to; standard error if left out.
            clock: Tells the time [s].
            has_bar: Whether there is a bar on a terminal; several at a time would overwrite each
                other.
        """
        self._has_bar = has_bar
        self._clock = clock
        self._line_time = 0.0
        self._stream = sys.stderr if stream is None else stream
        self._stage = ""
        self._quarter = -1
        self._bar: RichProgress | None = None
        self._task: TaskID | None = None

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,
        message: str = "",
    ) -> None:
        """Show a report; see `Progress.report`."""
        words = [] if loss is None else [f"loss {loss:.6g}"]
        text = "  ".join([*words, message] if message else words)
        if self._has_bar and self._stream.isatty():
            self._draw(stage, iteration, total, text)
        else:
            self._write(stage, iteration, total, text, message)

    def finish(self) -> None:
        """End the bar, if there is one, so that what follows stands on a line of its own."""
        if self._bar is not None:
            self._bar.stop()
        self._bar, self._task, self._stage, self._quarter = None, None, "", -1

    def _draw(self, stage: str, iteration: int, total: int, text: str) -> None:
        if self._bar is None:
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
            from rich.progress import Progress as RichProgress

            columns = (
                TextColumn("{task.description:<20}", markup=False),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[text]}", markup=False),
            )
            self._bar = RichProgress(*columns, console=Console(file=self._stream))
            self._bar.start()
        if self._task is None or stage != self._stage:
            self._stage = stage
            self._task = self._bar.add_task(stage, total=total, text=text)
        self._bar.update(self._task, completed=iteration, total=total, text=text)

    def _write(self, stage: str, iteration: int, total: int, text: str, message: str) -> None:
        quarter = _QUARTERS * iteration // max(1, total)
        is_told = (stage, quarter) == (self._stage, self._quarter)
        is_told = is_told and self._clock() - self._line_time < _LONGEST_SILENCE_S
        if is_told and not (message and iteration >= total):
            return
        self._stage, self._quarter, self._line_time = stage, quarter, self._clock()
        count = f" {iteration}/{total}" if total else ""
        self._stream.write(f"{stage}{count}  {text}".rstrip() + "\n")
        self._stream.flush()


ReportFunction = Callable[[str, int, int, float | None, str], object]
"""Is given stage, iteration, total, loss and message, as `Progress.report` is."""
Watcher = Progress | ReportFunction | bool | None
"""Receiver of progress: True prints, a function is called, None and False are nobody."""


class _CalledProgress(Progress):
    def __init__(self, call: ReportFunction) -> None:
        self._call = call

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,
        message: str = "",
    ) -> None:
        self._call(stage, iteration, total, loss, message)


@contextmanager
def watched(watcher: Watcher) -> Generator[Progress]:
    """Turn what a user asks for as ``progress=`` into a `Progress` for as long as work goes on.

    Raises:
        UsageError: If it is none of what `Watcher` may be.
    """
    if isinstance(watcher, Progress):
        yield watcher
    elif watcher is True:
        printed = PrintedProgress()
        try:
            yield printed
        finally:
            printed.finish()
    elif watcher is None or watcher is False:
        yield NullProgress()
    elif callable(watcher):
        yield _CalledProgress(watcher)
    else:
        raise UsageError(f"progress is {watcher!r}; expected True, False or a function.")
