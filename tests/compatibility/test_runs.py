"""Runs, recordings and presets of commit 57a38d7: listed, shown, simulated and gone on with."""

import csv
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from starlette.testclient import TestClient
from support.inputs.old_data import SAME_MOTION_M, OldFolder, command, differences, serve, unpack
from support.server.server_world import World

from app.viewer.content.content import open_run_content, open_sequence_content
from app.viewer.physics.presets import PresetStore
from physhandi.run import Run

PUBLISHED = ("quick", "softer", "elsewhere", "grasp", "phystwin", "saved")
FITS = ("quick", "grasp", "phystwin")


@pytest.fixture(scope="module")
def client(world: World) -> TestClient:
    return world.script()


def get(client: TestClient, path: str) -> Any:
    answer = client.get(path)
    assert answer.status_code == 200, f"{path}: {answer.text[:300]}"
    return answer.json()


def stored(old: OldFolder, name: str, rel: str) -> np.ndarray:
    """Read an array of a run by NumPy alone."""
    return np.load(old.results(name) / rel)


def sequence_of(old: OldFolder, name: str) -> str:
    return str(yaml.safe_load((old.run(name) / "job.yaml").read_text())["sequence_names"][0])


def test_every_run_is_listed_and_described_as_before(old: OldFolder, client: TestClient) -> None:
    listed = {run["id"]: run for run in get(client, "/api/v1/runs")["runs"]}
    assert set(listed) == {*old.expected["runs"], old.ids["waiting"]}
    for run_id, was in old.expected["runs"].items():
        assert differences(was, get(client, f"/api/v1/runs/{run_id}"), run_id) == []
        both = {field: value for field, value in was.items() if field in listed[run_id]}
        assert differences(both, listed[run_id], f"list.{run_id}") == []
    assert listed[old.ids["waiting"]]["state"] == "queued"


def test_results_are_those_of_the_files(old: OldFolder, client: TestClient) -> None:
    for name in PUBLISHED:
        run_id, out = old.run(name).name, old.results(name)
        results = get(client, f"/api/v1/runs/{run_id}")["results"]
        metrics = json.loads((out / "metrics.json").read_text())
        assert differences(metrics, results["metrics"], name) == []
        assert results["parameters"] == yaml.safe_load((out / "object/parameters.yaml").read_text())
        assert results["environment"] == json.loads((out / "environment.json").read_text())
        losses = get(client, f"/api/v1/runs/{run_id}/losses")["losses"]
        for stage, summary in json.loads((out / "losses.json").read_text()).items():
            assert losses[stage]["curve"] == summary["curve"], (name, stage)
            assert losses[stage]["after"] == summary.get("after"), (name, stage)
        sequence = sequence_of(old, name)
        frames = json.loads((out / "sequences" / sequence / "frame_errors.json").read_text())
        told = get(client, f"/api/v1/runs/{run_id}/frame_errors")["sequences"]
        assert differences(frames, told[sequence], name) == []


def test_losses_of_a_run_that_broke_off_come_from_its_events(
    old: OldFolder, client: TestClient
) -> None:
    curve = get(client, "/api/v1/runs/interrupted/losses")["losses"]["first_order"]["curve"]
    lines = (old.run("interrupted") / "events.jsonl").read_text().splitlines()
    events = [event for line in lines if (event := json.loads(line))["stage"] == "first_order"]
    assert curve == [[event["iteration"], event["loss"]] for event in events]
    assert events


def test_all_published_files_are_what_their_manifests_say(old: OldFolder) -> None:
    folders = [old.run(name) for name in PUBLISHED]
    cells = sorted((old.path / "suites").glob("*/cells/*"))
    assert cells
    for folder in folders + cells:
        Run.open(folder).verify()


def test_settings_of_a_fit_are_read_with_their_values(old: OldFolder, client: TestClient) -> None:
    for run_id, values in old.expected["settings"].items():
        settings = get(client, f"/api/v1/settings?run={run_id}")["settings"]
        told = {setting["path"]: setting["value"] for setting in settings}
        assert differences(values, told, run_id) == []


