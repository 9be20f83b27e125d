"""Recordings imported in the browser: which folders it sees, what they hold, and the import."""

import json
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError
from support.inputs.raw_capture import FRAMES, RawCapture
from support.server.server_world import World, make_world
from support.waiting import until

from app.jobs.catalog import Catalog
from app.jobs.recordings.background import BackgroundTasks
from app.jobs.recordings.captures import CaptureFolders, UnknownCaptureError
from app.jobs.recordings.imports import ImportOrder, Imports
from app.settings import ServerSettings
from physhandi.errors import RunError, UsageError

ORDER = ImportOrder(
    source="captures/fold",
    name="new",
    depth_scale=None,
    intrinsics="",
    charuco="",
    april_grid="",
    by_table=True,
    start=1,
    stop=None,
    every=2,
    frame_rate=None,
    hands=["left"],
    overwrite=False,
)


@pytest.fixture
def settings(data_dir: Path) -> ServerSettings:
    (data_dir / "captures/fold").mkdir(parents=True)
    return ServerSettings(data_dir=data_dir)


def test_folders_are_listed_and_nothing_beside_them_is_found(
    settings: ServerSettings, tmp_path: Path
) -> None:
    other = tmp_path / "elsewhere/captures"
    (other / "table 2/left").mkdir(parents=True)
    (other / "table 10.bag").touch()
    (other / "notes.txt").touch()
    (other / ".hidden").mkdir()
    (other / "out").symlink_to(settings.data_dir)
    (other / "in").symlink_to(other / "table 2")
    folders = CaptureFolders(settings.model_copy(update={"captures": (other,)}))
    assert [one.place for one in folders.list()] == ["captures", "captures_2"]
    assert [one.place for one in folders.list("captures")] == ["captures/fold"]
    listed = {one.name: one.is_bag for one in folders.list("captures_2")}
    assert listed == {"in": False, "table 2": False, "table 10.bag": True}
    assert folders.find("captures_2/in") == other / "table 2"
    assert folders.list("captures_2/table 10.bag") == []
    refused = [
        *("", "other", "/etc", "captures/..", "captures/../sequences", "captures/fold/../fold"),
        *("captures_2/out", "captures_2/out/sequences", "captures_2/.hidden", "captures//fold"),
        *("captures/fold\0", "captures\\fold", "captures/" + 300 * "x", "captures/nowhere"),
    ]
    for place in refused:
        with pytest.raises(UnknownCaptureError, match="folders that this server imports from"):
            folders.find(place)


def test_the_operator_names_folders_that_are_there(data_dir: Path) -> None:
    named = ServerSettings(data_dir=data_dir, captures=(data_dir / "sequences", data_dir))
    assert named.captures == (data_dir / "sequences", data_dir)
    with pytest.raises(ValidationError, match="is not a folder"):
        ServerSettings(data_dir=data_dir, captures=(data_dir / "nowhere",))


@pytest.fixture
def imports(settings: ServerSettings, monkeypatch: pytest.MonkeyPatch) -> Iterator[Imports]:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    tasks = BackgroundTasks()
    yield Imports(settings, Catalog(settings), tasks, worker="support.server.import_worker")
    tasks.shutdown()


def test_the_order_reaches_the_process(imports: Imports, settings: ServerSettings) -> None:
    gate = settings.capture_dir / "fold" / "gate"
    os.mkfifo(gate)  # The import waits there, or it might have ended before the next wish.
    task = imports.start(ORDER)
    with pytest.raises(RunError, match="'new' is being imported"):
        imports.make_example()
    gate.write_bytes(b"")
    until(lambda: task.state != "running")
    assert (task.state, task.reason, task.result) == ("done", "", {"written": "new"})
    assert imports.job("new") is task
    told = json.loads((settings.sequence_dir / "new/order.json").read_text())
    assert told["source"] == str(settings.capture_dir / "fold")
    options = told["options"]
    assert (options["start"], options["every"], options["hands"]) == (1, 2, ["left"])
    assert options["intrinsics"] is None
    assert options["by_table"] is True
    example = imports.make_example()
    until(lambda: example.state != "running")
    assert imports.example().result == {"written": "example"}
    assert (settings.capture_dir / "example/order.json").is_file()


