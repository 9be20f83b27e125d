"""The benchmark of the viewer runs against the real server, and its numbers fit each other."""

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.browser.scene_page import COARSER_PICTURES, FEWER_PICTURES, LESS_WORK
from support.browser.small_pictures import place_pictures

from app import cli
from app.benchmarks import browser, latency, splats, streams, viewer
from app.benchmarks.parts import PARTS
from app.benchmarks.scenes import HEAVY, HEAVY_ARROWS, HEAVY_NODES, make_heavy_run, make_many_runs
from app.benchmarks.served import Served
from app.benchmarks.sliders import is_new_frame
from app.benchmarks.splats import measure_splats, scattered
from app.benchmarks.streams import percentiles
from app.benchmarks.viewer import GOALS, compare_with_goals, measure_viewer
from app.jobs.catalog import Catalog
from app.settings import BUNDLED, ServerSettings
from app.viewer.content.layers import OBJECT_FORMS, ObjectForm
from app.viewer.scene.object_drawing import QUIET_FORCE
from app.viewer.scene.scene import SceneDrawing
from physhandi.errors import MissingInputError, RunError
from physhandi.object_rollout import load_fitted
from physhandi.run import Run
from physhandi.simulation.object_surface import lay_surface

BUNDLED_RUN = "towel_fold_quick"


@pytest.fixture
def little(monkeypatch: pytest.MonkeyPatch) -> None:
    effort = viewer._Effort(moves=2, visits=1, seconds=1.0, runs=20)
    monkeypatch.setattr(viewer, "_QUICK", effort)
    monkeypatch.setattr(streams, "_SETTLING_S", 0.3)
    monkeypatch.setattr(latency, "_STEERED", 60)
    monkeypatch.setattr(browser, "_COUNTED_MS", 500.0)
    # Without a graphics card every picture and every pixel costs, and windows cost more.
    monkeypatch.setattr(browser, "BROWSERS", browser.BROWSERS[::-1])
    monkeypatch.setattr(browser, "_FLAGS", browser._FLAGS + LESS_WORK)
    drawn = COARSER_PICTURES + FEWER_PICTURES
    monkeypatch.setattr(browser, "_WATCH", drawn + browser._WATCH)
    monkeypatch.setattr(browser, "_SIZE", (900, 500))


