"""A suite whose cells are jobs of a cluster: same table, each cell once, nothing left behind."""

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.server.ray_api import TOKEN, MadeCluster, made_cluster
from support.server.suite_world import order_of, table, write_told
from support.waiting import until

from app.cli.lookup import read_settings
from app.cli.suite_jobs import SUITE_WORKER, SuiteJobs
from app.jobs.engines import ray_engine
from app.jobs.engines.ray_engine import RayEngine
from app.jobs.processes import marked_processes
from physhandi.data.environment import describe_environment
from physhandi.errors import UsageError
from physhandi.progress import Progress
from physhandi.run import Run
from physhandi.synthetic.suite.evaluation import Order, evaluate_suite


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[MadeCluster]:
    """A cluster whose jobs are processes here."""
    monkeypatch.setattr(ray_engine, "_INTERVAL_S", 0.0)
    monkeypatch.setenv("PHYSHANDI_ENGINE_TOKEN", TOKEN)
    monkeypatch.setenv("PHYSHANDI_CLUSTER_PYTHON", sys.executable)
    with made_cluster() as made:
        made.executes = True
        yield made


class Deed(Progress):
    """Does something once, as soon as a cell is told to be at work."""

    def __init__(self, cell: str = "", deed: Callable[[], object] = lambda: None) -> None:
        self.told: list[tuple[str, int, int, str]] = []
        self._cell = cell
        self._deed: Callable[[], object] | None = deed

    def report(
        self, stage: str, iteration: int, total: int, loss: Any = None, message: str = ""
    ) -> None:
        self.told.append((stage, iteration, total, message))
        if self._deed is not None and self._cell and self._cell in message:
            deed, self._deed = self._deed, None
            deed()


def jobs_of(cluster: MadeCluster, out: Path, progress: Progress) -> SuiteJobs:
    engine = RayEngine.of(read_settings(engine=cluster.address), SUITE_WORKER)
    engine.refresh()
    return SuiteJobs(engine, out, progress, most=2, grace_s=0.3)


@pytest.fixture
def order(tmp_path: Path) -> Order:
    recording = write_told(tmp_path / "low", 0.12)
    return order_of((recording,), methods=("static", "rigid_follow"), protocols=("main",))


def left_in(out: Path) -> list[str]:
    return [cookie for _, cookie in marked_processes() if str(out) in cookie]


def test_a_cluster_gives_the_same_table_although_a_command_is_ended_and_a_node_is_lost(
    tmp_path: Path, cluster: MadeCluster, order: Order
) -> None:
    out = tmp_path / "suite"
    environment = jobs_of(cluster, out, Deed()).environment()
    assert (environment["device"], "started" in environment) == ("cpu", False)
    order = replace(order, environment=environment)
    ctrl_c_ends_all_jobs(cluster, out, order)
    ended = len(cluster.submitted)

    def lose() -> None:
        cluster.kill(cluster.submitted[-1]["submission_id"])

    # The next command wants one of the cells that lost their jobs.
    order = replace(order, methods=("rigid_follow",))
    progress = Deed("rigid_follow, low", lose)
    found = evaluate_suite(
        order, out, progress, fill=jobs_of(cluster, out, progress).fill(order, out)
    )
    assert (found["cells"], found["failed"], found["skipped"]) == (1, 0, [])
    names = [job["submission_id"].rsplit("-", 3) for job in cluster.submitted]
    starts = [(name, int(start)) for name, _, start, _ in names]
    assert starts[0] == ("the_nodes", 1)
    assert starts[ended:] == [("rigid_follow__low", 1), ("rigid_follow__low", 2)]
    evaluate_suite(replace(order, environment={}), tmp_path / "here")
    one, other = table(tmp_path / "here"), table(out)
    assert list(one) == list(other)
    for key, row in one.items():
        if key[1] != "runtime":  # Sums over other numbers of threads are rounded otherwise.
            assert float(other[key]["mean"]) == pytest.approx(float(row["mean"]), rel=2e-3), key
    assert one["rigid_follow", "future", "track_error"]["mean"] != "0"
    # What is finished was filled there alone, and needs no job any more; nobody has asked again for
    # the other cell.
    left = sorted(path.name.partition("-")[0] for path in (out / "jobs").iterdir())
    assert left == ["environment.json", "static__low"]
    assert {Run.open(cell).is_published for cell in (out / "cells").iterdir()} == {True}
    assert any("rigid_follow, low" in message for *_, message in progress.told)
    stored = json.loads((out / "cells.json").read_text())["about"]["environment"]
    assert stored["device_name"] == environment["device_name"]


def ctrl_c_ends_all_jobs(cluster: MadeCluster, out: Path, order: Order) -> None:
    """Begin with both cells, interrupt the command, and see that no job is left."""
    begun = len(cluster.submitted)

    def interrupt() -> None:
        until(lambda: left_in(out))
        raise KeyboardInterrupt

    progress = Deed("static, low", interrupt)
    fill = jobs_of(cluster, out, progress).fill(order, out)
    with pytest.raises(KeyboardInterrupt):
        evaluate_suite(order, out, progress, fill=fill)
    assert left_in(out) == []
    # Those that have not ended by themselves were stopped.
    submitted = {job["submission_id"] for job in cluster.submitted[begun:]}
    assert len(submitted) == 2
    assert submitted >= set(cluster.stopped)
    assert "nothing is left" in progress.told[-1][0]


def test_nodes_that_differ_stop_the_suite_in_their_words(
    tmp_path: Path, cluster: MadeCluster, order: Order
) -> None:
    out = tmp_path / "suite"
    environment = describe_environment("cpu") | {"device_name": "abacus"}
    other = replace(order, methods=("static",), environment=environment)
    fill = jobs_of(cluster, out, Deed()).fill(other, out)
    with pytest.raises(UsageError, match="where the table's others have abacus"):
        evaluate_suite(other, out, fill=fill)
    until(lambda: left_in(out) == [], lambda: left_in(out))  # A job that has told it still ends.