def test_recordings_are_listed_with_what_they_have(old: OldFolder, client: TestClient) -> None:
    told = {s["id"]: s for s in get(client, "/api/v1/sequences")["sequences"]}
    for was in old.expected["sequences"]:
        assert differences(was, told[was["id"]], was["id"]) == []


def test_two_runs_compare_as_before(old: OldFolder, client: TestClient) -> None:
    told = get(client, "/api/v1/comparison?a=quick&b=softer")
    was = {key: value for key, value in old.expected["comparison"].items() if key != "notes"}
    assert differences(was, told, "comparison") == []
    assert len(told["notes"]) == len(old.expected["comparison"]["notes"])


def test_pages_open(old: OldFolder, world: World) -> None:
    browser = world.browser()
    for page in [*old.expected["pages"], f"/runs/{old.ids['waiting']}"]:
        answer = browser.get(page)
        assert answer.status_code == 200, f"{page}: {answer.text[:300]}"


def test_a_name_tags_and_a_note_are_shown_and_found(old: OldFolder, world: World) -> None:
    page = world.browser().get("/runs?q=tag:best").text
    assert "Sheet, the good one" in page
    page = world.browser().get("/runs/quick").text
    for text in ("Sheet, the good one", "best", "cloth", "Two corners are lifted."):
        assert text in page


def test_a_log_and_a_preview_are_given(old: OldFolder, client: TestClient) -> None:
    grasp = old.ids["grasp"]
    assert (
        client.get(f"/api/v1/runs/{grasp}/log").content
        == (old.run("grasp") / "log.txt").read_bytes()
    )
    assert (
        client.get(f"/api/v1/runs/{grasp}/preview").content
        == (old.run("grasp") / "preview.safetensors").read_bytes()
    )


