"""Fits on a real cluster of a head and a node, all processes of this machine."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from ray_cluster import NEEDED, RAY, RealCluster, real_cluster
from waiting import until

from app.jobs.catalog import Catalog
from app.jobs.engines.cluster import Cluster, ClusterError, Demand
from app.jobs.processes import end_processes, processes_of
from app.jobs.scheduler import JobView, Scheduler
from app.settings import ServerSettings
from physhandi.run import Run

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not RAY.exists(), reason=NEEDED)]


@pytest.fixture(scope="module")
def cluster() -> Iterator[RealCluster]:
    with real_cluster() as cluster:
        cluster.start_node()
        yield cluster


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
        self.scheduler = Scheduler(self.settings, self.catalog, worker="job_worker")

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
    (worker,) = [p for p in processes_of(first.folder) if p.cmdline()[2] == "job_worker"]
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
    assert list(processes_of(run.folder)) == []


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
