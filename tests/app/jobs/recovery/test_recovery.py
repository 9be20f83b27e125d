"""Damaged folders: listed with their reason, moved aside, and no hindrance to anything else."""

import json
import os
import shutil
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import yaml
from support.hostile.bad_input_world import Terminal, tree
from support.server.queue_world import queue_world
from support.server.run_world import make_run
from support.server.server_world import World, make_world
from support.waiting import until

from app.jobs import scheduler as scheduler_module
from app.jobs.catalog import Catalog
from app.jobs.engines import local_engine
from app.jobs.recovery.left_behind import LeftBehind, find_left_behind, tidy
from app.jobs.scheduler import Scheduler
from app.settings import ServerSettings
from physhandi.data.files import stopped_name, temporary_name
from physhandi.data.run_folder import new_run_id
from physhandi.data.sequence import Sequence
from physhandi.errors import RunError
from physhandi.run import Run


def changed(path: Path, **fields: Any) -> None:
    """Change fields of a YAML or JSON file."""
    is_yaml = path.suffix == ".yaml"
    content = (yaml.safe_load if is_yaml else json.loads)(path.read_text()) | fields
    path.write_text(yaml.safe_dump(content) if is_yaml else json.dumps(content))


RUNS: dict[str, tuple[Callable[[Path], Any], str]] = {
    # damage, what is told; the first three took the server down
    "path": (lambda run: changed(run / "job.yaml", sequences=[1]), "'sequences[0]' is wrong"),
    "label": (lambda run: changed(run / "run.yaml", label=[1, 2]), "'label' is wrong"),
    "ticket": (
        lambda run: [
            (run / "queued.json").write_text("[" * 3000),
            (run / "run.yaml").write_bytes(b"\xff"),
        ],
        "run.yaml cannot be read",
    ),
    "end": (lambda run: (run / "exit.json").write_text('{"state": 3}'), "'state' is wrong"),
    "current": (lambda run: (run / "current").write_bytes(b"\xff"), "'current' does not lead"),
}


@pytest.fixture
def damaged(data_dir: Path, fitted_folder: Path, tmp_path: Path) -> World:
    """A server with a good run and a good sequence among damaged ones, whose queue stands still."""
    shutil.copytree(fitted_folder, data_dir / "runs" / "whole")
    for name, (damage, _) in RUNS.items():
        damage(shutil.copytree(fitted_folder, data_dir / "runs" / name))
    bad = shutil.copytree(data_dir / "sequences" / "sheet", data_dir / "sequences" / "bad")
    changed(bad / "sequence.yaml", frame_rate="fast")
    return make_world(data_dir, bundled=tmp_path / "nothing")


def test_damaged_folders_are_rows_among_the_others(damaged: World) -> None:
    client, browser = damaged.script(), damaged.browser()
    listed = {run["id"]: run for run in client.get("/api/v1/runs").json()["runs"]}
    assert set(listed) == {"whole", *RUNS}
    assert listed["whole"]["state"] == "succeeded"
    pages = {path: browser.get(path).text for path in ("/", "/runs", "/recovery", "/system")}
    for name, (_, words) in RUNS.items():
        assert listed[name]["state"] == "damaged"
        assert words in listed[name]["reason"] == listed[name]["error"]
        shown = words.replace("'", "&#39;")
        assert shown in pages["/runs"]
        assert shown in pages["/recovery"]
        page = browser.get(f"/runs/{name}").text
        assert "This run is damaged" in page
        assert shown in page
        assert f'data-aside="runs" data-id="{name}"' in page
    assert 'data-id="whole" data-name' not in pages["/recovery"]
    chosen = client.get("/api/v1/runs?q=is:damaged -state:failed").json()["runs"]
    assert {run["id"] for run in chosen} == set(RUNS)
    sequences = {s["id"]: s["error"] for s in client.get("/api/v1/sequences").json()["sequences"]}
    assert sequences["sheet"] is None
    assert "frame_rate is 'fast'" in sequences["bad"]
    assert "frame_rate is &#39;fast&#39;" in browser.get("/sequences").text
    found = client.get("/api/v1/recovery").json()
    assert {(f["kind"], f["id"]) for f in found["damaged"]} == {
        ("sequences", "bad"),
        *(("runs", name) for name in RUNS),
    }


