"""Bad requests and damaged folders, met through the server's API and pages."""

import errno
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient
from support.hostile.bad_input_world import bad, both, fields, put, removed, table, text, truncated
from support.server.server_world import World, make_world

from app.jobs.worker import fill_run
from physhandi.errors import PhysHandiError
from physhandi.run import Run

OUT = "attempts/1/out"
SHEET = f"{OUT}/sequences/sheet"


@pytest.fixture(scope="module")
def shared(
    tmp_path_factory: pytest.TempPathFactory,
    sheet_folder: Path,
    filmed_folder: Path,
    fitted_folder: Path,
) -> Iterator[World]:
    """A server with a whole run and one for each damage, for tests that change nothing."""
    data = tmp_path_factory.mktemp("shared")
    for folder in (sheet_folder, filmed_folder):
        shutil.copytree(folder, data / "sequences" / folder.name)
    shutil.copytree(fitted_folder, data / "runs" / "whole")
    for name, (damage, _) in RUNS.items():
        damage(shutil.copytree(fitted_folder, data / "runs" / id_of(name)))
    world = make_world(data, bundled=data / "nothing")
    yield world
    world.sessions.shutdown()


@pytest.fixture(scope="module")
def client(shared: World) -> TestClient:
    return shared.script()


@pytest.fixture
def world(tmp_path: Path, sheet_folder: Path, filmed_folder: Path) -> Iterator[World]:
    """A server with two recordings, to damage."""
    data = tmp_path / "data"
    for folder in (sheet_folder, filmed_folder):
        shutil.copytree(folder, data / "sequences" / folder.name)
    (data / "runs").mkdir()
    world = make_world(data, bundled=tmp_path / "nothing")
    yield world
    world.sessions.shutdown()


def id_of(name: str) -> str:
    """The folder of the run with this damage."""
    return name.replace(" ", "-").replace(".", "-")


def refusal(response: Any) -> str:
    """Check that an answer of the API is a clear refusal; returns its message."""
    assert 400 <= response.status_code < 500, response.text
    assert list(response.json()) == ["error"]
    assert "Traceback" not in response.text
    return response.json()["error"]["message"]


RUN = {"sequences": ["sheet"]}
LAUNCHES: dict[str, tuple[Any, int, str]] = {
    "no body": ("", 422, "body"),
    "no JSON": ("{'sequences'", 422, "JSON"),
    "no object": ([1, 2], 422, "body"),
    "no sequences": ({"sequences": []}, 422, "sequences"),
    "too many sequences": ({"sequences": ["sheet"] * 65}, 422, "sequences"),
    "text for a list": ({"sequences": "sheet"}, 422, "sequences"),
    "NaN for a list": ('{"sequences": NaN}', 422, "sequences"),
    "unknown sequence": ({"sequences": ["towel"]}, 404, "'towel'"),
    "path for a sequence": ({"sequences": ["../../etc"]}, 422, "sequences"),
    "same sequence twice": ({"sequences": ["sheet", "sheet"]}, 409, "'sheet'"),
    "unknown profile": (RUN | {"profile": "fastest"}, 422, "'fastest'"),
    "path for a profile": (RUN | {"profile": "../quick"}, 422, "profile"),
    "endless name": (RUN | {"name": "x" * 121}, 422, "name"),
    "name with a NUL": (RUN | {"name": "a\0b"}, 422, "name"),
    "name of two lines": (RUN | {"name": "a\nb"}, 422, "name"),
    "name that turns round": (RUN | {"name": "\u202efdp.exe"}, 422, "name"),
    "endless radius": (
        RUN | {"overrides": {"simulation.connection_radius": 1e9}},
        422,
        "simulation.connection_radius is 1000000000.0; expected a number from 0 to 1000.",
    ),
    "endless neighbors": (
        RUN | {"overrides": {"simulation.max_neighbors": 10**9}},
        422,
        "from 0 to 1000",
    ),
    "infinite stiffness": (
        RUN | {"overrides": {"simulation.stiffness": 1e308}},
        422,
        "simulation.stiffness",
    ),
    "negative parameter": (RUN | {"parameters": {"drag": -1}}, 422, "parameters"),
    "NaN parameter": ('{"sequences": ["sheet"], "drag": NaN}', 422, "drag"),
    "deep body": ("[" * 100_000, 400, "body"),
}


