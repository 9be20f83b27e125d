"""Masks and tracks from clicks in the browser: started, followed, cancelled, and really found."""

import json
import os
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient
from support.inputs.clicked_disc import disc_click, write_disc
from support.inputs.made_models import write_cotracker
from support.server.server_world import ORIGIN, TOKEN, World, make_world
from support.waiting import until

from app.jobs.catalog import Catalog
from app.jobs.recordings.annotations import Annotations, ChosenModels, ClickedPlace
from app.jobs.recordings.background import BackgroundTasks
from app.jobs.recordings.models import ModelFolders
from app.server import create_app
from app.settings import ServerSettings
from physhandi.data.lease import Lease
from physhandi.data.sequence import Sequence
from physhandi.errors import RunError, SequenceError, UsageError

ADDRESS = "/api/v1/sequences/disc/annotation"


@pytest.fixture
def annotations(
    data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Annotations]:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    catalog = Catalog(ServerSettings(data_dir=data_dir), bundled=tmp_path / "none")
    tasks = BackgroundTasks()
    models = ModelFolders(ServerSettings(data_dir=data_dir))
    yield Annotations(catalog, tasks, models, worker="support.server.annotation_worker")
    tasks.shutdown()


def click(view: str = "front") -> list[ClickedPlace]:
    return [ClickedPlace(view, 3, 10.5, 20.0)]


def test_the_order_reaches_the_process_and_its_end_is_told(
    annotations: Annotations, data_dir: Path
) -> None:
    assert annotations.job("sheet").state == "none"
    masker = data_dir / "models/masker"
    masker.mkdir(parents=True)
    (masker / "config.json").write_text('{"model_type": "sam2_video"}')
    (masker / "model.safetensors").touch()
    chosen = ChosenModels(masks="masker", trusts_code=True)
    job = annotations.start("sheet", click(), overwrite=True, chosen=chosen)
    until(lambda: job.state != "running")
    assert (job.state, job.reason) == ("done", "")
    models = json.loads((data_dir / "sequences/sheet/models.json").read_text())
    assert models == {"mask_model": str(masker), "track_model": None, "trusts_model_code": True}
    assert job.progress["stage"] == "segmentation"
    assert annotations.job("sheet") is job
    told = (data_dir / "sequences/sheet/found.txt").read_text()
    assert told == (
        "[{'view': 'front', 'frame': 3, 'x': 10.5, 'y': 20.0, 'width': 0.0, 'height': 0.0}]"
    )


def test_a_refusal_and_a_death_are_told(annotations: Annotations) -> None:
    refused = annotations.start("sheet", click(), overwrite=False)
    until(lambda: refused.state != "running")
    assert (refused.state, refused.reason) == ("failed", "It has masks that were not made here.")
    dead = annotations.start("sheet", click("dies"), overwrite=False)
    until(lambda: dead.state != "running")
    assert dead.state == "failed"
    assert "3" in dead.reason


def test_one_recording_at_a_time_and_it_can_be_cancelled(annotations: Annotations) -> None:
    job = annotations.start("sheet", click("waits"), overwrite=True)
    with pytest.raises(RunError, match="Masks and tracks of 'sheet' are being found"):
        annotations.start("sheet", click(), overwrite=True)
    annotations.tasks.require_settled(["other"])
    with pytest.raises(RunError, match="A fit would read it half old and half new"):
        annotations.tasks.require_settled(["other", "sheet"])
    annotations.cancel("sheet")
    until(lambda: job.state != "running")
    assert job.state == "cancelled"
    annotations.cancel("sheet")  # Nothing is at work any more.
    again = annotations.start("sheet", click(), overwrite=True)
    until(lambda: again.state == "done")


def test_the_work_outlives_the_request_that_asked_for_it(annotations: Annotations) -> None:
    def ask() -> None:
        job = annotations.start("sheet", click("waits"), overwrite=True)
        until(lambda: job.progress)

    request = threading.Thread(target=ask)
    request.start()
    request.join()
    job = annotations.job("sheet")
    annotations.cancel("sheet")
    until(lambda: job.state != "running")
    assert (job.state, job.reason) == ("cancelled", "")


