"""The routes of the API and the pages, with a real queue and made-up live scenes."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.server.queue_world import HOSTILE, QueueWorld, queue_world
from support.server.server_world import World
from support.waiting import until

from app import api
from app.jobs.catalog import RunItem
from app.jobs.scheduler import Scheduler


@pytest.fixture
def world(data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[QueueWorld]:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    (tmp_path / "bundled").mkdir()
    with queue_world(data_dir, tmp_path / "bundled") as world:
        yield world


def test_the_lists_are_wrapped_and_tell_what_people_ask_first(world: QueueWorld) -> None:
    sequences = world.client.get("/api/v1/sequences").json()["sequences"]
    assert [entry["id"] for entry in sequences] == ["sheet"]
    assert sequences[0]["frame_count"] == 10
    assert world.client.get("/api/v1/sequences/sheet").json() == sequences[0]
    assert world.client.get("/api/v1/runs").json() == {"runs": [], "total": 0}
    profiles = world.client.get("/api/v1/profiles").json()["profiles"]
    assert {"quick", "default", "paper", "phystwin"} == {entry["name"] for entry in profiles}
    assert all(entry["description"] for entry in profiles)


def test_a_fit_is_launched_followed_shown_and_deleted(world: QueueWorld) -> None:
    run_id = world.launch("publish")
    run = world.until(run_id, "succeeded")
    assert run["sequences"] == ["sheet"]
    assert run["profile"] == "quick"
    assert run["results"]["losses"]["first"]["after"] == 1.0
    losses = world.client.get(f"/api/v1/runs/{run_id}/losses").json()["losses"]
    assert losses["first"] == {"before": 2.0, "after": 1.0, "curve": [[1, 2.0]]}
    assert losses["second"]["curve"] == [[1, 0.5]]
    assert "loss 2 → 1" in world.client.get(f"/runs/{run_id}").text
    assert world.client.delete(f"/api/v1/runs/{run_id}").status_code == 204
    assert world.client.get(f"/api/v1/runs/{run_id}").status_code == 404
    assert "No runs yet" in world.client.get("/").text


def test_a_run_that_is_called_finished_has_its_results(
    world: QueueWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_id = world.launch("script")
    world.tell(run_id, ["report", "first", 1, 1, 2.0])
    world.until_reported(run_id, "first")
    follow = api.follow_run

    def follow_late(item: RunItem, scheduler: Scheduler) -> dict[str, Any]:
        """Look at a run's state when it has just ended."""
        world.tell(run_id, ["finish", "first", {"before": 2.0, "after": 1.0}], ["publish"])
        until(lambda: follow(item, scheduler)["state"] == "succeeded")
        return follow(item, scheduler)

    monkeypatch.setattr(api, "follow_run", follow_late)
    run = world.client.get(f"/api/v1/runs/{run_id}").json()
    assert run["state"] == "succeeded"
    assert run["results"]["losses"]["first"]["after"] == 1.0


def test_a_fit_is_cancelled_and_resumed(world: QueueWorld) -> None:
    run_id = world.launch("wait")
    world.until(run_id, "running")
    assert world.client.delete(f"/api/v1/runs/{run_id}").status_code == 409
    assert world.client.get(f"/api/v1/runs/{run_id}/export?format=npz").status_code == 409
    world.client.post(f"/api/v1/runs/{run_id}/cancel")
    world.until(run_id, "cancelled")
    conflict = world.client.post(f"/api/v1/runs/{run_id}/cancel")
    assert conflict.status_code == 409
    assert "nothing to cancel" in conflict.json()["error"]["message"]
    (world.folder(run_id) / "go").touch()
    world.client.post(f"/api/v1/runs/{run_id}/resume")
    world.until(run_id, "succeeded")


@pytest.mark.parametrize(
    ("body", "where"),
    [
        ({}, "sequences"),
        ({"sequences": []}, "sequences"),
        ({"sequences": ["../etc"]}, "sequences"),
        ({"sequences": ["sheet"], "argv": ["--host"]}, "argv"),
        ({"sequences": ["sheet"], "name": "x" * 10_000}, "name"),
        ({"sequences": ["sheet"], "profile": "../../etc/passwd"}, "profile"),
        ({"sequences": ["sheet"] * 65}, "sequences"),
        ({"sequences": ["sheet"], "profile": "fastest"}, "fastest"),
        ([], "body"),
    ],
)
def test_a_wrong_order_is_refused_by_field_and_makes_no_run(
    still_world: World, body: Any, where: str
) -> None:
    response = still_world.script().post("/api/v1/runs", json=body)
    assert response.status_code == 422
    assert where in response.json()["error"]["message"]
    assert [run.name for run in still_world.settings.run_dir.iterdir()] == ["fitted"]


def test_unknown_ids_are_not_found(still_world: World) -> None:
    client = still_world.script()
    for path in ("runs/x", "sequences/x", "runs/x/losses", "runs/x/export?format=csv"):
        response = client.get(f"/api/v1/{path}")
        assert response.status_code == 404
        assert response.json()["error"]["code"] == "not_found"
    assert client.post("/api/v1/runs/x/cancel").status_code == 404
    body = {"sequences": ["nowhere"], "profile": "quick"}
    assert client.post("/api/v1/runs", json=body).status_code == 404
    assert client.get("/sequences/sheet/thumbnail").status_code == 404