@table(LAUNCHES)
def test_a_senseless_launch_is_refused(
    shared: World, client: TestClient, case: tuple[Any, int, str]
) -> None:
    body, status, word = case
    before = sorted(shared.settings.run_dir.iterdir())
    content = body if isinstance(body, str) else json.dumps(body)
    headers = {"Content-Type": "application/json"}
    response = client.post("/api/v1/runs", content=content, headers=headers)
    assert response.status_code == status, response.text
    assert word in refusal(response)
    assert sorted(shared.settings.run_dir.iterdir()) == before


def test_an_endless_body_is_not_read(client: TestClient) -> None:
    def parts() -> Iterator[bytes]:
        for _ in range(2**10 + 1):  # Without a length that was announced.
            yield b"[" * 2**10

    for content in ("[" * (2**20 + 1), parts()):
        headers = {"Content-Type": "application/json"}
        response = client.post("/api/v1/runs", content=content, headers=headers)
        assert response.status_code == 413
        assert response.json()["error"]["code"] == "too_large"
        assert refusal(response) == "The request is too large: at most 1 MiB are read."
        assert response.headers["connection"] == "close"
    response = client.post("/api/v1/runs", content=" " * 2**20, headers=headers)
    assert response.status_code == 422


SESSIONS: dict[str, tuple[Any, int, str]] = {
    "unknown run": ({"kind": "run", "id": "mine"}, 404, "'mine'"),
    "unknown sequence": ({"kind": "sequence", "id": "towel"}, 404, "'towel'"),
    "unknown kind": ({"kind": "file", "id": "whole"}, 422, "kind"),
    "path for an id": ({"kind": "run", "id": "../whole"}, 422, "id"),
    "number for an id": ({"kind": "run", "id": 7}, 422, "id"),
}


@table(SESSIONS)
def test_a_senseless_scene_is_refused(client: TestClient, case: tuple[Any, int, str]) -> None:
    body, status, word = case
    response = client.post("/api/v1/sessions", json=body)
    assert response.status_code == status
    assert word in refusal(response)


IDS = ("../../etc", "%2e%2e", "..%2f..%2fetc%2fpasswd", "a.b", "x" * 65, "%00", "a%0ab", "-/-")
IDS += ("C:x", "%5C%5Chost%5Cs", "CON", "windows%2Fwin.ini", "C%3A%5Cwindows", "con.txt")


@pytest.mark.parametrize(
    "path",
    [
        "runs/{}",
        "runs/{}/losses",
        "runs/{}/frame_errors",
        "runs/{}/log",
        "runs/{}/export?format=npz",
        "runs/{}/events",
        "sequences/{}",
    ],
)
def test_an_id_is_never_a_path(client: TestClient, path: str) -> None:
    for id_ in IDS:
        assert refusal(client.get(f"/api/v1/{path.format(id_)}"))


@pytest.mark.parametrize("path", ["runs/{}", "live/{}", "sequences/{}/thumbnail"])
def test_a_page_of_nothing_is_a_page(shared: World, path: str) -> None:
    browser = shared.browser()
    for id_ in (*IDS, "mine"):
        response = browser.get(f"/{path.format(id_)}")
        assert 400 <= response.status_code < 500
        assert response.headers["content-type"].startswith("text/html")
        assert "Traceback" not in response.text


