"""Fits on a cluster: what becomes of a run, whatever a made-up Jobs API answers."""

import logging
import shlex
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from support.server.ray_api import TOKEN, MadeCluster, made_cluster
from support.waiting import LIMIT_S, until

from app.cli.lookup import read_settings
from app.jobs.catalog import Catalog
from app.jobs.engines import cluster as cluster_module
from app.jobs.engines import local_engine, ray_engine
from app.jobs.engines.cluster import Cluster, ClusterError, Demand
from app.jobs.scheduler import JobView, Scheduler
from app.jobs.ticket import QUEUED, STARTED, begin_start, read_ticket
from app.jobs.worker import fill_run
from app.settings import ServerSettings
from physhandi import pipeline
from physhandi.data.attempt import Attempt
from physhandi.data.lease import live_holder
from physhandi.errors import RunError, UsageError
from physhandi.run import Run
from physhandi.run_store import RunStore

WORKER = "support.server.job_worker"
FULL = "Waits for a free place on the cluster."


class ClusterDesk:
    """A scheduler whose thread stands still, and shortcuts to what a test asks it."""

    def __init__(self, data_dir: Path, **settings: Any) -> None:
        self.settings = ServerSettings(
            data_dir=data_dir, engine_token=TOKEN, cancel_grace_s=0.01, **settings
        )
        self.catalog = Catalog(self.settings)
        self.scheduler = Scheduler(self.settings, self.catalog, worker=WORKER)

    def launch(self, name: str = "fit") -> str:
        return self.scheduler.launch(["sheet"], "quick", name).id

    def step(self) -> None:
        """Do what the thread does in one turn."""
        self.scheduler._engine.refresh()
        self.scheduler._step()
        self.scheduler._sweep()

    def view(self, run_id: str) -> JobView:
        return self.scheduler.view(self.catalog.run_item(run_id))

    def told(self, run_id: str) -> tuple[str, str]:
        view = self.view(run_id)
        return view.state, view.reason

    def folder(self, run_id: str) -> Path:
        return self.settings.run_dir / run_id

    def begin(self, run_id: str, job: dict[str, Any]) -> Attempt:
        """Do what the supervisor and the worker of a job do."""
        folder = self.folder(run_id)
        assert begin_start(folder, job["submission_id"].rpartition("-")[2])
        return Run.open(folder).begin_attempt()


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[MadeCluster]:
    monkeypatch.setattr(ray_engine, "_INTERVAL_S", 0.0)
    with made_cluster() as made:
        yield made


@pytest.fixture
def desks(data_dir: Path, cluster: MadeCluster) -> Callable[..., ClusterDesk]:
    return lambda **settings: ClusterDesk(data_dir, **{"engine": cluster.address} | settings)


@pytest.fixture
def desk(desks: Callable[..., ClusterDesk]) -> ClusterDesk:
    return desks()


def test_a_fit_is_one_job_with_the_same_supervisor(
    desks: Callable[..., ClusterDesk], cluster: MadeCluster
) -> None:
    desk = desks(cluster_cpus=3, cluster_gpus=1, cluster_memory_gib=1.5, cluster_python="/a b/py")
    cluster.nodes = [{"CPU": 4.0, "GPU": 1.0, "memory": 2.0**31}]
    run_id = desk.launch()
    desk.step()
    (job,) = cluster.submitted
    folder = desk.folder(run_id)
    ticket = read_ticket(folder / STARTED)
    assert ticket is not None
    assert (ticket.starts, ticket.engine) == (1, cluster.address)
    nonce = job["submission_id"].removeprefix(f"{run_id}-1-")
    assert len(nonce) == 16
    assert shlex.split(job["entrypoint"]) == [
        *("exec", "env"),
        f"PHYSHANDI_RUN={folder}:{nonce}",
        *("OMP_NUM_THREADS=3", "OPENBLAS_NUM_THREADS=3", "MKL_NUM_THREADS=3"),
        *("/a b/py", "-m", "app.jobs.supervise", str(folder), "cuda:0", WORKER, "120.0"),
    ]
    wanted = ("entrypoint_num_cpus", "entrypoint_num_gpus", "entrypoint_memory")
    assert [job[name] for name in wanted] == [3, 1, 3 * 2**29]
    assert job["metadata"] == {"run": run_id, "folder": str(folder), "start": "1"}
    assert desk.told(run_id) == ("starting", FULL)
    cluster.set("RUNNING")
    desk.step()
    assert desk.told(run_id) == ("starting", "Loading the program.")
    with desk.begin(run_id, job) as attempt:
        desk.step()
        assert desk.told(run_id) == ("running", "")
        attempt.publish()
    cluster.set("SUCCEEDED")
    desk.step()
    assert desk.told(run_id) == ("succeeded", "")
    assert len(cluster.submitted) == 1


