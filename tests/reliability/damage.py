"""Damaged and half-written folders, and one of an older version."""

import os
import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
from support.hostile.damaged_files import damage_file
from support.inputs.old_data import differences, read_record, serve, settle, unpack
from support.inputs.sheet_sequence import write_sheet
from support.server.server_world import World, fit_sheet, make_world
from support.waiting import until

from app.jobs.catalog import DEFECT
from app.jobs.engines.local_engine import LocalEngine
from app.jobs.processes import end_processes
from app.jobs.recovery.left_behind import find_left_behind, tidy
from app.jobs.recovery.recovery import damaged_folders
from app.settings import ServerSettings
from app.viewer.content.content import open_run_content
from physhandi.data.sequence import Sequence
from physhandi.errors import PhysHandiError
from physhandi.run import Run
from reliability import Case, Report
from reliability.jobs import is_damaged, state_of

OUT = "attempts/1/out"
RUN_FILES = (
    *("job.yaml", "run.yaml", "exit.json", "current", "events.jsonl", "progress.json"),
    *("attempts/1/stages.json", "attempts/1/MANIFEST.json"),
    *(f"{OUT}/{name}.json" for name in ("metrics", "losses", "environment")),
    *(f"{OUT}/object/parameters.yaml", f"{OUT}/sequences/sheet/meta.yaml"),
    f"{OUT}/sequences/sheet/frame_errors.json",
)
"""Files of a run that are damaged."""
_STARTS_A_PROCESS = {"/runs/{run_id}/view", "/api/v1/runs/{run_id}/replay.viser"}


def corrupt_inputs(count: int, folder: Path) -> Report:
    """Damage a file of each of many runs and sequences by type and structure, and ask for all."""
    write_sheet(folder / "sequences" / "sheet")
    good = fit_sheet(folder / "runs" / "good", folder / "sequences" / "sheet")
    chance = np.random.default_rng(10)
    damaged: dict[str, list[str]] = {"run_id": [], "sequence_id": []}
    for number in range(count):
        name, is_run = f"bad{number}", number % 4 != 3
        copy = shutil.copytree(
            good.folder if is_run else folder / "sequences" / "sheet",
            folder / ("runs" if is_run else "sequences") / name,
        )
        file = RUN_FILES[number % len(RUN_FILES)] if is_run else "sequence.yaml"
        damage_file(copy / file, lambda options: options[int(chance.integers(len(options)))])
        damaged["run_id" if is_run else "sequence_id"].append(name)
    counts: Counter[str] = Counter(wrong=0, lost=0, requests=0)
    for _ in range(2):  # The second is a server that was started on the damaged folder.
        world = make_world(folder, bundled=folder / "nothing")
        world.app.state.stopping.set()  # So that event streams end.
        with _Working(world):
            _ask_for_all(world, damaged, counts)
            run = world.scheduler.launch(["sheet"], "quick", "publish")
            until(partial(_has_ended, world, run))
            _see_the_good_ones(world, good.id, counts)
    found = damaged_folders(world.catalog, world.scheduler)
    return {"done": count, "unreadable": len(found), **counts}


class _Working:
    def __init__(self, world: World) -> None:
        self._scheduler, self._run_dir = world.scheduler, world.settings.run_dir

    def __enter__(self) -> None:
        self._scheduler.start()

    def __exit__(self, *_: object) -> None:
        self._scheduler.shutdown()
        for run_folder in self._run_dir.iterdir():
            end_processes(run_folder, grace_s=0.0)
        for process in self._scheduler._local.started.values():
            process.wait()


def _ask_for_all(world: World, damaged: dict[str, list[str]], counts: Counter[str]) -> None:
    """Ask for every page and every answer of the API, about everything that is damaged."""
    for path in _addresses(world):
        kind = next((kind for kind in damaged if f"{{{kind}}}" in path), None)
        for name in damaged[kind] if kind else ("",):
            values = {**dict.fromkeys(("run_id", "sequence_id"), name), "view_name": "front"}
            address = re.sub(r"\{(\w+)[^}]*\}", lambda part: values.get(part[1], "0"), path)  # noqa: B023
            is_api = path.startswith("/api/")
            client = world.script() if is_api else world.browser()
            client._transport.raise_server_exceptions = False
            counts["requests"] += 1
            counts["wrong"] += client.get(address).status_code >= 500
    for run_id in damaged["run_id"]:
        try:
            open_run_content(world.catalog, run_id).close()
        except (PhysHandiError, OSError):
            continue  # It says which file is damaged.


def _addresses(world: World) -> Iterator[str]:
    listed = {path for path, methods in world.app.openapi()["paths"].items() if "get" in methods}
    for route in world.app.routes:
        if "GET" in (getattr(route, "methods", None) or ()):
            listed.add(route.path)
    yield from sorted(
        path
        for path in listed - _STARTS_A_PROCESS
        if "share_id" not in path and "chart" not in path
    )
    yield from ("/diff?run=good&run={run_id}", "/launch?run={run_id}", "/compare?a=good&b={run_id}")
    yield from ("/api/v1/comparison?a=good&b={run_id}", "/api/v1/settings?run={run_id}")
    yield from ("/api/v1/runs?sort=-created", "/api/v1/runs?sort=fitted", "/runs?q=is:damaged")