RUNS: dict[str, tuple[Callable[[Path], Any], str]] = {
    # damage, what a page or the scene names
    "no run.yaml": (removed("run.yaml"), "run.yaml"),
    "torn job.yaml": (truncated("job.yaml", 50), "job.yaml"),
    "job.yaml of a list": (text("job.yaml", lambda _: "[1, 2]"), "job.yaml"),
    "torn metrics": (truncated(f"{OUT}/metrics.json", 30), "metrics.json"),
    "metrics of a list": (text(f"{OUT}/metrics.json", lambda _: "[1]"), "metrics.json"),
    "metrics of numbers": (text(f"{OUT}/metrics.json", lambda _: '{"sheet": 3}'), "metrics.json"),
    "torn losses": (truncated(f"{OUT}/losses.json", 30), "losses.json"),
    "losses of numbers": (text(f"{OUT}/losses.json", lambda _: '{"a": 1}'), "losses.json"),
    "torn parameters": (truncated(f"{OUT}/object/parameters.yaml", 30), "parameters.yaml"),
    "parameters of a list": (
        text(f"{OUT}/object/parameters.yaml", lambda _: "[1]"),
        "parameters.yaml",
    ),
    "torn frame errors": (truncated(f"{SHEET}/frame_errors.json", 9), "frame_errors.json"),
    "frame errors of a list": (
        text(f"{SHEET}/frame_errors.json", lambda _: "[]"),
        "frame_errors.json",
    ),
    "torn stages": (truncated("attempts/1/stages.json", 40), "stages.json"),
    "stages of numbers": (text("attempts/1/stages.json", lambda _: "[3]"), "stages.json"),
    "torn manifest": (truncated("attempts/1/MANIFEST.json", 40), "MANIFEST.json"),
    "torn rollout": (truncated(f"{SHEET}/rollout.npy"), "rollout.npy"),
    "no model": (removed(f"{SHEET}/model.safetensors"), "model.safetensors"),
    "torn meta": (truncated(f"{SHEET}/meta.yaml", 12), "meta.yaml"),
    "torn exit.json": (truncated("exit.json", 10), "exit.json"),
    "exit.json of a list": (text("exit.json", lambda _: "[]"), "exit.json"),
    "torn events": (text("events.jsonl", lambda t: t + '{"seq": 1, "st\n[3]\n"x"\n'), ""),
    "progress of a list": (
        lambda folder: (folder / "progress.json").write_text("[]"),
        "progress.json",
    ),
    "current of words": (lambda folder: (folder / "current").write_text("the last"), ""),
    "current that is not there": (lambda folder: (folder / "current").write_text("7\n"), ""),
    "bytes as a log": (lambda folder: (folder / "log.txt").write_bytes(b"\xff\x00<b>"), ""),
}
PATHS = ("", "/losses", "/frame_errors", "/log", "/export?format=npz", "/export?format=yaml")


@pytest.mark.parametrize("name", RUNS)
def test_a_damaged_run_is_told(shared: World, client: TestClient, name: str) -> None:
    run_id, word = id_of(name), RUNS[name][1]
    told = ""
    for path in PATHS:
        response = client.get(f"/api/v1/runs/{run_id}{path}")
        assert response.status_code < 500, response.text
        assert "Traceback" not in response.text
        told += response.text if path != "/log" else ""
    response = client.post("/api/v1/sessions", json={"kind": "run", "id": run_id})
    told += response.text
    if response.status_code == 201:
        client.delete(f"/api/v1/sessions/{response.json()['id']}")
    browser = shared.browser()
    for path in (f"/runs/{run_id}", f"/runs/{run_id}/parts"):
        page = browser.get(path)
        assert page.status_code < 500
        assert page.headers["content-type"].startswith("text/html")
        assert "Traceback" not in page.text
        told += page.text
    assert word in told


def test_damaged_runs_hide_no_other(shared: World, client: TestClient) -> None:
    listed = {run["id"]: run for run in client.get("/api/v1/runs").json()["runs"]}
    assert set(listed) == {"whole", *map(id_of, RUNS)}
    assert listed["whole"]["state"] == "succeeded"
    page = shared.browser().get("/runs")
    assert page.status_code == 200
    assert all(f'href="runs/{run_id}"' in page.text for run_id in listed)
    assert "Traceback" not in page.text
    response = client.post("/api/v1/sessions", json={"kind": "run", "id": "whole"})
    assert response.status_code == 201