def test_a_page_shows_results_with_units_and_its_parts_alone(world: QueueWorld) -> None:
    run_id = world.launch("script")
    scores = {"rollout": {"track_error": 0.0125}, "static": {"track_error": 0.5}}
    doubts = [{"code": "loose_nodes", "message": "3 of <12> nodes"}]
    measured = {"unit": "m", "future": scores, "warnings": doubts}
    world.tell(
        run_id,
        ["save", "metrics.json", {"sheet": measured}],
        ["save", "object/parameters.yaml", {"drag": 4.5, "friction": 0.3}],
        ["save", "environment.json", {"device": "cuda:7", "device_name": "A <b>card</b>"}],
        ["publish"],
    )
    world.until(run_id, "succeeded")
    whole = world.client.get(f"/runs/{run_id}").text
    parts = world.client.get(f"/runs/{run_id}/parts").text
    for page in (whole, parts):
        assert 'class="best">12.50' in page
        assert "1 warning</h2>" in page
        assert "<strong>Loose nodes:</strong> 3 of &lt;12&gt; nodes</li>" in page
        assert page.count("of &lt;12&gt; nodes") == 1
        assert '<tr class="changed"><th scope="row"><span' in page
        assert "cuda:7 · A &lt;b&gt;card&lt;/b&gt;" in page
    assert "<html" in whole
    assert "<html" not in parts
    assert world.client.get("/runs/nothing/parts").status_code == 404


def test_a_failure_is_told_on_top_without_the_insides_of_the_program(world: QueueWorld) -> None:
    run_id = world.launch("defect")
    world.until(run_id, "failed")
    # A worker's last words reach the log when the run has failed already.
    log = world.folder(run_id) / "log.txt"
    until(lambda: log.is_file() and "KeyError" in log.read_text())
    assert "Traceback" in log.read_text()
    page = world.client.get(f"/runs/{run_id}").text
    assert "The fit failed in <em>zeroth order</em>" in page
    assert "KeyError: &#39;a &lt;b&gt;key&lt;/b&gt;&#39;" in page
    assert "Traceback" not in page
    assert "job_worker.py" not in page


def test_a_log_that_is_a_link_is_not_followed(world: QueueWorld, fitted_folder: Path) -> None:
    log = shutil.copytree(fitted_folder, world.folder("fitted")) / "log.txt"
    log.write_text("the last words")
    assert "the last words" in world.client.get("/runs/fitted").text
    log.rename(world.data_dir / "secret")
    log.symlink_to(world.data_dir / "secret")
    assert "the last words" not in world.client.get("/runs/fitted").text


def test_names_of_users_are_text_everywhere(world: QueueWorld) -> None:
    run_id = world.launch("wait " + HOSTILE)
    world.until(run_id, "running")
    world.client.post("/api/v1/sessions", json={"kind": "run", "id": run_id})
    for path in ("/", f"/runs/{run_id}", "/live/scene0"):
        page = world.client.get(path).text
        assert "<img src=x" not in page
        assert "&lt;img src=x" in page


def test_a_damaged_folder_is_listed_with_its_error(world: QueueWorld) -> None:
    for kind, file in (("runs", "run.yaml"), ("sequences", "sequence.yaml")):
        folder = world.data_dir / kind / "broken"
        folder.mkdir()
        (folder / file).write_text("name: [")
    run = world.client.get("/api/v1/runs").json()["runs"][0]
    assert (run["id"], run["state"]) == ("broken", "damaged")
    assert run["error"]
    assert world.client.get("/runs/broken").status_code == 200
    sequences = world.client.get("/api/v1/sequences").json()["sequences"]
    assert {entry["id"]: bool(entry["error"]) for entry in sequences} == {
        "broken": True,
        "sheet": False,
    }
    assert "broken" in world.client.get("/").text
    body = {"sequences": ["broken"], "profile": "quick"}
    assert world.client.post("/api/v1/runs", json=body).status_code == 422


def test_a_changed_sequence_is_read_again(world: QueueWorld) -> None:
    path = world.data_dir / "sequences/sheet/sequence.yaml"
    assert world.client.get("/api/v1/sequences/sheet").json()["label"] != "changed"
    lines = [line for line in path.read_text().splitlines() if not line.startswith("label:")]
    path.write_text("\n".join([*lines, "label: changed", ""]))
    assert world.client.get("/api/v1/sequences/sheet").json()["label"] == "changed"


def test_scenes_are_opened_for_the_browser_that_asks_up_to_the_limit(world: QueueWorld) -> None:
    order = {"kind": "sequence", "id": "sheet"}
    first = world.client.post("/api/v1/sessions", json=order)
    assert first.json() == {"id": "scene0", "url": "/live/scene0"}
    assert world.scenes.owners == ["bearer"]
    assert 'src="viewer/scene0/"' in world.client.get("/live/scene0").text
    world.client.post("/api/v1/sessions", json=order)
    assert world.client.post("/api/v1/sessions", json=order).status_code == 429
    assert world.client.delete("/api/v1/sessions/scene0").status_code == 204
    gone = world.client.get("/live/scene0", headers={"Accept": "text/html"})
    assert gone.status_code == 404
    assert "was closed" in gone.text
    wrong = world.client.post("/api/v1/sessions", json={"kind": "file", "id": "x"})
    assert wrong.status_code == 422


def test_the_home_page_stays_short_however_many_runs_there_are(
    world: QueueWorld, fitted_folder: Path
) -> None:
    first = "fitted"
    shutil.copytree(fitted_folder, world.folder(first))
    for number in range(60):
        folder = world.folder(f"old{number:02d}")
        folder.mkdir()
        (folder / "run.yaml").write_text("damaged")
    page = world.client.get("/").text
    rows = '<tr class="plays" data-run='
    assert page.count(rows) == 8
    assert f'href="runs/{first}"' in page
    assert "All 61 runs" in page
    assert world.client.get("/runs").text.count(rows) == 61
    half = world.client.get("/runs?limit=40&offset=40&sort=name").text
    assert half.count(rows) == 21
    assert "41 to 61 of 61" in half
    assert 'rel="prev" href="runs?sort=name&amp;limit=40"' in half
    assert 'rel="next"' not in half