def test_what_is_not_there_is_not_begun(annotations: Annotations) -> None:
    with pytest.raises(SequenceError, match="no sequence 'nowhere'"):
        annotations.start("nowhere", click(), overwrite=True)
    with pytest.raises(SequenceError, match="no sequence 'nowhere'"):
        annotations.job("nowhere")


@pytest.fixture
def world(data_dir: Path) -> World:
    write_disc(data_dir / "sequences/disc", frames=3)
    return make_world(data_dir)


def post(client: TestClient, address: str = ADDRESS, **fields: Any) -> Any:
    return client.post(address, json=fields)


def test_a_recording_is_not_changed_while_a_fit_reads_it(world: World) -> None:
    client = world.script()
    run = client.post("/api/v1/runs", json={"sequences": ["sheet"]}).json()
    address = "/api/v1/sequences/sheet/annotation"
    refused = post(client, address, overwrite=True)
    assert refused.status_code == 409
    message = refused.json()["error"]["message"]
    assert f"waits to be fitted by run '{run['name']}' ({run['id']})" in message
    lease = Lease.acquire(world.settings.run_dir / run["id"])
    message = post(client, address).json()["error"]["message"]
    assert "'sheet' is being fitted by run" in message
    lease.release()
    client.post(f"/api/v1/runs/{run['id']}/cancel").raise_for_status()
    assert post(client, address).status_code == 202


def test_no_fit_begins_while_masks_are_found(annotations: Annotations, world: World) -> None:
    app = create_app(
        world.settings, security=world.security, catalog=world.catalog, tasks=annotations.tasks
    )
    client = TestClient(app, ORIGIN, headers={"Authorization": f"Bearer {TOKEN}"})
    annotations.start("sheet", click("waits"), overwrite=True)
    for address, body in (("", {"sequences": ["sheet"]}), (f"/{stopped(world)}/resume", None)):
        answer = client.post(f"/api/v1/runs{address}", json=body)
        assert answer.status_code == 409
        assert "Masks and tracks of 'sheet' are being found" in answer.json()["error"]["message"]


def stopped(world: World) -> str:
    """A run that was cancelled in line."""
    run = world.scheduler.launch(["sheet"], "quick")
    world.scheduler.cancel(run.id)
    return run.id


def test_a_painted_mask_replaces_that_of_its_frame(world: World) -> None:
    client = world.script()
    folder = world.settings.sequence_dir / "disc"
    shutil.rmtree(folder)
    _, true = write_disc(folder, masks=True, frames=3)
    address = "/api/v1/sequences/disc/views/top/frames/1/mask"
    runs = client.get(address).json()["runs"]
    label = np.repeat(runs[::2], runs[1::2])
    assert np.array_equal(label, true["top"][1].reshape(-1))
    assert client.get(address.replace("frames/1", "frames/3")).status_code == 404
    assert client.get(address.replace("top", "left")).status_code == 404
    page = world.browser().get("/sequences/disc/check").text
    assert 'id="brush"' in page
    assert "data-masked" in page
    mask: dict[str, Any] = {"view": "top", "frame": 1, "runs": [0, 100, 1, label.size - 100]}
    place = "/api/v1/sequences/disc/correction"
    refused = [
        {"runs": [0, label.size - 1]},
        {"runs": [0, label.size, 1]},
        {"runs": [4, label.size]},
        {"runs": [0, -1, 0, label.size + 1]},
        {"frame": 3},
        {"view": "left"},
    ]
    for wrong in refused:
        assert post(client, place, masks=[mask | wrong]).status_code == 422
    assert post(client, place, masks=[]).status_code == 422
    bundled = place.replace("disc", "towel_fold")
    assert "came with the program" in post(client, bundled, masks=[mask]).json()["error"]["message"]
    assert post(client, place, masks=[mask]).status_code == 202
    job = until(lambda: (j := client.get(ADDRESS).json())["state"] != "running" and j)
    assert (job["state"], job["reason"]) == ("done", "")
    found = Sequence.load(folder)
    painted = next(view for view in found.views if view.name == "top").mask(1).reshape(-1)
    assert not painted[:100].any()
    assert (painted[100:] == 1).all()
    kept = next(view for view in found.views if view.name == "top").mask(0)
    assert np.array_equal(kept, true["top"][0])