def test_a_suite_is_listed_with_its_figures(old: OldFolder, world: World) -> None:
    assert "suites/small" in world.browser().get("/suites").text
    page = world.browser().get("/suites/small").text
    with (old.path / "suites/small/table.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert rows
    assert all(row["method"] in page for row in rows)


def test_scenes_open_with_the_stored_motion(old: OldFolder, world: World) -> None:
    for name in PUBLISHED:
        content = open_run_content(world.catalog, old.run(name).name)
        folder = f"sequences/{sequence_of(old, name)}"
        assert content.fitted is not None
        assert np.array_equal(content.fitted.position, stored(old, name, f"{folder}/rollout.npy"))
        assert np.array_equal(content.fitted.control, stored(old, name, f"{folder}/control.npy"))
        assert content.tracks is not None
        content.close()
    content = open_run_content(world.catalog, old.ids["grasp"])
    vertex = stored(old, "grasp", "sequences/grasp/hand_right_vertex.npy")
    face = stored(old, "grasp", "sequences/grasp/hand_right_face.npy")
    assert [hand.side for hand in content.hands] == ["right"]
    shown = content.hands[0]
    assert shown.vertex is not None
    assert shown.face is not None
    assert np.array_equal(shown.vertex, vertex)
    assert np.array_equal(shown.face, face)
    assert [view.name for view in content.views] == ["front", "side"]
    assert content.views[0].color(1).shape == (64, 64, 3)
    content.close()
    with_views = open_sequence_content(world.catalog, "grasp")
    assert len(with_views.skeletons) == 1
    with_views.close()


@pytest.mark.parametrize("name", ["quick", "grasp"])
def test_simulating_unchanged_repeats_the_stored_motion(
    old: OldFolder, tmp_path: Path, name: str
) -> None:
    at = ("--data-dir", old.path, "--device", "cpu")
    command("simulate", old.run(name).name, "--out", tmp_path / "again", *at)
    sequence = sequence_of(old, name)
    rel = f"sequences/{sequence}/rollout.npy"
    again = np.load(tmp_path / "again/attempts/1/out" / rel)
    was = stored(old, name, rel)
    assert np.linalg.norm(again - was, axis=2).max() < SAME_MOTION_M
    moved = np.linalg.norm(was - was[:1], axis=2).max()
    assert moved > 200 * SAME_MOTION_M


def test_a_simulation_is_repeated_by_the_changes_that_it_holds(
    old: OldFolder, tmp_path: Path
) -> None:
    changes = yaml.safe_load((old.run("softer") / "job.yaml").read_text())["config"]["parameters"]
    options = [
        part
        for field, value in changes.items()
        for part in (f"--{field.replace('_', '-')}", str(value))
    ]
    at = ("--data-dir", old.path, "--device", "cpu")
    command("simulate", "quick", "--out", tmp_path / "again", *options, *at)
    rel = "sequences/sheet/rollout.npy"
    again = np.load(tmp_path / "again/attempts/1/out" / rel)
    softer, fitted = stored(old, "softer", rel), stored(old, "quick", rel)
    assert np.linalg.norm(again - softer, axis=2).max() < SAME_MOTION_M
    assert np.linalg.norm(fitted - softer, axis=2).max() > 20 * SAME_MOTION_M


def test_measuring_again_gives_the_stored_scores(old: OldFolder) -> None:
    for name in FITS:
        told = json.loads(
            command("evaluate", "run", old.run(name).name, "--json", "--data-dir", old.path)
        )
        was = json.loads((old.results(name) / "metrics.json").read_text())
        assert differences(was, told, name) == []


def test_an_interrupted_fit_goes_on_after_its_last_finished_stage(own_copy: OldFolder) -> None:
    folder = own_copy.run("interrupted")
    first = json.loads((folder / "attempts/1/stages.json").read_text())
    before = len((folder / "events.jsonl").read_text().splitlines())
    at = ("--data-dir", own_copy.path, "--device", "cpu")
    command("reconstruct", "sheet", "--profile", "quick", "--out", folder, *at)
    run = Run.open(folder)
    run.verify()
    assert run.state == "succeeded"
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    again = {event["stage"] for event in events[before:]}
    assert "first_order" in again
    assert not again & {stage["name"] for stage in first}
    stages = json.loads((folder / "attempts/2/stages.json").read_text())
    assert stages[: len(first)] == first
    same = "object/rest_node.npy"
    assert (folder / "attempts/1/out" / same).samefile(folder / "attempts/2/out" / same)


def test_a_checkpoint_without_an_origin_is_not_used(
    own_copy: OldFolder, caplog: pytest.LogCaptureFixture
) -> None:
    like = {"position": np.zeros((2, 3))}
    with Run.open(own_copy.run("interrupted")).begin_attempt() as attempt:
        assert attempt.checkpointer({}).load("example", like) is None
    assert "not in format physhandi-checkpoint/1" in caplog.text


def test_fits_that_ended_early_are_resumed_renamed_and_deleted(own_copy: OldFolder) -> None:
    client = serve(own_copy.path).script()
    for name in ("interrupted", "cancelled", "failed"):
        answer = client.post(f"/api/v1/runs/{own_copy.run(name).name}/resume")
        assert (answer.status_code, answer.json()["state"]) == (200, "queued"), answer.text
    changed = client.patch("/api/v1/runs/quick", json={"tags": ["cloth"]}).json()
    assert (changed["name"], changed["tags"]) == ("Sheet, the good one", ["cloth"])
    assert client.delete("/api/v1/runs/softer").status_code == 204
    assert not own_copy.run("softer").exists()


def test_a_waiting_fit_keeps_its_place(own_copy: OldFolder) -> None:
    client = serve(own_copy.path).script()
    waiting = own_copy.ids["waiting"]
    assert client.get(f"/api/v1/runs/{waiting}").json()["state"] == "queued"
    cancelled = client.post(f"/api/v1/runs/{waiting}/cancel").json()
    assert cancelled["state"] == "cancelled"


def export(old: OldFolder, name: str, kind: str, out: Path, *more: str) -> Path:
    """Export a run by the command line."""
    own = ("--format", kind, "--out", out, "--device", "cpu", "--data-dir", old.path)
    return Path(command("export", old.run(name).name, *own, *more).strip())


def test_exported_files_say_what_they_said(old: OldFolder, tmp_path: Path) -> None:
    npz, table, summary = (
        export(old, "quick", kind, tmp_path / f"fitted.{kind}") for kind in ("npz", "csv", "yaml")
    )
    with np.load(npz) as now, np.load(old.exports / "fitted.npz") as was:
        for key in was:
            assert np.array_equal(now[key], was[key]), key
    assert table.read_text() == (old.exports / "fitted.csv").read_text()
    told = yaml.safe_load((old.exports / "fitted.yaml").read_text())
    assert differences(told, yaml.safe_load(summary.read_text())) == []


def test_hands_are_exported_for_other_programs(old: OldFolder, tmp_path: Path) -> None:
    assert export(old, "grasp", "gltf", tmp_path / "a.glb").read_bytes()[:4] == b"glTF"
    frames = sorted(export(old, "grasp", "ply", tmp_path / "a_ply").glob("*.ply"))
    assert [frame.name for frame in frames] == [f"frame_{number:05d}.ply" for number in range(3)]
    vertices = stored(old, "grasp", "sequences/grasp/hand_right_vertex.npy").shape[1]
    nodes = stored(old, "grasp", "sequences/grasp/rollout.npy").shape[1]
    header = frames[0].read_bytes().partition(b"end_header")[0].decode("ascii")
    (count,) = re.findall(r"element vertex (\d+)", header)
    assert int(count) >= vertices + nodes
    size = ("--width", "160", "--height", "120", "--link", "f=2&from=side&color=strain")
    picture = cv2.imread(str(export(old, "grasp", "png", tmp_path / "a.png", *size)))
    assert picture is not None
    assert picture.shape == (120, 160, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20


def test_presets_are_read(old: OldFolder) -> None:
    presets, problems = PresetStore(old.path / "presets").presets()
    assert problems == ()
    assert {preset.name: dict(preset.changes) for preset in presets} == {
        "Wet towel": {"drag": 6.0, "stiffness_scale": 0.3},
        "No ground, fine": {"ground_height": None, "substeps_per_frame": "auto"},
        "Wide": {"connection_radius": 0.035, "self_collision": True},
    }


def test_a_folder_from_another_machine_opens_where_it_is(tmp_path: Path, old: OldFolder) -> None:
    data = unpack(tmp_path)
    client = serve(data).script()
    assert len(get(client, "/api/v1/runs")["runs"]) == len(old.expected["runs"]) + 1
    content = open_run_content(serve(data).catalog, old.ids["grasp"])
    assert content.fitted is not None
    assert content.views, "the recording is found by its name"
    content.close()


def test_the_index_of_runs_is_used_while_their_files_are_the_same(own_copy: OldFolder) -> None:
    path = own_copy.path / "cache" / "runs.json"
    index = json.loads(path.read_text())
    # It also names a run that was bundled with the old program, which is not here.
    listed = {f: e for f, e in index["runs"].items() if Path(f).is_relative_to(own_copy.path)}
    assert len(listed) > 8
    for folder, entry in listed.items():
        stamp = [(Path(folder) / name).stat() for name in ("job.yaml", "run.yaml")]
        entry["stamp"] = [value for s in stamp for value in (s.st_mtime_ns, s.st_size)]
        entry["about"]["name"] = f"indexed {entry['about']['name']}"
    path.write_text(json.dumps(index))
    (own_copy.run("softer") / "run.yaml").touch()
    runs = get(serve(own_copy.path).script(), "/api/v1/runs")["runs"]
    names = {run["id"]: run["name"] for run in runs}
    assert names["quick"] == "indexed Sheet, the good one"
    assert names["softer"] == "softer"
