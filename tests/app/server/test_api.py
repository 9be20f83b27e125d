"""The REST interface, as a script and a page use it."""

import csv
import io
import zipfile
from typing import Any

import numpy as np
import pytest
import yaml
from pygltflib import GLTF2
from starlette.testclient import TestClient
from support.inputs.sheet_sequence import FITTED, FRAMES, NODE
from support.server.server_world import World

from app.exports.request import FileRequest
from physhandi.fitting.config import STAGES
from physhandi.run import Run


@pytest.fixture
def client(still_world: World) -> TestClient:
    return still_world.script()


def bundled_run(client: TestClient) -> str:
    return next(run["id"] for run in client.get("/api/v1/runs").json()["runs"] if run["is_bundled"])


def error_of(response: Any) -> dict[str, Any]:
    assert list(response.json()) == ["error"]
    return response.json()["error"]


def test_sequences_are_listed_with_what_they_have(client: TestClient) -> None:
    answer = client.get("/api/v1/sequences").json()
    assert list(answer) == ["sequences"]
    listed = {sequence["id"]: sequence for sequence in answer["sequences"]}
    sheet = listed["sheet"]
    assert (sheet["frame_count"], sheet["frame_rate"], sheet["is_bundled"]) == (FRAMES, 30.0, False)
    assert sheet["parts"] == ["control", "marker", "object_node"]
    assert sheet["duration_s"] == pytest.approx(FRAMES / 30)
    assert listed["towel_fold"]["is_bundled"]
    assert client.get("/api/v1/sequences/sheet").json() == sheet


def test_runs_are_listed_with_how_far_they_are(client: TestClient) -> None:
    answer = client.get("/api/v1/runs").json()
    assert list(answer) == ["runs", "total"]
    run = answer["runs"][0]
    assert (run["id"], run["name"], run["state"]) == ("fitted", "a sheet", "succeeded")
    assert (run["sequences"], run["profile"], run["kind"]) == (["sheet"], "quick", "reconstruction")
    assert run["is_published"]
    assert run["error"] is None
    assert answer["runs"][-1]["is_bundled"]
    shown = client.get("/api/v1/runs/fitted").json()
    assert shown["results"]["losses"]["first_order"]["after"] > 0
    assert set(shown["results"]["metrics"]) == {"sheet"}
    assert shown["results"]["parameters"]["gravity"] == 9.81
    assert {field: shown[field] for field in run} == run
    # The sheet was recorded without hands, so the stages of hands had nothing to do.
    expected = {"hand_reconstruction": "passed", "hand_refinement": "passed"}
    assert {stage["name"]: stage["state"] for stage in shown["stages"]} == {
        stage: expected.get(stage, "done") for stage in STAGES
    }


def test_losses_are_curves_of_iteration_and_loss(client: TestClient) -> None:
    losses = client.get("/api/v1/runs/fitted/losses").json()["losses"]
    curve = losses["zeroth_order"]["curve"]
    assert len(curve) > 1
    assert [point[0] for point in curve] == sorted(point[0] for point in curve)
    assert losses["zeroth_order"]["before"] > losses["zeroth_order"]["after"] > 0


def test_errors_of_every_frame_come_with_where_the_future_begins(client: TestClient) -> None:
    sequences = client.get("/api/v1/runs/fitted/frame_errors").json()["sequences"]
    assert list(sequences) == ["sheet"]
    errors = sequences["sheet"]
    assert errors["frames"] == list(range(FRAMES))
    assert errors["future_start"] == FITTED
    assert len(errors["rollout"]["track_error"]) == FRAMES
    scores = client.get("/api/v1/runs/fitted").json()["results"]["metrics"]["sheet"]
    future = errors["static"]["track_error"][FITTED:]
    assert np.mean(future) == pytest.approx(scores["future"]["static"]["track_error"], rel=1e-3)
    assert np.mean(future) > 1e-3


def test_an_older_run_has_no_errors_of_frames(world: World) -> None:
    for path in (world.settings.run_dir / "fitted").rglob("frame_errors.json"):
        path.unlink()
    assert world.script().get("/api/v1/runs/fitted/frame_errors").json() == {"sequences": {}}


def test_a_log_is_downloaded_whole_and_never_through_a_link(world: World) -> None:
    client = world.script()
    missing = client.get("/api/v1/runs/fitted/log")
    assert missing.status_code == 404
    assert "no log" in error_of(missing)["message"]
    log = world.settings.run_dir / "fitted" / "log.txt"
    log.write_text("line\n" * 30_000)
    answer = client.get("/api/v1/runs/fitted/log")
    assert answer.text == "line\n" * 30_000
    assert answer.headers["content-type"] == "text/plain; charset=utf-8"
    assert 'filename="fitted_log.txt"' in answer.headers["content-disposition"]
    log.rename(log.with_name("secret"))
    log.symlink_to(log.with_name("secret"))
    assert client.get("/api/v1/runs/fitted/log").status_code == 404


