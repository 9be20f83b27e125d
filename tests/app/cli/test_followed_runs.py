"""Fits that a command has a cluster compute: followed, ended, found again, published once."""

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from support.server.ray_api import TOKEN, MadeCluster, made_cluster
from support.waiting import until

from app import cli
from app.cli import runs
from app.cli.lookup import read_settings
from app.jobs.catalog import Catalog
from app.jobs.engines import ray_engine
from app.jobs.engines.following import FollowedRun, follow_to_end
from app.jobs.engines.ray_engine import RayEngine
from app.jobs.processes import processes_of
from app.jobs.scheduler import Scheduler
from app.jobs.ticket import STARTED
from physhandi.errors import PhysHandiError, RunError
from physhandi.progress import Progress
from physhandi.run import Run

WORKER = "support.server.job_worker"


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch, data_dir: Path) -> Iterator[MadeCluster]:
    """A cluster whose jobs are processes here, and commands that are told of it."""
    monkeypatch.setattr(ray_engine, "_INTERVAL_S", 0.0)
    monkeypatch.setattr(runs, "WORKER", WORKER)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    monkeypatch.setenv("PHYSHANDI_ENGINE_TOKEN", TOKEN)
    monkeypatch.setenv("PHYSHANDI_CLUSTER_PYTHON", sys.executable)
    monkeypatch.setenv("PHYSHANDI_DATA_DIR", str(data_dir))
    monkeypatch.setenv("PHYSHANDI_CANCEL_GRACE_S", "0.3")
    with made_cluster() as made:
        made.executes = True
        yield made


Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def call(cluster: MadeCluster, capsys: pytest.CaptureFixture[str]) -> Call:
    def call(*arguments: object) -> tuple[int, str, str]:
        words = ["reconstruct", "sheet", "--engine", cluster.address, "--profile", "quick"]
        with pytest.raises(SystemExit) as end:
            cli.main([*words, *(str(argument) for argument in arguments)])
        return (int(end.value.code or 0), *capsys.readouterr())

    return call


class Deeds(Progress):
    """Does something the first time that a stage is told; remembers all stages."""

    def __init__(self, **deeds: Callable[[], object]) -> None:
        self.told: list[str] = []
        self._deeds = deeds

    def report(self, stage: str, *about: Any, **more: Any) -> None:
        is_new = stage not in self.told
        self.told.append(stage)
        if is_new and stage in self._deeds:
            self._deeds[stage]()


@pytest.fixture
def engine(cluster: MadeCluster) -> RayEngine:
    engine = RayEngine.of(read_settings(engine=cluster.address), WORKER)
    engine.refresh()
    return engine


@pytest.fixture
def make(data_dir: Path) -> Callable[[str], Run]:
    def make(name: str) -> Run:
        sheet = str(data_dir / "sequences" / "sheet")
        folder = data_dir / "runs" / name.replace(" ", "_")
        return Run.create(folder, name=name, kind="reconstruction", sequences=[sheet], config={})

    return make


def finish(run: Run) -> None:
    (run.folder / "go").touch()


def test_a_command_has_a_cluster_fit_and_shows_the_result(
    call: Call, cluster: MadeCluster, tmp_path: Path
) -> None:
    code, out, error = call("--out", tmp_path / "publish", "--device", "cuda")
    assert code == 0, error
    (job,) = cluster.submitted
    assert (job["entrypoint_num_cpus"], job["entrypoint_num_gpus"]) == (1, 1)
    assert f"app.jobs.supervise {tmp_path / 'publish'} cuda:0 {WORKER}" in job["entrypoint"]
    run = Run.open(tmp_path / "publish")
    run.verify()
    assert (run.attempt, run.state, run.json("first.json")) == (1, "succeeded", {"attempt": 1})
    assert f"run: {run.folder}" in out
    assert "first:\n    before: 2\n    after: 1" in out
    assert f"physhandi: {run.folder} is fitted on {cluster.address}" in error
    assert not (run.folder / STARTED).exists()
    code, _, error = call("--out", tmp_path / "publish")
    assert (code, len(cluster.submitted)) == (2, 1)
    assert "already holds this run, finished" in error


def test_what_a_fit_finds_wrong_is_told_in_its_words_and_the_same_command_tries_again(
    call: Call, cluster: MadeCluster, tmp_path: Path
) -> None:
    for count in (1, 2):
        code, out, error = call("--out", tmp_path / "fail")
        assert (code, out) == (1, "")
        assert error.splitlines()[-1] == "physhandi: 'sheet' lacks a <b>hand</b>."
        assert len(cluster.submitted) == count


