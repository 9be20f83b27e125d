"""Servers that are killed, with and without their index, and streams that are dropped."""

import http.client
import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import psutil
from support.inputs.sheet_sequence import write_sheet
from support.server.queue_world import queue_world, serving
from support.waiting import until

from app.jobs.catalog import Catalog
from app.jobs.processes import end_processes, processes_of, supervisor_of
from app.jobs.scheduler import ENDED, Scheduler
from app.settings import ServerSettings
from physhandi.data.lease import live_holder
from physhandi.data.run_folder import read_events
from physhandi.run import Run
from reliability import Case, Report
from reliability.jobs import REAL, is_damaged, results_of

TESTS = Path(__file__).parents[1]


class Server:
    """The process of a server."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.start()

    def start(self) -> None:
        """Start it, also again."""
        self._process = subprocess.Popen(
            [sys.executable, str(TESTS / "support/server/queue_server.py"), str(self._folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(TESTS.parent), str(TESTS)])},
        )
        self.first = self._hear()

    def look(self) -> dict[str, str]:
        """Ask for the states of all runs."""
        assert self._process.stdin is not None
        self._process.stdin.write("look\n")
        self._process.stdin.flush()
        return self._hear()

    def kill(self) -> None:
        self._process.kill()
        self._process.communicate()

    def _hear(self) -> dict[str, str]:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())


@contextmanager
def fits_at_work(folder: Path) -> Iterator[tuple[Server, dict[str, Run]]]:
    """Have a server with a fit that has ended well, one that has failed, and two at work."""
    write_sheet(folder / "sequences" / "sheet")
    settings = ServerSettings(data_dir=folder)
    desk = Scheduler(settings, Catalog(settings))
    names = ("publish", "fail", "wait 1", "wait 2")
    runs = {name: desk.launch(["sheet"], "quick", name) for name in names}
    server = Server(folder)
    try:
        until(lambda: {*_states(server.look(), runs)} == {"succeeded", "failed", "running"})
        for name in ("wait 1", "wait 2"):
            until(lambda run=runs[name]: run.progress.get("stage") == "second")
        yield server, runs
    finally:
        server.kill()
        for run in runs.values():
            end_processes(run.folder, grace_s=0.0)


def _states(told: dict[str, str], runs: dict[str, Run]) -> list[str]:
    return [told.get(run.id, "gone") for run in runs.values()]


def kill_servers(count: int, folder: Path, *, forgets: bool = False) -> Report:
    """Kill the server and start another one, which has to find all as it was.

    A tenth of the kills hit it while a real fit is at work, which has to end with the bits of an
    undisturbed one.
    """
    real = count // 10
    report = _kill_while_fits_wait(count - real, folder / "waiting", forgets=forgets)
    if real:
        report.update(_kill_while_one_is_fitted(real, folder / "fitted", forgets=forgets))
    return report


def _forget(folder: Path) -> None:
    shutil.rmtree(folder / "cache", ignore_errors=True)
    Catalog(ServerSettings(data_dir=folder)).reindex()


def _kill_while_one_is_fitted(count: int, folder: Path, *, forgets: bool) -> Counter[str]:
    chance = np.random.default_rng(3)
    write_sheet(folder / "sequences" / "sheet")
    settings = ServerSettings(data_dir=folder)
    desk = Scheduler(settings, Catalog(settings))
    counts: Counter[str] = Counter({"done": count, "of real fits": count})
    expected: dict[str, bytes] | None = None
    server = Server(folder)
    try:
        for number in range(count + 1):
            server.kill()
            run = desk.launch(["sheet"], "quick", f"real {number}", overrides=REAL)
            server.start()
            if expected is not None:
                until(partial(_has_told, run.folder, int(chance.integers(1, 8))))
                server.kill()
                if forgets:
                    _forget(folder)
                server.start()
            until(lambda run=run: server.look().get(run.id) in ENDED)
            until(lambda run=run: supervisor_of(run.folder) is None)
            expected = expected or results_of(run)
            counts["lost"] += run.state != "succeeded" or run.attempt != 1
            counts["corrupt"] += run.is_published and results_of(run) != expected
            counts["orphans"] += len(list(processes_of(run.folder)))
    finally:
        server.kill()
    return counts


def _has_told(run_folder: Path, count: int) -> bool:
    return len(read_events(run_folder)[0]) >= count


def _kill_while_fits_wait(count: int, folder: Path, *, forgets: bool) -> Counter[str]:
    wrong = lost = 0
    with fits_at_work(folder) as (server, runs):
        expected = _states(server.look(), runs)
        waiting = [runs["wait 1"], runs["wait 2"]]
        holders = [live_holder(run.folder) for run in waiting]
        for _ in range(count):
            server.kill()
            if forgets:
                _forget(folder)
            # The first look of the new one, before which it has waited for nothing.
            server.start()
            wrong += _states(server.first, runs) != expected
            now = [live_holder(run.folder) for run in waiting]
            lost += [h and h["pid"] for h in now] != [h and h["pid"] for h in holders]
        for run in waiting:
            (run.folder / "go").touch()
        until(lambda: _states(server.look(), runs).count("succeeded") == 3)
        for run in runs.values():
            until(lambda run=run: supervisor_of(run.folder) is None)
        return Counter(
            {
                "done": count,
                "wrong": wrong,
                "lost": lost + sum(run.attempt != 1 for run in runs.values()),
                "corrupt": sum(is_damaged(run) for run in (runs["publish"], *waiting)),
                "published twice": sum(
                    len(list(run.folder.glob("attempts/*/MANIFEST.json"))) - 1 for run in waiting
                ),
                "orphans": sum(len(list(processes_of(run.folder))) for run in runs.values()),
            }
        )


def drop_streams(count: int, folder: Path) -> Report:
    """Drop a stream of a run's reports after some of them, and come back with the last name."""
    chance = np.random.default_rng(16)
    write_sheet(folder / "sequences" / "sheet")
    with queue_world(folder, folder / "bundled") as world, serving(world) as port:
        run_id = world.launch("script")
        world.until(run_id, "running")
        files = psutil.Process().num_fds()
        heard: list[int] = []
        written, last, done = 0, "", 0
        while done < count:
            if written - len(heard) < 50:
                reports = [
                    ["report", "first", i, 10**6, 1.0] for i in range(written, written + 100)
                ]
                world.tell(run_id, *reports)
                written += 100
                until(partial(_has_told, world.folder(run_id), written))
            numbers, last = _hear(port, world.token, run_id, last, int(chance.integers(1, 6)))
            heard += numbers
            done += 1
        until(lambda: psutil.Process().num_fds() <= files + 2)
        world.client.post(f"/api/v1/runs/{run_id}/cancel")
        world.until(run_id, "cancelled")
    times = Counter(heard)
    return {
        "done": done,
        "reports": len(heard),
        "lost": sum(number not in times for number in range(len(heard))),
        "wrong": sum(times.values()) - len(times) + (heard != sorted(heard)),
    }