def _has_ended(world: World, run: Run) -> bool:
    return state_of(world.scheduler, run) == "succeeded"


def _see_the_good_ones(world: World, good: str, counts: Counter[str]) -> None:
    listed = world.script().get("/api/v1/runs").json()["runs"]
    sequences = world.script().get("/api/v1/sequences").json()["sequences"]
    told = [run["reason"] for run in listed] + [sequence["error"] or "" for sequence in sequences]
    counts["wrong"] += sum(DEFECT in reason for reason in told)  # Nobody foresaw that damage.
    counts["lost"] += {run["id"]: run["state"] for run in listed}.get(good) != "succeeded"
    counts["lost"] += [s["error"] for s in sequences if s["id"] == "sheet"] != [None]


def open_old_folders(count: int, folder: Path) -> Report:
    """Open the data folder of an older version, kill what goes on with its fits, and open again."""
    expected = read_record("expected")
    counts: Counter[str] = Counter(lost=0, corrupt=0, wrong=0)
    for number in range(count):
        data = settle(unpack(folder / f"old{number}"))
        for _ in range(2):
            world = serve(data)
            script, browser = world.script(), world.browser()
            listed = {run["id"]: run for run in script.get("/api/v1/runs").json()["runs"]}
            for run_id, was in expected["runs"].items():
                told = listed.get(run_id, {})
                both = {field: value for field, value in was.items() if field in told}
                counts["lost"] += not told or differences(both, told) != []
            for path in expected["pages"]:
                counts["wrong"] += browser.get(path).status_code != 200
            counts["wrong"] += damaged_folders(world.catalog, world.scheduler) != []
            for run_folder in sorted(world.settings.run_dir.iterdir()):
                run = Run.open(run_folder)
                counts["corrupt"] += run.is_published and is_damaged(run)
            tidy(find_left_behind(world.settings))
            with patch.object(LocalEngine, "start") as start:
                world.scheduler.start()
                world.scheduler.shutdown()
            # What the queue of the older server had not begun is begun by this one.
            begun = [call.args[0].name for call in start.call_args_list]
            counts["lost"] += begun != [expected["ids"]["waiting"]]
            (world.settings.run_dir / expected["ids"]["waiting"] / "started.json").rename(
                world.settings.run_dir / expected["ids"]["waiting"] / "queued.json"
            )
    return {"done": count, "runs": len(expected["runs"]), **counts}


def leave_half_done(count: int, folder: Path) -> Report:
    """Kill processes in the middle of writing, then tidy while another one writes."""
    settings = ServerSettings(data_dir=folder)
    sheet = write_sheet(settings.sequence_dir / "sheet").folder
    deeds = ("write", "replace", "begin", "create", "delete")

    def new_run(name: str) -> Run:
        return Run.create(
            settings.run_dir / name,
            name=name,
            kind="reconstruction",
            sequences=[str(sheet)],
            config={},
        )

    runs = [new_run(f"run{number}") for number in range(count)]
    alive = new_run("alive")
    worker = _start("write", alive.folder)
    found = leaked = lost = 0
    for number, run in enumerate(runs):
        deed = deeds[number % len(deeds)]
        child = _start(deed, sheet if deed == "replace" else run.folder)
        os.kill(child.pid, signal.SIGKILL)
        child.communicate()
        left = find_left_behind(settings)
        found += len(left.temporaries) + len(left.claims) + len(left.replaced)
        tidy(left)
        again = find_left_behind(settings)
        leaked += len(again.temporaries) + len(again.claims) + len(again.replaced)
        lost += run.folder.exists() == (deed == "delete")
        lost += Sequence.load(sheet).frame_count == 0
    names = [path.name for path in folder.rglob(".*.tmp*")]
    leaked += len(names) - 1  # That of the process that is at work.
    worker.communicate("go on\n")
    lost += Run.open(alive.folder).state != "succeeded"
    return {"done": count, "found": found, "leaked": leaked, "lost": lost}


def _start(deed: str, folder: Path) -> "subprocess.Popen[str]":
    """Start a process and wait until it is in the middle of its deed."""
    tests = Path(__file__).parents[1]
    child = subprocess.Popen(
        [sys.executable, str(tests / "support/hostile/half_done.py"), deed, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tests.parent), str(tests)])},
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "half\n"
    return child


CASES = {
    "R10": Case(
        "A file of a run or sequence is damaged, and every page and answer is asked for",
        120,
        4,
        corrupt_inputs,
    ),
    "R20": Case("The data folder of an older version is opened", 5, 1, open_old_folders),
    "R21": Case("A process is killed in the middle of writing", 50, 5, leave_half_done),
}
