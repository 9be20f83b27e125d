"""Fits with other settings: what is taken, what is refused, and what stays of them."""

import html
import json
import re
from typing import Any

import pytest
import yaml
from support.server.queue_world import HOSTILE, QueueWorld
from support.server.server_world import World

from physhandi.fitting.config import PipelineConfig, load_profile
from physhandi.run import Run

OVERRIDES = {
    "object_.search.generations": 12,
    "simulation.stiffness": 2000.0,
    "object_.search.variables.drag": None,
    "object_.search.variables.restitution": {"low": 0.0, "high": 1.0, "scale": "linear"},
    "refinement.iterations": load_profile("quick").refinement.iterations,
}


def order(world: QueueWorld, name: str = "wait", **fields: Any) -> Any:
    body = {"sequences": ["sheet"], "profile": "quick", "name": name} | fields
    return world.client.post("/api/v1/runs", json=body)


def stored(world: QueueWorld, run_id: str) -> dict[str, Any]:
    return yaml.safe_load((world.folder(run_id) / "job.yaml").read_text())["config"]


def test_only_what_differs_is_kept_as_changes_and_all_settings_are_stored(
    world: QueueWorld,
) -> None:
    answer = order(world, overrides=OVERRIDES, parent="fitted")
    assert answer.status_code == 201
    run_id = answer.json()["id"]
    config = stored(world, run_id)
    changed = {path: value for path, value in OVERRIDES.items() if "refinement" not in path}
    assert config["overrides"] == changed
    assert config["parent"] == "fitted"
    settings = PipelineConfig.from_dict(config["profile"])
    assert settings.object_.search.generations == 12
    assert settings.simulation.stiffness == 2000.0
    assert "drag" not in settings.object_.search.variables
    assert settings.object_.search.variables["restitution"].high == 1.0
    assert settings.hand == load_profile("quick").hand
    shown = world.client.get(f"/api/v1/runs/{run_id}").json()
    assert (shown["parent"], shown["overrides"]) == ("fitted", changed)
    rows = {row["path"]: (row["base"], row["value"]) for row in shown["changes"]}
    assert rows["object_.search.generations"] == ("6", "12")
    assert rows["object_.search.variables.restitution"] == ("not searched", "0 to 1")
    assert rows["object_.search.variables.drag"] == ("0 to 10", "not searched")
    titles = {row["path"]: row["title"] for row in shown["changes"]}
    assert titles["object_.search.generations"] == "object / search / generations"
    page = world.client.get(f"/runs/{run_id}").text
    assert "object / search / generations <span" in page
    as_quick = order(world).json()["id"]
    diff = world.client.get("/diff", params={"run": [as_quick, run_id], "show": "all"}).text
    assert diff.count("object / search / generations<") == 1
    assert "overrides" not in diff
    assert 'Made from <a href="runs/fitted">a sheet</a>' in page
    assert "4 settings differ from profile quick" in page
    assert world.client.delete("/api/v1/runs/fitted").status_code == 204
    assert "which was deleted since" in world.client.get(f"/runs/{run_id}").text


def test_a_fit_without_changes_stores_what_it_always_did(world: QueueWorld) -> None:
    run_id = order(world, name="").json()["id"]
    assert set(stored(world, run_id)) == {"profile"}
    named = order(world, name="", overrides={"hand.iterations": 30}).json()
    assert named["name"] == "sheet · quick, 1 change"


def test_wrong_settings_are_all_named_and_make_no_run(world: QueueWorld) -> None:
    before = sorted((world.data_dir / "runs").iterdir())
    wrong = {"hand.iterations": 0, "simulation.stifness": 1.0, "node_spacing": 0.02}
    answer = order(world, overrides=wrong)
    assert answer.status_code == 422
    error = answer.json()["error"]
    told = {entry["field"]: entry["message"] for entry in error["fields"]}
    assert set(told) == {"hand.iterations", "simulation.stifness"}
    assert "from 1 to 100000" in told["hand.iterations"]
    assert "simulation.stiffness" in told["simulation.stifness"]
    assert order(world, parent="nobody").status_code == 404
    assert order(world, overrides=[]).status_code == 422
    assert order(world, overrides={"x" * 300: 1}).status_code == 422
    assert order(world, overrides={str(n): 1 for n in range(300)}).status_code == 422
    not_a_number = '{"sequences": ["sheet"], "overrides": {"node_spacing": NaN}}'
    answer = world.client.post(
        "/api/v1/runs", content=not_a_number, headers={"Content-Type": "application/json"}
    )
    assert answer.status_code == 422
    assert sorted((world.data_dir / "runs").iterdir()) == before