SEQUENCES = {
    "no view": bad(lambda folder: shutil.rmtree(folder / "views"), "views/front"),
    "torn yaml": bad(truncated("sequence.yaml", 30), "sequence.yaml"),
    "unknown field": bad(fields(colour="red"), "'colour'"),
    "no frames": bad(fields(frame_count=0), "frame_count is 0"),
    "endless frames": bad(fields(frame_count=10**12), "frame_count is 1000000000000"),
    "frames with a gap": bad(removed("views/front/mask/00001.png"), "mask of frame 1"),
    "20 joints": bad(
        lambda folder: np.save(folder / "views/front/keypoint.npy", np.zeros((4, 1, 20, 3))), "20"
    ),
}


@table(SEQUENCES)
def test_a_damaged_recording_is_told_and_hides_no_other(world: World, case: Any) -> None:
    client = world.script()
    case.damage(world.settings.sequence_dir / "filmed")
    listed = {item["id"]: item for item in client.get("/api/v1/sequences").json()["sequences"]}
    assert listed["sheet"]["error"] is None
    assert all(word in listed["filmed"]["error"] for word in case.words)
    for response in (
        client.post("/api/v1/runs", json={"sequences": ["filmed"]}),
        client.post("/api/v1/sessions", json={"kind": "sequence", "id": "filmed"}),
        client.get("/sequences/filmed/thumbnail"),
    ):
        message = refusal(response)
        assert all(word in message for word in case.words)
    browser = world.browser()
    home = browser.get("/")
    assert home.status_code == 200
    assert all(word.replace("'", "&#39;") in home.text for word in case.words)
    page = browser.get("/sequences/filmed/thumbnail")
    assert page.status_code == 422
    assert "Traceback" not in page.text


VALUES = {
    # What is only seen when values are read: the fit tells, not the listing.
    "NaN in control": ("sheet", put("control.npy", (4, 0, 0), np.nan), ("control.npy", "frame 4")),
    "millimetres": (
        "sheet",
        both(put("object_node.npy", (3, 0), 250.0)),
        ("object_node.npy", "millimetres"),
    ),
    "torn depth": ("filmed", truncated("views/front/depth/00002.png"), ("depth of frame 2",)),
    "torn color": ("filmed", truncated("views/front/color.mp4", 300), ("color.mp4",)),
}


@table(VALUES)
def test_a_fit_of_wrong_values_fails_with_its_reason_and_advice(
    world: World,
    case: tuple[str, Callable[[Path], Any], tuple[str, ...]],
) -> None:
    client = world.script()
    name, damage, words = case
    response = client.post("/api/v1/runs", json={"sequences": [name]})
    damage(world.settings.sequence_dir / name)
    run_id = response.json()["id"]
    with pytest.raises((PhysHandiError, OSError)):
        fill_run(world.settings.run_dir / run_id, "cpu", lambda: None)
    (world.settings.run_dir / run_id / "queued.json").unlink()
    shown = client.get(f"/api/v1/runs/{run_id}").json()
    assert shown["state"] == "failed"
    assert all(word in shown["failure"]["message"] for word in words), shown["failure"]
    assert "sequence" in shown["failure"]["advice"]
    page = world.browser().get(f"/runs/{run_id}")
    assert page.status_code == 200
    assert shown["failure"]["advice"] in page.text
    assert "Traceback" not in page.text
    assert not Run.open(world.settings.run_dir / run_id).is_published


def test_a_full_disk_is_told(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    response = world.script().post("/api/v1/runs", json=RUN)
    assert response.status_code == 507
    assert "Free some space" in response.json()["error"]["message"]
    assert list(world.settings.run_dir.iterdir()) == []