def test_a_fit_is_told_of_the_store(
    desks: Callable[..., ClusterDesk], cluster: MadeCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = desks(store="file:///a store")
    run = Run.open(desk.folder(desk.launch()))
    desk.step()
    words = shlex.split(cluster.submitted[0]["entrypoint"])
    assert "PHYSHANDI_STORE=file:///a store" in words
    told: list[RunStore | None] = []
    monkeypatch.setattr(pipeline, "run_job", lambda *_, store, **__: told.append(store))
    for url in ("file:///a store", ""):
        monkeypatch.setenv("PHYSHANDI_STORE", url)
        fill_run(run.folder, "cpu", lambda: None)
    assert [store.url if store else None for store in told] == ["file:///a store", None]
    with patch.object(local_engine, "start_supervisor") as start:
        desk.scheduler.start_now(lambda: run)
    assert start.call_args.kwargs["store"] == "file:///a store"


def test_as_many_fits_run_as_the_nodes_have_places(
    desks: Callable[..., ClusterDesk], cluster: MadeCluster
) -> None:
    cluster.nodes = [{"CPU": 5.0}, {"CPU": 1.0}, {"GPU": 1.0}]
    desk = desks(cluster_cpus=2)
    runs = [desk.launch(str(number)) for number in range(4)]
    for _ in range(2):
        desk.step()
        assert len(cluster.submitted) == desk.scheduler.slots == 2
    assert [desk.told(run_id) for run_id in runs[2:]] == [("queued", FULL)] * 2
    assert desk.view(runs[2]).place == 1
    assert desks(parallel_fits=3).scheduler.slots == 3


@pytest.mark.parametrize(
    ("demand", "places"),
    [
        (Demand(), 7),
        (Demand(cpus=2), 3),
        (Demand(gpus=1), 2),
        (Demand(memory=2**30), 4),
        (Demand(cpus=2, gpus=1, memory=2**32), 1),
        (Demand(cpus=8), 0),
    ],
)
def test_places_are_limited_by_what_is_scarcest(demand: Demand, places: int) -> None:
    assert demand.fits_into({"CPU": 7.9, "GPU": 2.0, "memory": 2.0**32, "tag": "x"}) == places
    assert demand.fits_into({"CPU": "many"}) == 0


def test_a_job_whose_answer_was_lost_is_not_submitted_twice(
    desk: ClusterDesk, cluster: MadeCluster
) -> None:
    run_id = desk.launch()
    cluster.silence = "submit"
    desk.step()
    state, reason = desk.told(run_id)
    assert (state, reason[: len(f"The cluster at {cluster.place} does not answer")]) == (
        "queued",
        f"The cluster at {cluster.place} does not answer",
    )
    cluster.silence = ""
    desk.step()
    assert desk.told(run_id) == ("starting", FULL)
    assert [job["submission_id"][:28] for job in cluster.submitted] == [f"{run_id}-1"]


def test_another_job_of_the_same_name_is_not_taken_for_ours(
    desk: ClusterDesk, cluster: MadeCluster
) -> None:
    run_id = desk.launch()
    cluster.silence = "submit"
    desk.step()
    cluster.silence = ""
    next(iter(cluster.jobs.values()))["metadata"] = {"folder": "/elsewhere"}
    desk.step()
    state, reason = desk.told(run_id)
    assert state == "queued"
    assert "exists.)" in reason


@pytest.mark.parametrize("end", ["FAILED", "STOPPED", "SUCCEEDED"])
def test_a_run_whose_job_is_lost_is_started_again_once(
    desk: ClusterDesk, cluster: MadeCluster, end: str
) -> None:
    run_id = desk.launch()
    desk.step()
    desk.begin(run_id, cluster.submitted[0])._lease.release()
    cluster.set("RUNNING")
    desk.step()
    cluster.set(end, message="The node has died.\nTraceback")
    desk.step()
    desk.step()
    assert [job["metadata"]["start"] for job in cluster.submitted] == ["1", "2"]
    state, reason = desk.told(run_id)
    assert state == "starting"
    lost = f"its job on the cluster has ended as {end} (The node has died)."
    assert reason == f"It lost its process: {lost} It was started again (2 of 2). {FULL}"
    cluster.set(end)
    desk.step()
    state, reason = desk.told(run_id)
    assert state == "failed"
    assert "That happened twice" in reason
    assert [lost.run for lost in desk.scheduler.restarts] == [run_id] * 2


def test_a_job_that_has_ended_is_not_lost_while_its_worker_renews_its_claim(
    desk: ClusterDesk, cluster: MadeCluster
) -> None:
    """A head may take a node for dead that it cannot reach, while the fit goes on there."""
    run_id = desk.launch()
    desk.step()
    with desk.begin(run_id, cluster.submitted[0]) as attempt:
        cluster.set("FAILED")
        desk.step()
        desk.step()
        assert desk.view(run_id).state == "running"
        attempt.publish()
    desk.step()
    assert desk.view(run_id).state == "succeeded"
    assert len(cluster.submitted) == 1


def test_a_silent_head_loses_no_run(desk: ClusterDesk, cluster: MadeCluster) -> None:
    cluster.nodes = [{"CPU": 1.0}, {"CPU": 1.0}]
    silent, loading, waiting = (desk.launch(str(number)) for number in range(3))
    desk.step()
    attempt = desk.begin(silent, cluster.submitted[0])
    cluster.silence = "all"
    for _ in range(3):
        desk.step()
    told = f"The cluster at {cluster.place} does not answer ("
    assert [desk.view(run_id).state for run_id in (silent, loading, waiting)] == [
        *("running", "starting", "queued")
    ]
    for run_id in (silent, loading, waiting):
        assert desk.view(run_id).reason.startswith(told)
    assert desk.view(loading).reason.endswith("Whether it still runs is known when it does.")
    attempt._lease.release()
    desk.step()
    assert desk.view(silent).state == "starting"
    assert desk.scheduler.restarts == []
    # A new head knows nothing of the jobs of the one that was lost.
    cluster.jobs.clear()
    cluster.silence = ""
    desk.step()
    desk.step()
    started = {(job["metadata"]["run"], job["metadata"]["start"]) for job in cluster.submitted[2:]}
    assert started == {(silent, "2"), (loading, "2")}
    assert f"the cluster at {cluster.place} does not know it." in desk.view(silent).reason


def test_a_new_server_takes_over_the_jobs_of_the_one_before(
    desks: Callable[..., ClusterDesk], cluster: MadeCluster
) -> None:
    before = desks()
    run_id = before.launch()
    before.step()
    cluster.set("RUNNING")
    after = desks()
    # Before it has asked, and after.
    for _ in range(3):
        after.scheduler._step()
        after.scheduler._sweep()
        assert after.view(run_id).state == "starting"
        after.step()
    assert len(cluster.submitted) == 1
    assert after.scheduler.restarts == []


def test_a_server_that_was_killed_while_it_submitted_submits_the_same_job(
    desks: Callable[..., ClusterDesk], cluster: MadeCluster
) -> None:
    before = desks()
    run_id = before.launch()
    ticket = (before.folder(run_id) / QUEUED).read_bytes()
    before.step()
    (before.folder(run_id) / QUEUED).write_bytes(ticket)
    after = desks()
    cluster.set("RUNNING")
    after.step()
    assert len(cluster.submitted) == 1
    after.step()
    assert after.told(run_id) == ("starting", "Loading the program.")


def test_a_stop_is_told_only_when_nothing_is_left(
    desk: ClusterDesk, cluster: MadeCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    workers: list[Any] = []

    def look(run_folder: Path) -> Any:
        workers.append(live_holder(run_folder))
        return workers[-1]

    monkeypatch.setattr(ray_engine, "live_holder", look)
    run_id = desk.launch()
    desk.step()
    attempt = desk.begin(run_id, cluster.submitted[0])
    cluster.set("RUNNING")
    desk.step()
    desk.scheduler.cancel(run_id)
    until(lambda: len(cluster.stopped) > 2)
    assert desk.view(run_id).state == "stopping"
    thread = desk.scheduler._stopping[run_id]
    assert workers == []
    cluster.set("STOPPED")
    # It goes on waiting for the worker, which still renews its claim, and asks the cluster no more.
    until(lambda: len(workers) > 2)
    assert None not in workers
    assert desk.view(run_id).state == "stopping"
    asked = len(cluster.stopped)
    attempt._lease.release()
    thread.join(LIMIT_S)
    assert len(cluster.stopped) == asked
    assert desk.view(run_id).state == "cancelled"
    assert not (desk.folder(run_id) / STARTED).exists()


def test_a_stop_waits_for_a_head_that_does_not_answer(
    desks: Callable[..., ClusterDesk], cluster: MadeCluster
) -> None:
    before = desks()
    run_id = before.launch()
    before.step()
    cluster.set("RUNNING")
    cluster.silence = "all"
    before.step()
    before.scheduler.cancel(run_id)
    state, reason = before.told(run_id)
    assert state == "stopping"
    assert f"The cluster at {cluster.place} does not answer" in reason
    # A server that is started anew goes on with it.
    after = desks()
    after.scheduler.start()
    try:
        until(lambda: run_id in after.scheduler._stopping)
        cluster.silence = ""
        until(lambda: cluster.stopped != [])
        cluster.set("STOPPED")
        until(lambda: after.view(run_id).state == "cancelled")
    finally:
        after.scheduler.shutdown()
    until(lambda: before.scheduler._stopping == {})


def test_a_job_that_waits_for_a_place_is_cancelled_at_once_and_never_begins(
    desk: ClusterDesk, cluster: MadeCluster
) -> None:
    run_id = desk.launch()
    desk.step()
    desk.scheduler.cancel(run_id)
    until(lambda: desk.view(run_id).state == "cancelled")
    (job,) = cluster.stopped
    # Ray begins it all the same when a place is free.
    assert cluster.jobs[job]["status"] == "PENDING"
    nonce = job.rpartition("-")[2]
    assert not begin_start(desk.folder(run_id), nonce)
    desk.scheduler.resume(run_id)
    desk.step()
    assert not begin_start(desk.folder(run_id), nonce)
    assert len(cluster.submitted) == 2
    assert begin_start(
        desk.folder(run_id), cluster.submitted[1]["submission_id"].rpartition("-")[2]
    )


def test_a_job_on_the_servers_own_machine_is_not_taken_for_left_behind(
    desk: ClusterDesk, cluster: MadeCluster
) -> None:
    run_id = desk.launch()
    desk.step()
    cluster.set("RUNNING")
    # It has its mark, but not its lock yet.
    ended: list[Path] = []
    marked = [(None, f"{desk.folder(run_id)}:x")]
    with (
        patch.object(local_engine, "marked_processes", lambda: marked),
        patch.object(local_engine, "end_processes", lambda folder, **_: ended.append(folder)),
    ):
        desk.step()
        assert ended == []
        cluster.set("FAILED")
        desk.step()
        assert ended == [desk.folder(run_id)]


def test_what_takes_seconds_runs_beside_the_server(desk: ClusterDesk, cluster: MadeCluster) -> None:
    run = Run.open(desk.folder(desk.launch()))
    (run.folder / QUEUED).unlink()
    with patch.object(local_engine, "start_supervisor") as start:
        start.return_value.poll.return_value = None
        desk.scheduler.start_now(lambda: run)
        waiting = desk.launch()
        desk.step()
        # It takes no place of the cluster's.
        assert [desk.told(run_id) for run_id in (run.id, waiting)] == [
            ("starting", "Loading the program."),
            ("starting", FULL),
        ]
    assert start.call_count == len(cluster.submitted) == 1


def test_a_run_of_another_engine_is_neither_lost_nor_ended(
    desks: Callable[..., ClusterDesk], cluster: MadeCluster
) -> None:
    on_cluster = desks()
    run_id = on_cluster.launch()
    on_cluster.step()
    local = desks(engine="local")
    for _ in range(2):
        local.step()
    told = f"It was started on {cluster.address}; a server with that --engine follows it."
    assert local.told(run_id) == ("starting", told)
    with pytest.raises(RunError, match="cannot be ended here"):
        local.scheduler.cancel(run_id)
    assert local.scheduler.restarts == []


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        ((500, b"Traceback\nValueError: no way"), "as it should (status 500: ValueError: no way)."),
        ((200, b"<html>"), "as it should (status 200: <html>)."),
        ((200, b"[" * 10_000), "as it should (status 200: ["),
        ((200, b"\xff"), "as it should (status 200"),
        ((401, b"no"), "(it refuses the token of PHYSHANDI_ENGINE_TOKEN)."),
    ],
    ids=["defect", "another server", "nesting", "no text", "wrong token"],
)
def test_a_strange_answer_is_told_and_ends_nothing(
    desk: ClusterDesk, cluster: MadeCluster, answer: tuple[int, bytes], told: str
) -> None:
    run_id, waiting = desk.launch(), desk.launch()
    desk.step()
    cluster.broken = answer
    for _ in range(2):
        desk.step()
    state, reason = desk.told(waiting)
    assert state == "queued"
    assert f"The cluster at {cluster.place} does not answer" in reason
    assert told in reason
    assert desk.view(run_id).state == "starting"
    assert desk.scheduler.restarts == []