def test_the_queue_and_a_new_server_go_on_beside_damaged_folders(damaged: World) -> None:
    again = Scheduler(damaged.settings, Catalog(damaged.settings))
    run_id = again.launch(["sheet"], "quick").id
    with patch.object(local_engine, "start_supervisor") as start:
        start.return_value.poll.return_value = None
        again.start()
    again.shutdown()
    assert [Path(call.args[0][1]).name for call in start.call_args_list] == [run_id]


def test_a_damaged_run_is_moved_aside_whole(damaged: World, fitted_folder: Path) -> None:
    client, runs = damaged.script(), damaged.settings.run_dir
    before = tree(runs / "path")
    answer = client.post("/api/v1/runs/path/aside")
    assert (answer.status_code, answer.json()["moved_to"]) == (200, "damaged/runs/path")
    target = damaged.settings.damaged_dir / "runs" / "path"
    assert tree(target) == before
    assert not (runs / "path").exists()
    assert client.get("/api/v1/runs/path").status_code == 404
    shutil.copytree(target, runs / "path")
    assert client.post("/api/v1/runs/path/aside").json()["name"] == "path-2"
    assert tree(target) == before
    (target.parent / "path-2.txt").unlink()
    aside = client.get("/api/v1/recovery").json()["aside"]
    assert [moved["name"] for moved in aside] == ["path", "path-2"]
    assert "'sequences[0]' is wrong" in aside[0]["why"]
    assert (aside[1]["time"], aside[1]["why"]) == ("", "")
    assert "damaged/runs/path-2" in damaged.browser().get("/recovery").text


def test_only_what_is_damaged_and_at_rest_is_moved_aside(
    damaged: World, fitted_folder: Path
) -> None:
    client, folders = damaged.script(), (damaged.settings.run_dir, damaged.settings.sequence_dir)
    before = [tree(folder) for folder in folders]
    for path, status, words in (
        ("runs/whole", 409, "'whole' is succeeded"),
        ("runs/nobody", 404, "no run 'nobody'"),
        ("sequences/sheet", 409, "'sheet' can be read"),
        ("sequences/nobody", 404, "no sequence 'nobody'"),
        ("runs/..%2fwhole", 404, ""),
    ):
        answer = client.post(f"/api/v1/{path}/aside")
        assert answer.status_code == status, answer.text
        assert words in answer.text
    assert damaged.client().post("/api/v1/runs/path/aside").status_code == 401
    foreign = damaged.browser()
    headers = {"Origin": "http://evil.example"}
    assert foreign.post("/api/v1/runs/path/aside", headers=headers).status_code == 403
    assert [tree(folder) for folder in folders] == before
    made_with = make_world(damaged.settings.data_dir / "other", bundled=damaged.settings.data_dir)
    refused = made_with.script().post("/api/v1/runs/path/aside")
    assert (refused.status_code, "came with the program" in refused.text) == (409, True)
    # Its label was damaged while it was at work.
    path = damaged.settings.run_dir / "busy"
    shutil.copytree(fitted_folder, path)
    with Run.open(path).begin_attempt() as attempt:
        changed(path / "run.yaml", label=[1])
        refused = client.post("/api/v1/runs/busy/aside")
        assert (refused.status_code, "processes work on it" in refused.text) == (409, True)
        attempt.publish()
    assert client.post("/api/v1/runs/busy/aside").status_code == 200


def test_a_damaged_sequence_is_moved_aside_unless_a_run_waits_for_it(damaged: World) -> None:
    client, folder = damaged.script(), damaged.settings.sequence_dir / "bad"
    run = make_run(damaged.settings.run_dir / new_run_id(), sequences=[str(folder.parent / "x")])
    changed(run.folder / "job.yaml", sequences=[str(folder)])
    (run.folder / "queued.json").write_text('{"time": 1.0}')
    refused = client.post("/api/v1/sequences/bad/aside")
    assert (refused.status_code, "waits to be fitted" in refused.text) == (409, True)
    (run.folder / "queued.json").unlink()
    before = tree(folder)
    assert client.post("/api/v1/sequences/bad/aside").json()["moved_to"] == "damaged/sequences/bad"
    assert tree(damaged.settings.damaged_dir / "sequences" / "bad") == before
    assert [s["id"] for s in client.get("/api/v1/sequences").json()["sequences"]] == ["sheet"]