def test_a_resumed_fit_keeps_its_changes(world: QueueWorld) -> None:
    run_id = order(world, overrides=OVERRIDES, parent="fitted").json()["id"]
    world.until(run_id, "running")
    before = stored(world, run_id)
    world.client.post(f"/api/v1/runs/{run_id}/cancel")
    world.until(run_id, "cancelled")
    (world.folder(run_id) / "go").touch()
    world.client.post(f"/api/v1/runs/{run_id}/resume")
    world.until(run_id, "succeeded")
    assert stored(world, run_id) == before
    assert Run.open(world.folder(run_id)).config["overrides"]["object_.search.generations"] == 12


def test_a_draft_is_checked_and_timed_without_a_run(world: QueueWorld) -> None:
    def check(**draft: Any) -> Any:
        return world.client.post("/api/v1/runs/check", json=draft)

    count = len(list((world.data_dir / "runs").iterdir()))
    plain = check(sequences=["sheet"]).json()
    assert plain["problems"] == []
    assert plain["overrides"] == {}
    assert plain["expected"]["basis"].startswith("roughly")
    overrides = {"object_.search.generations": 600, "hand.iterations": 500}
    longer = check(sequences=["sheet"], overrides=overrides).json()
    assert longer["overrides"] == {"object_.search.generations": 600}
    assert longer["expected"]["seconds"] > 3 * plain["expected"]["seconds"]
    wrong = check(sequences=["sheet"], overrides={"node_spacing": 9}).json()
    assert [problem["field"] for problem in wrong["problems"]] == ["node_spacing"]
    assert wrong["expected"] is None
    assert check(overrides={}).json()["expected"] is None
    assert check(sequences=["nowhere"]).status_code == 404
    assert check(profile="fastest").status_code == 422
    assert len(list((world.data_dir / "runs").iterdir())) == count


def test_settings_are_listed_with_the_values_of_a_run_beside_its_profile(
    world: QueueWorld,
) -> None:
    listed = world.client.get("/api/v1/settings?profile=quick").json()
    settings = {setting["path"]: setting for setting in listed["settings"]}
    generations = settings["object_.search.generations"]
    assert (generations["base"], generations["value"], generations["high"]) == (6, 6, 10_000)
    assert generations["about"].startswith("Generations of the evolution strategy")
    run_id = order(world, overrides=OVERRIDES).json()["id"]
    own = world.client.get(f"/api/v1/settings?run={run_id}").json()
    values = {s["path"]: s["value"] for s in own["settings"]}
    assert (own["parent"], own["profile"]) == (run_id, "quick")
    assert values["object_.search.generations"] == 12
    assert values["object_.search.variables.drag"] is None
    assert {s["base"] for s in own["settings"] if s["path"].endswith(".generations")} == {6}
    other = world.client.get(f"/api/v1/settings?run={run_id}&profile=paper").json()
    assert all(s["value"] == s["base"] for s in other["settings"])
    assert world.client.get("/api/v1/settings?run=nobody").status_code == 404
    assert world.client.get("/api/v1/settings?profile=fastest").status_code == 422


def test_the_form_shows_a_runs_own_values_and_its_sequence(world: QueueWorld) -> None:
    run_id = order(world, name="wait " + HOSTILE, overrides=OVERRIDES).json()["id"]
    page = world.client.get(f"/launch?run={run_id}").text
    assert "<img src=x" not in page
    field = re.search(r'data-setting="object_.search.generations".*?value="(\d+)"', page, re.DOTALL)
    assert field is not None
    assert field[1] == "12"
    base = re.search(
        r"data-setting=\"object_.search.variables.drag\"[^>]*data-base='([^']*)'", page
    )
    assert base is not None
    assert json.loads(html.unescape(base[1])) == {"low": 0.0, "high": 10.0, "scale": "linear"}
    assert re.search(r'name="sequence" value="sheet" checked', page)
    fresh = world.client.get("/launch?sequence=sheet&profile=paper").text
    assert re.search(r'name="sequence" value="sheet" checked', fresh)
    assert "data-parent" not in fresh
    assert world.client.get("/launch?run=nobody").status_code == 404


@pytest.mark.parametrize("path", ["/launch?run=..%2Fetc", "/launch?profile=a%2Fb"])
def test_a_strange_address_is_refused(still_world: World, path: str) -> None:
    assert still_world.script().get(path).status_code == 422
