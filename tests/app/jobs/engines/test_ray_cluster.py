"""Fits on a real cluster of a head and a node, all processes of this machine."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.server.ray_cluster import NEEDED, RAY, RealCluster, real_cluster
from support.server.suite_world import order_of, table, write_told
from support.waiting import until

from app.cli.lookup import read_settings
from app.cli.suite_jobs import SUITE_WORKER, SuiteJobs
from app.jobs.catalog import Catalog
from app.jobs.engines.cluster import Cluster, ClusterError, Demand
from app.jobs.engines.following import FollowedRun, follow_to_end
from app.jobs.engines.ray_engine import reached_cluster
from app.jobs.processes import end_processes, processes_of
from app.jobs.scheduler import JobView, Scheduler
from app.settings import ServerSettings
from physhandi.progress import Progress
from physhandi.run import Run
from physhandi.synthetic.suite.evaluation import evaluate_suite

WORKER = "support.server.job_worker"

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not RAY.exists(), reason=NEEDED)]


@pytest.fixture(scope="module")
def cluster() -> Iterator[RealCluster]:
    with real_cluster() as cluster:
        cluster.start_node()
        yield cluster


@pytest.fixture
def told(cluster: RealCluster, monkeypatch: pytest.MonkeyPatch) -> str:
    """Tell commands of the cluster; gives its address."""
    monkeypatch.setenv("PHYSHANDI_ENGINE_TOKEN", cluster.token)
    monkeypatch.setenv("PHYSHANDI_CLUSTER_PYTHON", sys.executable)
    monkeypatch.setenv("PHYSHANDI_CANCEL_GRACE_S", "0.3")
    return cluster.address


class Desk:
    def __init__(self, data_dir: Path, cluster: RealCluster) -> None:
        self.settings = ServerSettings.model_validate(
            {
                "data_dir": data_dir,
                "engine": cluster.address,
                "engine_token": cluster.token,
                "cluster_python": sys.executable,
                "cancel_grace_s": 0.3,
            }
        )
        self.catalog = Catalog(self.settings)
        self.scheduler = Scheduler(self.settings, self.catalog, worker=WORKER)

    def launch(self, behaviour: str) -> Run:
        return self.scheduler.launch(["sheet"], "quick", behaviour)

    def view(self, run: Run) -> JobView:
        return self.scheduler.view(self.catalog.run_item(run.id))

    def until(self, run: Run, state: str) -> None:
        until(lambda: self.view(run).state == state, lambda: self.view(run))


@pytest.fixture
def desk(data_dir: Path, cluster: RealCluster) -> Iterator[Desk]:
    desk = Desk(data_dir, cluster)
    desk.scheduler.start()
    yield desk
    desk.scheduler.shutdown()
    for folder in (data_dir / "runs").iterdir():
        end_processes(folder, grace_s=0.0)


def test_fits_take_turns_on_a_node_and_a_new_server_finds_them(
    desk: Desk, data_dir: Path, cluster: RealCluster
) -> None:
    first, second = desk.launch("wait 1"), desk.launch("publish 2")
    desk.until(first, "running")
    (worker,) = [p for p in processes_of(first.folder) if p.cmdline()[2] == WORKER]
    environment = worker.environ()
    assert "RAY_AUTH_TOKEN" not in environment
    assert environment["OMP_NUM_THREADS"] == "1"
    assert desk.view(second).reason == "Waits for a free place on the cluster."
    desk.scheduler.shutdown()
    after = Desk(data_dir, cluster)
    after.scheduler.start()
    try:
        assert (after.view(first).state, after.view(second).state) == ("running", "queued")
        (first.folder / "go").touch()
        after.until(first, "succeeded")
        after.until(second, "succeeded")
    finally:
        after.scheduler.shutdown()
    for run in (first, second):
        run.verify()
        assert run.attempt == 1


def test_a_cancel_ends_what_ignores_it_and_what_that_started(desk: Desk) -> None:
    run = desk.launch("stubborn")
    until((run.folder / "pids").exists, lambda: desk.view(run))
    assert len(list(processes_of(run.folder))) == 3
    desk.scheduler.cancel(run.id)
    desk.until(run, "cancelled")
    # Ray tells of the end when it has sent the last signal, which is a moment on its way.
    until(lambda: list(processes_of(run.folder)) == [])


def test_a_killed_supervisor_is_told_and_the_fit_started_again(desk: Desk) -> None:
    run = desk.launch("wait")
    until(lambda: run.progress.get("stage") == "second", lambda: desk.view(run))
    (supervisor,) = [p for p in processes_of(run.folder) if p.cmdline()[2] == "app.jobs.supervise"]
    supervisor.kill()
    until(lambda: run.attempt == 2, lambda: desk.view(run))
    assert "its job on the cluster has ended as FAILED" in desk.view(run).reason
    (run.folder / "go").touch()
    desk.until(run, "succeeded")
    assert run.json("first.json") == {"attempt": 1}


def test_who_has_another_token_is_refused(cluster: RealCluster) -> None:
    with pytest.raises(ClusterError, match="refuses the token"):
        Cluster(cluster.address, cluster.token[::-1]).places(Demand())
    assert Cluster(cluster.address, cluster.token).job("nothing") is None


def test_a_command_follows_a_fit_and_ctrl_c_returns_when_nothing_is_left(
    told: str, data_dir: Path
) -> None:
    sheet = str(data_dir / "sequences" / "sheet")
    for name, end in (("publish", "succeeded"), ("stubborn", "cancelled")):
        run = Run.create(
            data_dir / "runs" / name,
            name=name,
            kind="reconstruction",
            sequences=[sheet],
            config={},
        )
        engine = reached_cluster(read_settings(engine=told), WORKER)

        class Interrupting(Progress):
            def check_cancelled(self, folder: Path = run.folder) -> None:
                if (folder / "pids").exists():
                    assert len(list(processes_of(folder))) == 3
                    raise KeyboardInterrupt

        with FollowedRun(run.folder, engine) as followed:
            try:
                follow_to_end(followed, engine, Interrupting(), 0.3)
            except KeyboardInterrupt:
                assert name == "stubborn"
        assert run.state == end
        until(lambda folder=run.folder: list(processes_of(folder)) == [])


def test_cells_of_a_suite_are_jobs(told: str, tmp_path: Path) -> None:
    recording = write_told(tmp_path / "low", 0.12)
    out = tmp_path / "suite"
    engine = reached_cluster(read_settings(engine=told), SUITE_WORKER)
    jobs = SuiteJobs(engine, out, Progress(), most=2, grace_s=0.3)
    order = order_of(
        (recording,),
        methods=("static", "rigid_follow"),
        protocols=("main",),
        environment=jobs.environment(),
    )
    found = evaluate_suite(order, out, fill=jobs.fill(order, out))
    assert (found["cells"], found["failed"], found["skipped"]) == (2, 0, [])
    rows = table(out)
    assert float(rows["static", "future", "track_error"]["mean"]) > 0.03
    assert [path.name for path in (out / "jobs").iterdir()] == ["environment.json"]
