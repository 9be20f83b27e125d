"""A suite's pieces of work on a Ray cluster: a job for each.

``python -m app.cli.suite_jobs FOLDER DEVICE BEAT_S`` does one piece, started by its supervisor.
"""

import shutil
import signal
import time
from collections import deque
from collections.abc import Iterator, Mapping
from collections.abc import Sequence as Many
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Final

from app.cli.suite_work import Piece, PieceWorker, fill_with, make_with, told_of
from app.jobs.engines.following import FollowedRun, end_all
from app.jobs.engines.ray_engine import RayEngine
from physhandi.child import Channel, run_child
from physhandi.data.environment import describe_environment
from physhandi.data.files import write_json
from physhandi.data.lease import Lease, locked
from physhandi.data.run_folder import (
    CANCEL,
    EXIT,
    PROGRESS,
    ExitFile,
    now,
    read_mapping,
    read_record,
)
from physhandi.devices import describe_device
from physhandi.errors import CancelledError, RunError, UsageError
from physhandi.progress import Progress
from physhandi.synthetic.code_version import PREDICTIONS, SCORES, code_version

if TYPE_CHECKING:
    from physhandi.synthetic.suite.evaluation import Fill, Order
    from physhandi.synthetic.suite.suite import Making

SUITE_WORKER: Final = "app.cli.suite_jobs"
_REQUEST, _ENVIRONMENT = "request.json", "environment.json"
_INTERVAL_S = 0.2
_TELL_EVERY_S = 0.5
_BEAT_S = 5.0
_SAME = ("device_name", "system", "python", "packages", "code")
"""Properties that all machines that compute cells of one table must share."""


class SuiteJobs:
    """The jobs of one command; when it is over, none is left on the cluster.

    A job is found again by the next command if this one is killed. What happens to lost nodes and
    processes is as for fits: a piece is started once more, and lost if that is lost too.
    """

    def __init__(
        self, engine: RayEngine, out: Path, progress: Progress, *, most: int, grace_s: float
    ) -> None:
        """Prepare.

        Args:
            engine: Its worker is `SUITE_WORKER`.
            out: Folder of the suite, which has the same path on all nodes.
            progress: Told what the jobs do; may ask to stop.
            most: How many jobs there are at a time.
            grace_s: Time that a job has to end by itself [s].
        """
        self._engine = engine
        self._folder = out.resolve() / "jobs"
        self._progress = progress
        self._most = most
        self._grace_s = grace_s

    def environment(self) -> dict[str, Any]:
        """Find out what nodes compute with, as `describe_environment` tells it, and ``code``.

        Raises:
            UsageError: If it is another version of the program than this one.
        """
        code = code_version((*PREDICTIONS, *SCORES))
        target = self._folder / _ENVIRONMENT
        request = {"look": str(target), "code": code}
        piece = Piece(number=0, label="the nodes", request=request, key=code[:12])
        for _, lost in self._done("cluster", [piece]):
            if lost:
                raise RunError(f"No node could tell what it computes with. {lost}")
        return read_mapping(target)

    def make(self, makings: "Mapping[Path, Making]") -> None:
        """Make sequences of a suite; see `make_with`."""
        make_with(self._done, makings)

    def fill(self, order: "Order", out: Path) -> "Fill":
        """Give what fills the cells of an order; see `fill_with`."""
        return fill_with(self._done, order, out)

    def _done(self, stage: str, pieces: Many[Piece]) -> Iterator[tuple[int, str]]:
        """Have pieces done; see `Done`."""
        waiting, active = deque(pieces), dict[int, tuple[Piece, FollowedRun]]()
        finished = 0
        try:
            while waiting or active:
                self._progress.check_cancelled()
                self._engine.refresh()
                while waiting and len(active) < self._most:
                    piece = waiting.popleft()
                    active[piece.number] = piece, self._followed(piece)
                for number, (_, run) in list(active.items()):
                    if run.look():
                        del active[number]
                        lost = _settled(run)
                        finished += 1
                        yield number, lost
                states = [told_of(piece.label, run.report()) for piece, run in active.values()]
                self._progress.report(stage, finished, len(pieces), message=" · ".join(states))
                time.sleep(_INTERVAL_S)
        finally:
            runs = [run for _, run in active.values()]
            if runs:
                end_all(runs, self._engine, self._progress, self._grace_s)
            for run in runs:
                run.close()

    def _followed(self, piece: Piece) -> FollowedRun:
        name = "".join(c if c.isalnum() else "_" for c in piece.label)
        folder = self._folder / f"{name[:40]}-{piece.key}"
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / _REQUEST).is_file():
            write_json(folder / _REQUEST, dict(piece.request))
        return FollowedRun(folder, self._engine)