def test_a_wish_that_makes_no_sense_makes_no_run(
    call: Call, cluster: MadeCluster, data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, _, error = call("--device", "cuda:1")
    assert code == 2
    assert "--device cuda:1 makes no sense on a cluster; take auto, cpu or cuda" in error
    cluster.silence = "all"
    code, _, error = call()
    assert code == 1
    assert f"The cluster at {cluster.place} does not answer" in error
    monkeypatch.delenv("PHYSHANDI_ENGINE_TOKEN")
    code, _, error = call()
    assert code == 2
    assert "needs a token" in error
    assert list((data_dir / "runs").iterdir()) == []


def test_a_fit_whose_node_is_lost_is_started_again_once_and_published_once(
    cluster: MadeCluster, engine: RayEngine, make: Callable[[str], Run], tmp_path: Path
) -> None:
    run = make("wait")

    def lose() -> None:
        # The second start waits until it was told why there is one.
        cluster.gate = tmp_path / "gate"
        cluster.kill(cluster.submitted[-1]["submission_id"])

    progress = Deeds(second=lose)
    lost = "its job on the cluster has ended as FAILED. It was started again (2 of 2)."
    with FollowedRun(run.folder, engine) as followed:

        def is_over() -> bool:
            if followed.look():
                return True
            progress.report(followed.report()["stage"])
            if lost in progress.told[-1]:
                (tmp_path / "gate").touch()
            if run.attempt == 2:
                finish(run)
            engine.refresh()
            return False

        until(is_over)
        followed.check_end()
    run.verify()
    assert [job["metadata"]["start"] for job in cluster.submitted] == ["1", "2"]
    assert len(list(run.folder.glob("attempts/*/MANIFEST.json"))) == 1
    # What was finished before the loss was taken over.
    assert run.json("first.json") == {"attempt": 1}
    assert any(lost in stage for stage in progress.told)


def test_a_fit_that_loses_its_process_twice_has_failed(
    cluster: MadeCluster, engine: RayEngine, make: Callable[[str], Run]
) -> None:
    run = make("wait")
    with FollowedRun(run.folder, engine) as followed:

        def is_over() -> bool:
            if followed.look():
                return True
            if followed.report()["stage"] == "second":
                cluster.kill(cluster.submitted[-1]["submission_id"])
            engine.refresh()
            return False

        until(is_over)
        with pytest.raises(RunError, match=r"ended as FAILED\. That happened twice"):
            followed.check_end()
    assert len(cluster.submitted) == 2


def test_ctrl_c_ends_what_ignores_it_and_returns_when_nothing_is_left(
    cluster: MadeCluster, engine: RayEngine, make: Callable[[str], Run]
) -> None:
    run = make("stubborn")

    def interrupt() -> None:
        until((run.folder / "pids").exists)
        assert len(list(processes_of(run.folder))) == 3
        raise KeyboardInterrupt

    progress = Deeds(first=interrupt)
    with FollowedRun(run.folder, engine) as followed, pytest.raises(KeyboardInterrupt):
        follow_to_end(followed, engine, progress, 0.1)
    assert list(processes_of(run.folder)) == []
    assert run.state == "cancelled"
    assert set(cluster.stopped) == {cluster.submitted[0]["submission_id"]}
    assert progress.told[-1] == f"the job on {cluster.address} ended, nothing is left"
    # The same command goes on.
    run.rename("wait")
    finish(run)
    with FollowedRun(run.folder, engine) as followed:
        follow_to_end(followed, engine, Deeds(), 0.1)
    run.verify()
    assert (run.attempt, len(cluster.submitted)) == (2, 2)


def test_a_command_that_was_killed_is_followed_by_the_next_one_which_starts_nothing(
    cluster: MadeCluster, engine: RayEngine, make: Callable[[str], Run]
) -> None:
    run = make("wait")
    with FollowedRun(run.folder, engine) as followed:
        until(lambda: not followed.look() and followed.report()["stage"] == "second")
        with pytest.raises(RunError, match="is followed by another process"):
            FollowedRun(run.folder, engine, patience_s=0.0)
    later = RayEngine.of(read_settings(engine=cluster.address), WORKER)
    later.refresh()
    with FollowedRun(run.folder, later) as followed:
        finish(run)
        follow_to_end(followed, later, Deeds(), 0.1)
    assert (run.state, run.attempt, len(cluster.submitted)) == ("succeeded", 1, 1)


def test_a_server_leaves_a_followed_fit_to_its_command_and_takes_it_over_afterwards(
    cluster: MadeCluster, engine: RayEngine, make: Callable[[str], Run]
) -> None:
    settings = read_settings(engine=cluster.address)
    scheduler = Scheduler(settings, Catalog(settings), worker=WORKER)
    run = make("wait")

    def step() -> None:
        scheduler._engine.refresh()
        scheduler._step()
        scheduler._sweep()

    with FollowedRun(run.folder, engine) as followed:
        until(lambda: not followed.look() and followed.report()["stage"] == "second")
        step()
        assert [found.id for found in scheduler.at_work()] == [run.id]
        cluster.kill(cluster.submitted[-1]["submission_id"])
        for _ in range(3):
            step()
        assert (scheduler.restarts, len(cluster.submitted)) == ([], 1)
        assert (
            "What is left of it is being ended"
            in scheduler.view(scheduler._catalog.run_item(run.id)).reason
        )
    for _ in range(3):
        step()
    assert [lost.run for lost in scheduler.restarts] == [run.id]
    assert [job["metadata"]["start"] for job in cluster.submitted] == ["1", "2"]
    finish(run)
    with FollowedRun(run.folder, engine) as followed:
        follow_to_end(followed, engine, Deeds(), 0.1)
    assert run.json("first.json") == {"attempt": 1}


def test_a_run_of_another_engine_is_not_taken_over(
    cluster: MadeCluster, engine: RayEngine, make: Callable[[str], Run]
) -> None:
    run = make("wait")
    with FollowedRun(run.folder, engine) as followed:
        until(lambda: not followed.look() and followed.report()["stage"] == "second")
    ticket = (run.folder / STARTED).read_text()
    (run.folder / STARTED).write_text(ticket.replace(cluster.address, "ray://10.0.0.9:8265"))
    for _ in range(2):
        with pytest.raises(PhysHandiError, match=r"was started on ray://10\.0\.0\.9:8265"):
            FollowedRun(run.folder, engine)


def test_a_run_that_a_process_here_fills_is_not_started_beside_it(
    cluster: MadeCluster, engine: RayEngine, make: Callable[[str], Run]
) -> None:
    run = make("publish")
    with run.begin_attempt() as attempt:
        for _ in range(2):
            with pytest.raises(RunError, match=f"is being written by process {os.getpid()} on"):
                FollowedRun(run.folder, engine)
        attempt.publish()
    assert cluster.submitted == []