def test_what_must_not_be_replaced_is_kept(imports: Imports, settings: ServerSettings) -> None:
    with pytest.raises(UsageError, match="already"):
        imports.start(replace(ORDER, name="sheet"))
    with pytest.raises(UsageError, match="came with the program"):
        imports.start(replace(ORDER, name="towel_fold", overwrite=True))
    with pytest.raises(UnknownCaptureError):
        imports.start(replace(ORDER, source="captures/nowhere"))
    with pytest.raises(UnknownCaptureError):
        imports.start(replace(ORDER, intrinsics="captures/../sequences"))
    world = make_world(settings.data_dir)
    world.scheduler.launch(["sheet"], "quick")
    with pytest.raises(RunError, match="waits to be fitted"):
        imports.start(replace(ORDER, name="sheet", overwrite=True))


def test_a_failure_is_told_as_the_importer_wrote_it(
    imports: Imports, settings: ServerSettings
) -> None:
    (settings.capture_dir / "broken").mkdir()
    task = imports.start(replace(ORDER, source="captures/broken"))
    until(lambda: task.state != "running")
    assert (task.state, task.reason) == ("failed", "left/color/00003.png: was cut off.")
    assert task.progress == {"stage": "import", "iteration": 1, "total": 4, "message": "left"}


@pytest.fixture
def world(data_dir: Path) -> World:
    RawCapture(data_dir / "captures/ball").write(times=True)
    return make_world(data_dir)


def test_a_recording_is_chosen_described_and_imported(world: World) -> None:
    browser, client = world.browser(), world.script()
    assert 'href="import"' in browser.get("/").text
    assert 'href="import"' in browser.get("/sequences").text
    top = browser.get("/import").text
    assert 'href="import?folder=captures"' in top
    assert 'id="survey"' not in top
    inside = browser.get("/import?folder=captures").text
    assert 'href="import?folder=captures/ball"' in inside
    assert (
        'hx-get="import/survey?source=captures/ball"'
        in browser.get("/import?folder=captures/ball").text
    )
    survey = browser.get("/import/survey?source=captures/ball").text
    assert f"2 cameras, <strong>{FRAMES} frames</strong> at 30 Hz" in survey
    assert "placed by the poses that the recording states" in survey
    assert f"{FRAMES} images, 96 x 72 px, with times" in survey
    assert 'name="name" required' in survey
    assert 'value="ball"' in survey
    order: dict[str, Any] = {"source": "captures/ball", "name": "ball", "stop": 3}
    answer = client.post("/api/v1/imports", json=order)
    assert answer.status_code == 202, answer.text
    job = until(
        lambda: (j := client.get("/api/v1/imports/ball").json())["state"] != "running" and j
    )
    assert (job["state"], job["reason"]) == ("done", "")
    assert job["progress"]["total"] == 6
    assert world.catalog.sequence("ball").frame_count == 3
    check = browser.get("/sequences/ball/check").text
    assert "Nothing tells the unit of depth, so it is taken for millimetres." in check
    assert client.post("/api/v1/imports", json=order).status_code == 422
    assert 'value="ball_2"' in browser.get("/import/survey?source=captures/ball").text


def test_strangers_and_strange_orders_are_refused(world: World) -> None:
    client = world.script()
    order: dict[str, Any] = {"source": "captures/ball", "name": "ball"}
    assert world.client().post("/api/v1/imports", json=order).status_code == 401
    foreign = world.browser()
    foreign.headers["Origin"] = "http://evil.example"
    assert foreign.post("/api/v1/imports", json=order).status_code == 403
    for wrong in ({"name": "../ball"}, {"every": 0}, {"hands": []}, {"stop": 0}, {"more": 1}):
        assert client.post("/api/v1/imports", json=order | wrong).status_code == 422
    for place in ("captures/../runs", "/etc", "captures/nowhere"):
        answer = client.post("/api/v1/imports", json=order | {"source": place})
        assert answer.status_code == 404
        assert client.get(f"/api/v1/captures?folder={place}").status_code == 404
        assert client.get(f"/api/v1/captures/survey?source={place}").status_code == 404
    assert client.get("/api/v1/captures").json()["entries"][0]["place"] == "captures"
    listed = client.get("/api/v1/openapi.json").json()["paths"]
    assert {"/api/v1/captures", "/api/v1/captures/example", "/api/v1/imports"} <= set(listed)
    assert client.get("/api/v1/captures/example").json()["state"] == "none"
    for address in ("/api/v1/captures/example", "/api/v1/imports/ball"):
        assert client.delete(address).status_code == 204