def _settled(run: FollowedRun) -> str:
    """Clear away the job of a piece that was done; says why if it was lost.

    Raises:
        PhysHandiError: What the job found wrong.
    """
    with run:
        end = read_record(run.folder / EXIT, ExitFile)
        is_lost = end is not None and end["state"] == "failed" and not end.get("error_type")
        if end is not None and (is_lost or end.get("error_type") == MemoryError.__name__):
            return end.get("error") or "It was lost."
        run.check_end()
        shutil.rmtree(run.folder, ignore_errors=True)
    return ""


class _StoredProgress(Progress):
    """Writes how far a piece is into its folder, a few times a second, and renews the claim."""

    def __init__(self, folder: Path, lease: Lease, channel: Channel) -> None:
        self._folder = folder
        self._lease = lease
        self._channel = channel
        self._written = self._renewed = 0.0

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,  # noqa: ARG002
        message: str = "",  # noqa: ARG002
    ) -> None:
        self._channel.step()
        clock = time.monotonic()
        if total == 0 or clock - self._written >= _TELL_EVERY_S:
            self._written = clock
            state = {"stage": stage, "iteration": iteration, "total": total}
            write_json(self._folder / PROGRESS, state, is_durable=False)
        if clock - self._renewed >= _BEAT_S:
            self._renewed = clock
            self._lease.heartbeat()

    def check_cancelled(self) -> None:
        if (self._folder / CANCEL).exists():
            raise CancelledError("The work on the suite was ended.")


def _require_same(request: Mapping[str, Any], device: str) -> dict[str, Any]:
    """Describe what this machine computes with, if it is what the others do.

    Raises:
        UsageError: If it is not.
    """
    own = describe_environment(device, describe_device(device))
    own |= {"code": code_version((*PREDICTIONS, *SCORES))}
    others = request.get("order", {}).get("environment", {"code": request.get("code", own["code"])})
    for name in _SAME:
        if (other := others.get(name, own[name])) != own[name]:
            raise UsageError(
                f"A node has {name} {own[name]} where the table's others have {other}. All cells "
                "of a table must be computed on nodes of one kind, with one version of the program."
            )
    return own


def _stop(_number: int, _frame: FrameType | None) -> None:
    raise CancelledError("The process was asked to end.")


def _work(channel: Channel) -> None:
    folder, device, beat_s = Path(channel.arguments[0]), *channel.arguments[1:]
    channel.beat(float(beat_s))
    signal.signal(signal.SIGTERM, _stop)
    lease = Lease.acquire(folder)
    try:
        request = read_mapping(folder / _REQUEST)
        own = _require_same(request, device)
        if "look" in request:
            write_json(Path(request["look"]), {n: v for n, v in own.items() if n != "started"})
        else:
            PieceWorker(_StoredProgress(folder, lease, channel)).do(request)
        with locked(folder):
            lease.check()
            write_json(folder / EXIT, {"state": "succeeded", "time": now()})
    finally:
        with locked(folder):
            if lease.is_held():
                lease.release()


if __name__ == "__main__":
    run_child(_work)