@pytest.fixture
def pictured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let servers find small pictures of what comes with the program, each of which draws them."""
    make = viewer._Bench._data

    def data(bench: Any, name: str) -> Path:
        folder = make(bench, name)
        place_pictures(folder)
        return folder

    monkeypatch.setattr(viewer._Bench, "_data", data)


def call(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        cli.main(["benchmark", "viewer", *arguments])
    return int(end.value.code or 0), *capsys.readouterr()


def is_in_order(times: dict[str, float]) -> bool:
    return 0.0 < times["p50_ms"] <= times["p95_ms"] <= times["worst_ms"]


@pytest.mark.e2e
@pytest.mark.slow
def test_clients_with_and_without_a_browser_measure_the_real_server(
    little: None, pictured: None, capsys: pytest.CaptureFixture[str]
) -> None:
    parts = ("paint", "open", "scrub", "slider", "browser", "bytes", "runs")
    code, out, error = call(capsys, "--quick", "--json", "--parts", *parts)
    assert code == 0, error
    result = json.loads(out)
    assert (result["benchmark"], result["is_quick"]) == ("viewer", True)
    assert result["load_average"] >= 0.0
    assert set(parts) == set(PARTS) & set(result)
    lists = [result["runs"][path] for path in ("/", "/runs", "/api/v1/runs")]
    for times in (result["scrub"], result["slider"], *lists):
        assert is_in_order(times)
    assert result["runs"]["worst_p95_ms"] == max(times["p95_ms"] for times in lists)
    assert result["scrub"]["moves"] == 6
    kinds = result["slider"]["kinds"]
    assert set(kinds) == {
        f"{field}, {how}"
        for field in ("stiffness_scale", "connection_radius")
        for how in ("playing", "paused")
    }
    assert result["slider"]["moves"] == sum(kind["moves"] for kind in kinds.values()) == 8
    assert result["slider"]["worst_ms"] == max(kind["worst_ms"] for kind in kinds.values())
    heavy = result["bytes"]
    assert (heavy["nodes"], heavy["hands"], heavy["arrows"]) == (3000, 2, 300)
    # Hands and arrows alone are 2 x 1,159 + 2 x 300 points of 12 bytes; the block is a surface.
    assert 36_000 < heavy["frame_bytes"]["p50"] <= heavy["frame_bytes"]["largest"]
    assert heavy["sessions"] == 1
    assert 0.0 < heavy["worst_frames_per_s"] <= heavy["frames_per_s"]
    assert result["runs"]["runs"] == 20
    assert result["runs"]["/"]["bytes"] > 1000
    assert set(result["figures"]) == {n for n, goal in GOALS.items() if goal.part in parts}
    assert result["figures"]["scrub_p95_ms"]["value"] == result["scrub"]["p95_ms"]
    paint, opened, slider = (result[part] for part in ("paint", "open", "browser"))
    assert is_in_order(paint)
    assert is_in_order(opened)
    assert opened["visits"] == 1
    assert 0.0 < paint["answered_ms"] <= paint["loaded_ms"]
    assert is_in_order(slider)
    assert slider["moves"] == 2
    # It arrives, and then it is drawn.
    for name in ("p50_ms", "p95_ms", "worst_ms"):
        assert 0.0 < slider[f"arrived_{name}"] < slider[name]
    assert result["figures"]["click_to_result_p95_ms"]["value"] == opened["p95_ms"]


def test_the_live_part_tells_of_automatic_substeps_and_of_steering(
    little: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run.open(BUNDLED / "runs" / BUNDLED_RUN)
    asked: list[object] = []

    def measured(*about: object, **options: object) -> dict[str, Any]:
        asked.append((about, options))
        rate = {"frames_per_s": 31.0}
        kinds = {
            f"{slider}, substeps {substeps}": rate | {"of": f"{slider} {substeps}"}
            for slider in ("stiffness", "radius")
            for substeps in ("automatic", "as fitted")
        }
        steered = {"frames_per_s": 19.0}
        return {"kinds": kinds, "sequence_frames_per_s": 30.0, "steered": steered, "nodes": 441}

    monkeypatch.setattr(latency, "measure_latency", measured)
    result = measure_viewer(run, "towel_fold", parts=("live",), is_quick=True)
    assert asked == [((run, "towel_fold"), {"device": "cpu", "moves": 2})]
    live = result["live"]
    assert live.pop("load_average") >= 0.0
    assert live == {
        "frames_per_s": 31.0,
        "of": "stiffness automatic",
        "sequence_frames_per_s": 30.0,
        "steered": {"frames_per_s": 19.0},
    }
    figures = {name: figure["value"] for name, figure in result["figures"].items()}
    assert figures == {"live_frames_per_s": 31.0, "steered_frames_per_s": 19.0}


@pytest.mark.slow
def test_the_first_move_after_a_start_is_timed(
    little: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run.open(BUNDLED / "runs" / BUNDLED_RUN)
    real, measured = viewer.Served, viewer.measure_first_move
    monkeypatch.setattr(
        viewer, "Served", lambda *a, **more: real(*a, **more) if more else nullcontext("compiled")
    )
    # Where everything is compiled, less happens than where it is not.
    monkeypatch.setattr(
        viewer,
        "measure_first_move",
        lambda at, *a: {"first_move_ms": 2.5} if at == "compiled" else measured(at, *a),
    )
    result = measure_viewer(run, "towel_fold", parts=("start",), is_quick=True)
    assert result["figures"]["first_move_after_start_ms"]["value"] == 2.5
    start = result["start"]["nothing_compiled"]
    for name in ("server_start_ms", "scene_open_ms", "first_move_ms", "second_move_ms"):
        assert start[name] > 0.0
    # What must be compiled first takes longer, so that the panel says so.
    assert start["is_start_shown"]


@pytest.mark.e2e
@pytest.mark.slow
def test_splats_are_played_beside_nodes_and_the_surface(
    little: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run.open(BUNDLED / "runs" / BUNDLED_RUN)
    real = splats._measure_drawing
    drawn: list[ObjectForm] = []

    def draw_splats_alone(server: Any, scene: SceneDrawing, *more: Any) -> float:
        drawn.extend(form for form in OBJECT_FORMS if getattr(scene.layers, form))
        return real(server, scene, *more) if drawn[-1] == "splats" else 3.0

    monkeypatch.setattr(splats, "_measure_drawing", draw_splats_alone)
    with browser.open_chromium() as chromium:
        result = measure_splats(run, "towel_fold", chromium, 0.5, counts=(400,))
    kinds = result["kinds"]
    assert (list(kinds), drawn) == (
        ["nodes", "surface", "splats_400"],
        ["nodes", "surface", "splats"],
    )
    assert [kinds[name]["pictures_per_s"] for name in ("nodes", "surface")] == [3.0, 3.0]
    assert kinds["splats_400"]["pictures_per_s"] > 0.0
    assert result["frame_bytes"] == kinds["splats_400"]["frame_bytes"]
    # The hand alone is 1,159 points of 12 bytes, of which packing leaves more than half.
    assert 8_000 < kinds["splats_400"]["frame_bytes"] < kinds["surface"]["frame_bytes"]
    for kind in kinds.values():
        assert 0.0 < kind["draw_ms"] < kind["server_ms"]


def test_made_splats_lie_on_the_surface_in_its_colors() -> None:
    x, y = np.meshgrid(np.linspace(0.0, 0.2, 9), np.linspace(0.0, 0.1, 5))
    node = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.3)], axis=1)
    surface = lay_surface(node, kind="sheet")
    assert surface is not None
    left = surface.place(node)[:, 0] < 0.1
    color = np.where(left[:, None], [250, 0, 0], [0, 0, 250]).astype(np.uint8)
    made = scattered(replace(surface, color=color), node, 2_000)
    np.testing.assert_allclose(made.center[:, 2], 0.3, atol=1e-6)
    np.testing.assert_allclose(made.center.mean(axis=0)[:2], [0.1, 0.05], atol=0.004)
    assert made.scale[0] == pytest.approx(0.7 * np.sqrt(0.02 / 2_000), rel=1e-3)
    is_left = made.center[:, 0] < 0.08
    np.testing.assert_allclose(made.color[is_left], [[250 / 255, 0, 0]] * is_left.sum(), atol=0.01)


def test_goals_are_compared_in_the_right_direction() -> None:
    found = {
        "scrub": {"p95_ms": 59.0},
        "sessions": {"worst_frames_per_s": 28.0, "worst_skipped_per_s": 1.0},
        "live": {"frames_per_s": 30.0, "steered": {"frames_per_s": 19.0}},
    }
    figures = compare_with_goals(found)
    assert {name: figure["reached"] for name, figure in figures.items()} == {
        "scrub_p95_ms": True,
        "ten_sessions_frames_per_s": False,
        "ten_sessions_skipped_per_s": False,
        "live_frames_per_s": True,
        "steered_frames_per_s": False,
    }
    assert figures["scrub_p95_ms"] == {"value": 59.0, "goal": 60.0, "reached": True}
    assert {goal.part for goal in GOALS.values()} == set(PARTS)


def test_percentiles_are_those_of_a_sorted_list() -> None:
    seconds = [0.001 * number for number in range(101)]
    expected = {"p50_ms": 50.0, "p95_ms": 95.0, "worst_ms": 100.0}
    assert percentiles(seconds[::-1]) == pytest.approx(expected)


def test_frames_that_never_came_are_counted_around_the_end() -> None:
    received = streams._Received(frames=[57, 58, 0, 1, 4, 5])
    assert received.skipped(60) == 1 + 2  # 59, and 2 and 3


def test_each_frame_is_counted_once_and_one_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now=0.0, perf_counter=lambda: clock.now)
    monkeypatch.setattr(streams, "time", clock)
    # Each is heard a second later; another slider moves, and one frame is told twice.
    told = iter([[("other", 1)], [], [("frame", 3)], [("frame", 3)], [("frame", 4)], []])

    def take_in(_: float) -> list[dict[str, Any]]:
        clock.now, client.bytes_received = clock.now + 1.0, client.bytes_received + 10
        return [
            {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}
            for uuid, value in next(told)
        ]

    client: Any = SimpleNamespace(
        find=str.lower, take_in=take_in, bytes_received=7, nodes={"/forces": {"points": range(12)}}
    )
    late, whole = streams._Received(), streams._Received()
    streams._count(client, 1.5, late)
    assert (late.frames, late.sizes, late.arrows, late.seconds) == ([3], [30], [2], 3.0)
    streams._count(client, 1.5, whole)
    assert (whole.frames, whole.sizes, whole.seconds) == ([3, 4], [10, 10], 2.0)


def test_a_new_frame_is_one_that_only_the_new_rollout_has() -> None:
    rng = np.random.default_rng(5)
    before = rng.uniform(size=(4, 3, 3)).astype(np.float32)
    after = np.concatenate([before[:1], before[1:] + np.float32(0.01)])
    assert is_new_frame(after[2], after, before)
    assert not is_new_frame(after[0], after, before)  # The state that both start from.
    assert not is_new_frame(before[2], after, before)
    assert not is_new_frame(after[2] + np.float32(0.01), after, before)


def test_the_heavy_scene_pulls_at_three_hundred_nodes(tmp_path: Path) -> None:
    run = make_heavy_run(tmp_path)
    run.verify()
    rollout = load_fitted(run, HEAVY)
    assert rollout is not None
    assert rollout.model.node_count == HEAVY_NODES == 3000
    assert rollout.model.object_spring_count > 5000
    for frame in (1, 30, 58):
        force = np.linalg.norm(rollout.forces(frame), axis=-1)
        assert np.count_nonzero(force > QUIET_FORCE) == HEAVY_ARROWS == 300


def test_many_runs_are_listed(tmp_path: Path) -> None:
    make_many_runs(tmp_path / "runs", 12)
    items = Catalog(ServerSettings(data_dir=tmp_path), bundled=tmp_path / "none").runs()
    assert {item.id for item in items} == {f"many_{number:04d}" for number in range(12)}
    names = {item.run.name for item in items if item.run is not None}
    assert names == {f"Run {number}" for number in range(12)}
    assert all(item.run is not None and item.run.is_published for item in items)


def test_what_is_missing_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, error = call(capsys, "--parts", "everything")
    assert (code, "everything" in error) == (2, True)
    assert call(capsys, "nothing")[0] == 1
    monkeypatch.setattr(browser.shutil, "which", lambda _: None)
    with pytest.raises(MissingInputError, match="apt-get install chromium"):
        browser.open_chromium().__enter__()
    monkeypatch.setitem(__import__("sys").modules, "playwright.sync_api", None)
    with pytest.raises(MissingInputError, match="pip install playwright"):
        browser.open_chromium().__enter__()
    with pytest.raises(RunError, match=r"could not be started: .*live_sessions"):
        Served(tmp_path, environment={"PHYSHANDI_LIVE_SESSIONS": "0"})
