"""Addresses of commit 57a38d7: of live scenes, comparisons and lists."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from support.inputs.old_data import SAME_MOTION_M, OldFolder, command, differences
from support.server.server_world import World

from app.exports.permalink import state_from_query, state_to_query
from app.viewer.compare.request import CompareAsk
from app.viewer.content.session_state import SessionState


def meaning(state: SessionState) -> dict[str, Any]:
    """Say what a link means, in the words of the record."""
    pose = state.pose
    return {
        "sequence_name": state.sequence_name,
        "frame": state.frame,
        "is_playing": state.is_playing,
        "speed": state.speed,
        "does_loop": state.does_loop,
        "theme": state.theme,
        "is_figure": state.is_figure,
        "automatic_substeps": state.automatic_substeps,
        "layer_changes": json.loads(json.dumps(dict(state.layer_changes))),
        "parameter_changes": dict(state.parameter_changes),
        "pose": pose
        and {
            "position": pose.position.tolist(),
            "look_at": pose.look_at.tolist(),
            "up": pose.up.tolist(),
            "fov": pose.fov,
        },
    }


def test_a_link_means_what_it_meant(old: OldFolder) -> None:
    for scene in old.links["scenes"]:
        state = state_from_query(scene["query"])
        assert differences(scene["state"], meaning(state), scene["title"]) == []
        assert state_to_query(state) == scene["query"], scene["title"]


def test_an_address_opens_a_scene_whose_link_is_the_one_of_then(
    old: OldFolder, world: World
) -> None:
    client = world.script()
    for scene in old.links["scenes"]:
        if scene["state"]["parameter_changes"]:
            continue  # These start the process that simulates; the export below reads them.
        opened = client.get(scene["address"])
        assert opened.status_code == 303, f"{scene['title']}: {opened.text[:300]}"
        session = opened.headers["location"].partition("?")[0].removeprefix("/live/")
        assert world.sessions.get(session) is not None
        link = client.get(f"/api/v1/sessions/{session}/link").json()
        world.sessions.close(session)
        now, then = link["url"], scene["link_of_the_open_scene"]
        if "show" not in scene["query"]:
            # What is usual where an address does not say what is shown has changed since.
            now, then = (re.sub("&show=[a-z_,]+", "", one) for one in (now, then))
        assert now == then, scene["title"]


def test_parameters_of_a_link_move_the_object_as_they_did(old: OldFolder, tmp_path: Path) -> None:
    with np.load(old.exports / "fitted.npz") as arrays:
        fitted = arrays["rollout"]
    changed = [scene for scene in old.links["scenes"] if scene["state"]["parameter_changes"]]
    assert len(changed) == 2
    for scene in changed:
        name = f"{scene['title'].replace(' ', '_')}.npz"
        address = f"http://127.0.0.1:8080{scene['address']}&token=of-a-server-long-gone"
        own = ("--device", "cpu", "--data-dir", old.path)
        command(
            "export", "quick", "--format", "npz", "--out", tmp_path / name, "--link", address, *own
        )
        with np.load(tmp_path / name) as now, np.load(old.exports / name) as was:
            assert np.linalg.norm(now["rollout"] - was["rollout"], axis=2).max() < SAME_MOTION_M
            assert np.linalg.norm(was["rollout"] - fitted, axis=2).max() > 0
            springs = now["spring_nodes"] if "spring_nodes" in was else None
            assert springs is None or np.array_equal(springs, was["spring_nodes"])


def test_a_comparison_is_read_and_written_as_it_was(old: OldFolder, world: World) -> None:
    browser = world.browser()
    for comparison in old.links["comparisons"]:
        path, _, query = comparison["address"].partition("?")
        ask = CompareAsk.parse(query)
        assert differences(comparison["fields"], ask.model_dump(), query) == []
        assert f"{path}?{ask.query}" == comparison["address"]
        assert browser.get(comparison["address"]).status_code == 200
        fields = {k: v for k, v in comparison["fields"].items() if v is not None}
        opened = world.script().post("/api/v1/sessions", json={"kind": "comparison", **fields})
        assert opened.status_code == 201, opened.text
        session = opened.json()["id"]
        link = world.script().get(f"/api/v1/sessions/{session}/link").json()["url"]
        world.sessions.close(session)
        assert link == comparison["address"]


def test_a_filtered_list_gives_the_same_runs(old: OldFolder, world: World) -> None:
    for listed in old.links["lists"]:
        answer = world.script().get(f"/api/v1{listed['address']}")
        assert [run["id"] for run in answer.json()["runs"]] == listed["runs"], listed["address"]
        page = world.browser().get(listed["address"])
        assert page.status_code == 200
        assert all(f'href="runs/{run_id}"' in page.text for run_id in listed["runs"])
