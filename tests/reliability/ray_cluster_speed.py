"""How much faster two nodes of a real Ray cluster are than one; see `ray_cluster`."""

import os
import sys
import time
from pathlib import Path

import psutil
from support.inputs.sheet_sequence import write_sheet
from support.server.ray_cluster import RAY, RealCluster, real_cluster
from support.server.suite_world import SETTINGS
from support.waiting import until

from app.jobs.catalog import Catalog
from app.jobs.processes import WORKER
from app.jobs.scheduler import ENDED, Scheduler
from app.settings import ServerSettings
from physhandi.run import Run
from reliability import Case, Report
from reliability.jobs import is_damaged, state_of

_EFFORT = {"object_.search.generations": 6, "object_.search.population": 8}


def fit_side_by_side(count: int, folder: Path) -> Report:
    """Fit as many recordings on one node that is held to one processor, then on two of them."""
    found: dict[str, float] = {"done": 0, "lost": 0, "corrupt": 0}
    cores = sorted(os.sched_getaffinity(0))[:2]
    seconds: list[float] = []
    for nodes in (1, 2):
        with real_cluster() as cluster:
            for core in cores[:nodes]:
                cluster.start_node(core)
            before = _busy()
            runs, took = _batch(count, folder / str(nodes), cluster)
            busy = _busy() - before
        seconds.append(took)
        found["done"] = len(runs)
        found["lost"] += sum(run.state != "succeeded" for run in runs)
        found["corrupt"] += sum(is_damaged(run) for run in runs)
        found[f"processors of the machine in use with {nodes}"] = round(busy / took, 2)
    found |= {"seconds on one": round(seconds[0], 1), "seconds on two": round(seconds[1], 1)}
    return found | {"times as fast": round(seconds[0] / seconds[1], 2)}


def _batch(count: int, folder: Path, cluster: RealCluster) -> tuple[list[Run], float]:
    """Fit a sheet many times, each with a search of its own; gives the runs and the time [s]."""
    write_sheet(folder / "sequences" / "sheet")
    settings = ServerSettings.model_validate(
        {
            "data_dir": folder,
            "engine": cluster.address,
            "engine_token": cluster.token,
            "cluster_python": sys.executable,
        }
    )
    scheduler = Scheduler(settings, Catalog(settings), worker=WORKER)
    runs = [
        scheduler.launch(
            ["sheet"], "quick", overrides={**SETTINGS, **_EFFORT, "object_.search.seed": seed}
        )
        for seed in range(1, count + 1)
    ]
    begin = time.monotonic()
    scheduler.start()
    try:
        for run in runs:
            until(lambda run=run: state_of(scheduler, run) in ENDED, interval=0.1)
    finally:
        scheduler.shutdown()
    return runs, time.monotonic() - begin


def _busy() -> float:
    """Give the time that all processors of the machine have worked together [s]."""
    times = psutil.cpu_times()._asdict()
    return sum(times.values()) - sum(
        times.get(name, 0.0) for name in ("idle", "iowait", "guest", "guest_nice")
    )


CASES = (
    {
        "R19 speed": Case(
            "Fits on two nodes of a Ray cluster, each held to one processor, and on one of them",
            *(8, 0, fit_side_by_side),
        )
    }
    if RAY.exists()
    else {}
)