def test_orders_that_make_no_sense_are_refused(world: World) -> None:
    client = world.script()
    assert post(client, clicks=[{"view": "../top", "frame": 0, "x": 1, "y": 1}]).status_code == 422
    assert post(client, clicks=[{"view": "top", "frame": -1, "x": 1, "y": 1}]).status_code == 422
    bundled = post(client, "/api/v1/sequences/towel_fold/annotation")
    assert bundled.status_code == 422
    assert "came with the program" in bundled.json()["error"]["message"]
    assert post(client, "/api/v1/sequences/nowhere/annotation").status_code == 404
    assert 'id="annotation"' not in world.browser().get("/sequences/towel_fold/check").text
    own = Annotations(world.catalog, BackgroundTasks(), ModelFolders(world.settings))
    with pytest.raises(UsageError, match="came with the program"):
        own.start("towel_fold", [], overwrite=True)


def test_a_click_finds_masks_and_tracks_by_a_network_whose_code_only_runs_if_trusted(
    world: World,
) -> None:
    client, folder = world.script(), world.settings.model_dir
    assert client.get(ADDRESS).json()["state"] == "none"
    assert client.get("/api/v1/models").json() == {"models": []}
    assert "put the folder of each" in world.browser().get("/sequences/disc/check").text
    folder.mkdir()
    write_cotracker(folder / "follower")
    (folder / "notes").mkdir()
    (folder / "masker").mkdir()
    (folder / "masker/config.json").write_text('{"model_type": "sam2_video"}')
    tracker = {"name": "follower", "finds": "tracks", "kind": "cotracker3"}
    assert client.get("/api/v1/models").json() == {"models": [tracker]}  # Nothing without weights.
    (folder / "masker/model.safetensors").touch()
    masker = {"name": "masker", "finds": "masks", "kind": "sam2"}
    assert client.get("/api/v1/models").json() == {"models": [tracker, masker]}
    page = world.browser().get("/sequences/disc/check").text
    assert ('id="annotation"' in page, "Replace those that are there" in page) == (True, False)
    assert '<option value="follower">follower (cotracker3)</option>' in page
    assert '<option value="masker">masker (sam2)</option>' in page

    view, frame, x, y = disc_click()
    clicks = [{"view": view, "frame": frame, "x": x, "y": y}]
    for wrong in ("masker", "nothing", "../models/follower", str(folder / "follower")):
        refused = post(client, clicks=clicks, track_model=wrong, trusts_model_code=True)
        assert refused.status_code == 422, wrong
        assert "holds no network" in refused.json()["error"]["message"]
    refused = post(client, clicks=clicks, track_model="follower")
    assert refused.status_code == 422
    assert "'follower' is Python code of others" in refused.json()["error"]["message"]
    assert not (folder / "follower/ran.txt").exists()
    answer = post(client, clicks=clicks, track_model="follower", trusts_model_code=True)
    assert answer.status_code == 202, answer.text
    job = until(lambda: (j := client.get(ADDRESS).json())["state"] != "running" and j)
    assert (job["state"], job["reason"]) == ("done", "")
    assert job["progress"]["stage"] == "point_tracking"
    assert int((folder / "follower/ran.txt").read_text()) != os.getpid()
    found = Sequence.load(world.settings.sequence_dir / "disc")
    assert found.missing("mask", "track") == []
    sources = {part: found.provenance[part]["source"] for part in ("masks", "tracks")}
    assert sources == {"masks": "built-in", "tracks": "cotracker3"}
    assert found.provenance["masks"]["clicks"] == clicks
    assert "Replace those that are there" in world.browser().get("/sequences/disc/check").text
    assert client.delete(ADDRESS).status_code == 204