def test_the_token_is_neither_logged_nor_sent_out_of_the_network(
    desk: ClusterDesk, cluster: MadeCluster, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    desk.launch()
    desk.step()
    cluster.token = TOKEN[::-1]
    with pytest.raises(ClusterError) as refused:
        Cluster(cluster.address, TOKEN).places(Demand())
    submitted = str(cluster.submitted)
    assert cluster.submitted
    assert TOKEN not in f"{refused.value} {caplog.text} {submitted} {desk.settings!r}"
    cluster.token = TOKEN
    with (
        patch.object(cluster_module, "is_private", lambda host: host != "127.0.0.1"),
        pytest.raises(ClusterError, match="its token is not sent there"),
    ):
        Cluster(cluster.address, TOKEN).places(Demand())


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"engine": "ray://127.0.0.1:8265"}, "needs a token"),
        ({"engine": "ray://127.0.0.1:8265", "engine_token": "short"}, "16"),
        ({"engine": "ray://8.8.8.8:8265", "engine_token": TOKEN}, "private network"),
        ({"engine": "ray://[2001:4860:4860::8888]:1", "engine_token": TOKEN}, "private network"),
        ({"engine": "ray://host", "engine_token": TOKEN}, "no engine"),
        ({"engine": "ray://host:99999", "engine_token": TOKEN}, "no engine"),
        ({"engine": "ray://user@host:8265", "engine_token": TOKEN}, "no engine"),
        ({"engine": "http://host:8265", "engine_token": TOKEN}, "no engine"),
    ],
)
def test_an_engine_that_is_not_safe_is_refused(given: dict[str, str], told: str) -> None:
    with pytest.raises(UsageError, match=told):
        read_settings(**given)
    for engine in ("local", "ray://head.lab:8265", "ray://10.1.2.3:1", "ray://[::1]:8265"):
        assert read_settings(engine=engine, engine_token=TOKEN).engine == engine


def test_each_start_has_a_name_of_its_own(desk: ClusterDesk) -> None:
    folder = desk.folder(desk.launch())
    ticket = read_ticket(folder / QUEUED)
    assert ticket is not None
    starts = [
        ticket,
        replace(ticket, starts=1),
        replace(ticket, time=ticket.time + 0.001),
    ]
    names = {ray_engine.job_name(folder, start) for start in starts}
    assert len(names) == 3
    assert ray_engine.job_name(folder, replace(ticket, why="x", device="y")) in names