def test_what_a_fit_was_computed_with_is_told(client: TestClient) -> None:
    told = client.get("/api/v1/runs/fitted").json()["results"]["environment"]
    assert told["device"] == "cpu"
    assert told["packages"]["numpy"] == np.__version__


def test_profiles_are_listed(client: TestClient) -> None:
    profiles = client.get("/api/v1/profiles").json()["profiles"]
    assert {profile["name"] for profile in profiles} == {"quick", "default", "paper", "phystwin"}
    assert all(profile["description"] for profile in profiles)


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("GET", "/sequences/nothing"),
        ("GET", "/runs/nothing"),
        ("GET", "/runs/nothing/losses"),
        ("GET", "/runs/nothing/events"),
        ("GET", "/runs/nothing/export?format=npz"),
        ("POST", "/runs/nothing/cancel"),
        ("POST", "/runs/nothing/resume"),
        ("DELETE", "/runs/nothing"),
    ],
)
def test_what_is_not_there_is_not_found(still_world: World, method: str, path: str) -> None:
    response = still_world.script().request(method, f"/api/v1{path}")
    assert response.status_code == 404
    assert error_of(response)["code"] == "not_found"
    assert "'nothing'" in error_of(response)["message"]


@pytest.mark.parametrize(
    "run_id", ["..%2f..%2fetc", "%2e%2e", "a.b", "C:x", "a" * 65, "%00", "%5c%5chost%5cs", "a%0ab"]
)
def test_an_id_is_never_a_path(still_world: World, run_id: str) -> None:
    client = still_world.script()
    for method, rest in (("GET", ""), ("DELETE", ""), ("POST", "/cancel"), ("GET", "/events")):
        response = client.request(method, f"/api/v1/runs/{run_id}{rest}")
        assert response.status_code in {404, 405, 422}
        assert error_of(response)["message"]


def test_too_many_waiting_fits_are_refused(world: World) -> None:
    client = world.script()
    world.settings.__dict__["waiting_fits"] = 1
    assert client.post("/api/v1/runs", json={"sequences": ["sheet"]}).status_code == 201
    full = client.post("/api/v1/runs", json={"sequences": ["sheet"]})
    assert (full.status_code, error_of(full)["code"]) == (429, "queue_full")


def test_the_bundled_run_stays_as_it_is(client: TestClient) -> None:
    run_id = bundled_run(client)
    for method, rest in (("DELETE", ""), ("POST", "/cancel"), ("POST", "/resume")):
        response = client.request(method, f"/api/v1/runs/{run_id}{rest}")
        assert response.status_code == 409
        assert "came with the program" in error_of(response)["message"]
    assert client.get(f"/api/v1/runs/{run_id}").json()["state"] == "succeeded"


def test_exports_read_back_as_what_the_run_holds(world: World, made: list[FileRequest]) -> None:
    client = world.script()
    rollout = Run.open(world.settings.run_dir / "fitted").array("sequences/sheet/rollout.npy")

    def export(kind: str) -> bytes:
        response = client.get(f"/api/v1/runs/fitted/export?format={kind}")
        assert response.status_code == 200
        name = {"ply": "fitted_ply.zip", "gltf": "fitted.glb"}.get(kind, f"fitted.{kind}")
        assert f'filename="{name}"' in response.headers["content-disposition"]
        return response.content

    with np.load(io.BytesIO(export("npz")), allow_pickle=False) as arrays:
        assert any(
            array.shape == rollout.shape and np.array_equal(array, rollout)
            for array in arrays.values()
        )
    with zipfile.ZipFile(io.BytesIO(export("ply"))) as archive:
        assert len(archive.namelist()) >= FRAMES
        assert archive.read(archive.namelist()[0]).startswith(b"ply\n")
    rows = list(csv.reader(io.StringIO(export("csv").decode())))
    assert len(rows) > FRAMES * len(NODE)
    assert "parameters" in yaml.safe_load(export("yaml"))
    scene = GLTF2.load_from_bytes(export("gltf"))
    assert scene.animations[0].channels
    assert [order.format for order in made] == ["ply", "gltf"]  # What is small is read at once.