def test_what_only_lost_its_end_can_be_resumed_or_deleted(damaged: World) -> None:
    client = damaged.script()
    assert client.post("/api/v1/runs/end/resume").json()["state"] == "queued"
    assert client.delete("/api/v1/runs/current").status_code == 204
    refused = client.delete("/api/v1/runs/path")
    assert (refused.status_code, "'sequences[0]' is wrong" in refused.text) == (409, True)
    assert (damaged.settings.run_dir / "path").is_dir()


def test_a_report_that_is_damaged_costs_no_more_than_the_report(
    damaged: World, fitted_folder: Path
) -> None:
    path = shutil.copytree(fitted_folder, damaged.settings.run_dir / "torn")
    (path / "progress.json").write_text('{"iteration": 3}')
    run = damaged.script().get("/api/v1/runs/torn").json()
    assert (run["state"], run["progress"]) == ("succeeded", {})
    assert "field 'stage' is missing" in run["reason"]
    assert "field &#39;stage&#39; is missing" in damaged.browser().get("/runs/torn").text
    with Run.open(path).begin_attempt():
        at_work = damaged.script().get("/api/v1/runs/torn").json()
        assert at_work["state"] == "running"
        assert "field 'stage' is missing" in at_work["reason"]


def test_a_defect_at_one_folder_hides_no_other(
    damaged: World, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    open_run = Run.open

    def fails_once(folder: Path) -> Run:
        if folder.name == "whole":
            raise TypeError("a mistake")
        return open_run(folder)

    monkeypatch.setattr(Run, "open", fails_once)
    monkeypatch.setattr(Run, "state", property(lambda _: 1 / 0))
    runs = {run["id"]: run for run in damaged.script().get("/api/v1/runs").json()["runs"]}
    assert {run["state"] for run in runs.values()} == {"damaged"}
    assert "TypeError: a mistake" in runs["whole"]["reason"]
    assert "ZeroDivisionError" in runs["end"]["reason"]
    assert "whole cannot be opened" in caplog.text


# ---- what is left behind


def dead_process() -> int:
    """Give the number of a process that has ended."""
    child = subprocess.Popen(["true"])
    child.wait()
    return child.pid


def named_for(process: int, name: str) -> str:
    return temporary_name(name).replace(f"-{os.getpid()}-", f"-{process}-")


@contextmanager
def live_process() -> Iterator[int]:
    child = subprocess.Popen(["cat"], stdin=subprocess.PIPE)
    try:
        yield child.pid
    finally:
        child.communicate()


def claim(run: Path, **fields: Any) -> None:
    host = socket.gethostname()
    about = {"nonce": "a", "pid": 1, "process": "gone", "host": host, "time": 1.0}
    (run / "lease.json").write_text(json.dumps(about | fields))


def test_what_killed_processes_left_is_removed_and_nothing_else(
    data_dir: Path, fitted_folder: Path
) -> None:
    settings = ServerSettings(data_dir=data_dir)
    run = shutil.copytree(fitted_folder, data_dir / "runs" / "fitted")
    dead = dead_process()
    with live_process() as live:
        gone = [
            data_dir / named_for(dead, "launches.json"),
            run / named_for(dead, "progress.json"),
            run / "attempts/1/out/object" / named_for(dead, "material.safetensors"),
            run / "attempts" / named_for(dead, "2") / "out" / "a.npy",
            data_dir / "runs" / named_for(dead, "new") / "job.yaml",
            data_dir / "runs" / ".old.0123.deleted" / "attempts" / "a",
            data_dir / "sequences" / named_for(dead, "torn") / "control.npy",
            data_dir / "sequences/sheet/views" / named_for(dead, "annotation") / "a.png",
            data_dir / "cache/exports" / (named_for(dead, "film") + ".mp4"),
            data_dir / "shares" / named_for(dead, "secret") / "page.html",
        ]
        kept = [
            run / named_for(live, "progress.json"),
            run / named_for(dead, "x").replace(".tmp", ".npy"),
            data_dir / "runs" / ".x.elsewhere-1-0123.tmp" / "job.yaml",
            data_dir / "sequences" / named_for(dead, "film") / ".checkpoints",
            data_dir / "sequences" / stopped_name("film") / ".checkpoints",
            data_dir / "captures" / named_for(dead, "mine"),
        ]
        before = tree(data_dir)
        for path in (*gone, *kept):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text("x")
        found = find_left_behind(settings)
        assert len(found.temporaries) == len(gone)
        assert {path.name for path in found.imports} == {kept[3].parent.name, kept[4].parent.name}
        tidy(found)
        after = tree(data_dir)
        assert all(path.exists() for path in kept)
        assert before.items() <= after.items()
        ours = {path.relative_to(data_dir).as_posix() for path in gone}
        assert not [rel for rel in after if rel in ours or rel.endswith(".deleted")]
        again = find_left_behind(settings)
        assert (again.temporaries, again.claims, again.replaced) == ((), (), ())


def test_claims_of_processes_that_are_gone_are_released(
    data_dir: Path, fitted_folder: Path
) -> None:
    for name in ("gone", "torn", "remote"):
        shutil.copytree(fitted_folder, data_dir / "runs" / name)
    claim(data_dir / "runs/gone")
    (data_dir / "runs/torn/lease.json").write_text("[" * 3000)
    claim(data_dir / "runs/remote", host="another-machine")
    at_work = make_run(data_dir / "runs" / "at-work", sequences=["/data/sheet"])
    with at_work.begin_attempt() as attempt:
        found = find_left_behind(ServerSettings(data_dir=data_dir))
        assert {path.name for path in found.claims} == {"gone", "torn"}
        # Somebody claims one of them before it is released.
        with Run.open(data_dir / "runs/torn").begin_attempt() as other:
            tidy(found)
            other.publish()
        assert {path.parent.name for path in (data_dir / "runs").glob("*/lease.json")} == {
            "remote",
            "at-work",
        }
        attempt.publish()


def test_a_sequence_whose_replacement_was_interrupted_is_put_back(data_dir: Path) -> None:
    sequences = data_dir / "sequences"
    before = tree(sequences / "sheet")
    settings = ServerSettings(data_dir=data_dir)
    shutil.copytree(sequences / "sheet", sequences / ".other.replaced")
    (sequences / "other").mkdir()
    (sequences / "sheet").rename(sequences / ".sheet.replaced")
    with live_process() as live:  # It is about to move the new one there.
        new = sequences / named_for(live, "sheet")
        new.mkdir()
        assert find_left_behind(settings).replaced == ()
        new.rmdir()
    found = find_left_behind(settings)
    assert found.replaced == (sequences / "sheet",)
    tidy(found)
    assert tree(sequences / "sheet") == before
    assert Sequence.load(sequences / "sheet").name == "sheet"


def test_a_server_tells_what_it_found_when_it_started(
    data_dir: Path, fitted_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scheduler_module, "_SWEEP_INTERVAL_S", 0.0)
    lost = shutil.copytree(fitted_folder, data_dir / "runs" / "lost")
    (lost / "exit.json").unlink()
    (lost / "started.json").write_text('{"time": 1.0, "starts": 2, "why": ""}')
    claim(lost)
    (lost / named_for(dead_process(), "progress.json")).write_text("{")
    with queue_world(data_dir, tmp_path / "nothing") as world:
        asked: dict[str, Any] = {}

        def has_looked() -> bool:
            asked.update(world.client.get("/api/v1/recovery").json())
            return bool(asked["looked"] and asked["restarted"])

        until(has_looked, lambda: asked)
        page = world.client.get("/recovery").text
    assert asked["problem"] == ""
    assert [Path(name).parent.as_posix() for name in asked["temporaries"]] == ["runs/lost"]
    assert asked["claims"] == ["runs/lost"]
    (restart,) = asked["restarted"]
    assert (restart["run"], restart["why"].endswith("It has failed.")) == ("lost", True)
    assert 'href="runs/lost"' in page
    assert "Nothing was left behind" not in page


def test_a_disk_that_refuses_is_told(data_dir: Path, tmp_path: Path) -> None:
    replaced = data_dir / "sequences" / ".lost.replaced"
    replaced.mkdir()
    left = LeftBehind(replaced=(data_dir / "sequences" / "lost",))
    with (
        patch.object(Path, "rename", side_effect=PermissionError(13, "no")),
        pytest.raises(PermissionError),
    ):
        tidy(left)
    assert replaced.is_dir()


# ---- the command line


def test_the_doctor_tells_what_is_damaged_and_what_is_left(
    damaged: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal, data = Terminal(tmp_path, capsys), damaged.settings.data_dir
    (data / "launches.json").write_text("[" * 3000)
    (data / "runs/whole" / named_for(dead_process(), "x.json")).write_text("x")
    (data / "presets/edits").mkdir(parents=True)
    (data / "presets/a.yaml").write_text("[")
    (data / "presets/edits/b.json").write_text("[")
    (data / "shares/b").mkdir(parents=True)
    before = tree(data)
    code, out, _ = terminal("doctor", "--data-dir", data)
    assert code == 1
    assert tree(data) == before
    failed = [line for line in out.splitlines() if line.startswith("FAIL")]
    for name, (_, words) in RUNS.items():
        assert any(line.startswith(f"FAIL  runs/{name}: ") and words in line for line in failed)
    for words in (
        "sequences/bad: ",
        "launches.json",
        "presets/a.yaml",
        "presets/edits/b.json",
        "share.json",
    ):
        assert any(words in line for line in failed), words
    assert len(failed) == len(RUNS) + 5
    assert "has 6 runs and 2 sequences, 6 of them damaged" in out
    assert "note  1 were left unfinished" in out


def test_the_doctor_is_content_with_what_was_mended(
    damaged: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal, client = Terminal(tmp_path, capsys), damaged.script()
    for path in ("sequences/bad", *(f"runs/{name}" for name in RUNS)):
        assert client.post(f"/api/v1/{path}/aside").status_code == 200
    at_work = Scheduler(damaged.settings, Catalog(damaged.settings))
    at_work.start()
    code, out, _ = terminal("doctor", "--data-dir", damaged.settings.data_dir)
    at_work.shutdown()
    assert (code, "FAIL" in out) == (0, False), out
    assert "has 1 runs and 1 sequences, 0 of them damaged" in out
    assert f"a server (process {os.getpid()}) works on it" in out
    assert "note  6 moved aside: " in out


def test_the_index_is_made_anew_from_the_folders(
    damaged: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal, path = Terminal(tmp_path, capsys), damaged.settings.index_path
    path.parent.mkdir(parents=True)
    path.write_text("[" * 3000)
    code, out, error = terminal("reindex", "--data-dir", damaged.settings.data_dir, "--json")
    assert (code, error) == (0, "")
    found = json.loads(out)
    assert found["runs"] == 3  # With those that can be opened, but lost their end or results.
    assert set(found["damaged"]) == {"sequences/bad", *(f"runs/{name}" for name in RUNS)}
    stored = json.loads(path.read_text())["runs"]
    own = {Path(folder).name for folder in stored if folder.startswith(str(path.parents[1]))}
    assert own == {"whole", "end", "current"}
    # It is what a server reads: a name that only the index has is shown.
    folder = str(damaged.settings.run_dir / "whole")
    text = path.read_text().replace('"a sheet"', '"from the index"')
    path.write_text(text)
    assert Catalog(damaged.settings).run_item("whole").run is not None
    (item,) = [i for i in Catalog(damaged.settings).runs() if str(i.folder) == folder]
    assert item.run is not None
    assert item.run.name == "from the index"
    for wrong in ({"name": 5}, {"label": [1]}):
        index = json.loads(text)
        index["runs"][folder]["about"] |= wrong
        index["configs"] = dict.fromkeys(index["configs"])
        path.write_text(json.dumps(index))
        (item,) = [i for i in Catalog(damaged.settings).runs() if str(i.folder) == folder]
        assert item.run is not None
        assert item.run.name == "a sheet"
        assert item.run.config["profile"]["profile"]
    with patch("app.jobs.catalog.write_atomically", side_effect=OSError(28, "full")):
        assert terminal("reindex", "--data-dir", damaged.settings.data_dir)[0] == 1


def test_a_run_that_is_gone_cannot_be_moved_aside(damaged: World) -> None:
    item = damaged.catalog.run_item("path")
    shutil.rmtree(item.folder)
    with (
        patch.object(damaged.catalog, "run_item", return_value=item),
        pytest.raises(RunError, match="is gone"),
    ):
        damaged.scheduler.set_aside("path")