def _hear(port: int, token: str, run_id: str, last: str, most: int) -> tuple[list[int], str]:
    """Hear some reports of a run and hang up; gives their numbers and the last event's name."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
    headers = {"Authorization": f"Bearer {token}", "Host": f"127.0.0.1:{port}"}
    headers |= {"Last-Event-ID": last} if last else {}
    connection.request("GET", f"/api/v1/runs/{run_id}/events", headers=headers)
    answer = connection.getresponse()
    assert answer.status == 200, answer.read()
    numbers: list[int] = []
    fields: dict[str, str] = {}
    try:
        while len(numbers) < most:
            line = answer.readline().decode().rstrip("\n")
            if line:
                name, _, value = line.partition(": ")
                fields[name] = value
                continue
            if "id" in fields:
                last = fields["id"]
            if fields.get("event") == "progress":
                numbers.append(json.loads(fields["data"])["seq"])
            fields = {}
    finally:
        connection.close()
        answer.close()
    return numbers, last


CASES = {
    "R3": Case("The server is killed while two fits run", 100, 0, kill_servers),
    "R4": Case(
        "The server is killed, and its index deleted",
        50,
        1,
        partial(kill_servers, forgets=True),
    ),
    "R16": Case("A stream of a run's reports is dropped, and taken up again", 500, 8, drop_streams),
}