@pytest.mark.parametrize(
    "query",
    ["", "format=pkl", "format=../ply", "format=npz&sequence=nowhere", "format=npz&sequence=../x"],
)
def test_what_cannot_be_exported_is_told(still_world: World, query: str) -> None:
    response = still_world.script().get(f"/api/v1/runs/fitted/export?{query}")
    assert response.status_code == 422
    assert error_of(response)["message"]


def test_an_unfinished_run_has_nothing_to_export(world: World) -> None:
    client = world.script()
    run_id = client.post("/api/v1/runs", json={"sequences": ["sheet"]}).json()["id"]
    response = client.get(f"/api/v1/runs/{run_id}/export?format=npz")
    assert response.status_code == 409
    assert "nothing to export" in error_of(response)["message"]


def test_live_scenes_are_opened_and_closed(world: World) -> None:
    client = world.script()
    try:
        opened = client.post("/api/v1/sessions", json={"kind": "run", "id": "fitted"})
        assert opened.status_code == 201
        session = opened.json()
        assert session["url"] == f"/live/{session['id']}"
        assert f"viewer/{session['id']}/" in client.get(session["url"]).text
        assert client.get(f"/viewer/{session['id']}/").status_code == 200
        for _ in range(2):
            assert client.delete(f"/api/v1/sessions/{session['id']}").status_code == 204
        assert client.get(session["url"]).status_code == 404
        wrong = client.post("/api/v1/sessions", json={"kind": "run", "id": "nothing"})
        assert wrong.status_code == 404
        body = {"kind": "file", "id": "fitted"}
        assert client.post("/api/v1/sessions", json=body).status_code == 422
    finally:
        world.sessions.shutdown()


def test_a_live_scene_belongs_to_the_browser_that_opened_it(world: World) -> None:
    mine, theirs = world.browser(), world.browser()
    try:
        opened = mine.post("/api/v1/sessions", json={"kind": "run", "id": "fitted"})
        page = opened.json()["url"]
        name = page.removeprefix("/live/")
        addresses = (page, f"/viewer/{name}/", f"/api/v1/sessions/{name}")
        assert [mine.get(address).status_code for address in addresses] == [200, 200, 200]
        assert [theirs.get(address).status_code for address in addresses] == [404, 404, 404]
        assert "belongs to another browser" in theirs.get(page).text
        wish = {"dark": True}
        assert theirs.patch(f"/api/v1/sessions/{name}", json=wish).status_code == 404
        assert not world.sessions.get(name).state.prefers_dark
        assert mine.patch(f"/api/v1/sessions/{name}", json=wish).status_code == 204
        assert world.sessions.get(name).state.prefers_dark
        assert theirs.delete(f"/api/v1/sessions/{name}").status_code == 404
        assert theirs.delete("/api/v1/sessions/never-there").status_code == 404
        assert mine.get(page).status_code == 200

        world.sessions.close(name, "Nobody looked at it for 15 minutes.")
        closed = mine.get(page)
        assert closed.status_code == 404
        assert "Nobody looked at it for 15 minutes." in closed.text
        assert 'data-open="run" data-id="fitted"' in closed.text
        assert "15 minutes" not in theirs.get(page).text
    finally:
        world.sessions.shutdown()


def test_too_many_live_scenes_are_refused(world: World) -> None:
    world.settings.__dict__.update(live_sessions=2, live_sessions_each=1)
    clients = [world.script(), world.browser(), world.browser()]
    try:
        body = {"kind": "run", "id": "fitted"}
        assert clients[0].post("/api/v1/sessions", json=body).status_code == 201
        full = clients[0].post("/api/v1/sessions", json=body)
        assert (full.status_code, error_of(full)["code"]) == (429, "too_many_sessions")
        assert "You have 1 live sessions" in error_of(full)["message"]
        # Who has none is not locked out by one who has all that one may have.
        assert clients[1].post("/api/v1/sessions", json=body).status_code == 201
        full = clients[2].post("/api/v1/sessions", json=body, headers={"Accept": "*/*"})
        assert "2 live sessions are open" in error_of(full)["message"]
    finally:
        world.sessions.shutdown()


def test_a_run_that_is_deleted_before_the_queue_looks_again_is_left_out(world: World) -> None:
    gone, kept = (world.scheduler.launch(["sheet"], "quick", name) for name in ("gone", "kept"))
    with world.scheduler._lock:
        world.scheduler._look_around()
    client = world.script()

    def waiting() -> list[str]:
        return [run["id"] for run in client.get("/api/v1/system").json()["waiting"]]

    assert waiting() == [gone.id, kept.id]
    gone.delete()
    assert waiting() == [kept.id]
    assert world.browser().get("/system").status_code == 200
