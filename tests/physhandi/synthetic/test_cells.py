"""Cells: what they are scored on, when they are computed anew, and what is told of them."""

import ast
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.inputs.filmed_sheet import write_filmed_sheet
from support.inputs.lpips_weights import write_lpips
from support.inputs.sheet_sequence import FITTED, NODE, write_sheet
from support.server.suite_world import SETTINGS

import physhandi
from physhandi import pipeline
from physhandi.appearance.splats import Splats
from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import write_sequence
from physhandi.errors import CancelledError, RunError, UsageError
from physhandi.progress import NullProgress, Progress
from physhandi.run import Run
from physhandi.synthetic.code_version import (
    INPUTS,
    LOOKS,
    PREDICTIONS,
    SCORES,
    code_version,
)
from physhandi.synthetic.suite import cells
from physhandi.synthetic.suite.cells import Bench, add_photometric, measure_cell, read_look
from physhandi.synthetic.suite.methods import METHODS, parse_method

LIBRARY = Path(physhandi.__file__).parent
FRAMES = 4


def bench_of(out: Path, progress: Progress | None = None) -> Bench:
    return Bench(out, common={}, device="cpu", progress=progress or NullProgress())


# IoU and PSNR


def square(spacing: float) -> np.ndarray:
    """Nodes in the middle of every tile of a square of 20 cm."""
    axis = np.arange(-0.1 + spacing / 2, 0.1, spacing)
    x, y = np.meshgrid(axis, axis)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1).astype(np.float32)


@pytest.fixture
def seen(tmp_path: Path) -> Sequence:
    """A camera 1 m above a square that moves by 5 cm, thus 10 px, a frame."""
    pose = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]])
    K = np.array([[200.0, 0, 60], [0, 200.0, 40], [0, 0, 1]])
    camera = PinholeCamera(K=K, T_world_camera=pose, width=120, height=80)
    images: dict[str, np.ndarray] = {}
    for frame in range(FRAMES):
        mask = np.zeros((80, 120), dtype=np.uint8)
        mask[20:60, 40 + 10 * frame : 80 + 10 * frame] = 1
        color = np.zeros((80, 120, 3), dtype=np.uint8)
        color[..., 0] = 200 * mask
        images[f"views/a/mask/{frame:05d}.png"] = mask
        images[f"views/a/color/{frame:05d}.png"] = color
    meta = SequenceMeta(
        name="square",
        frame_rate=30.0,
        frame_count=FRAMES,
        reconstruction=2,
        views=(ViewMeta(name="a", camera=camera),),
    )
    return write_sequence(tmp_path / "square", meta, images=images)


def run_with(folder: Path, recording: Sequence, rollout: np.ndarray) -> Run:
    run = Run.create(
        folder, name="test", kind="reconstruction", sequences=[str(recording.folder)], config={}
    )
    with run.begin_attempt() as attempt:
        attempt.save_array("sequences/square/object_node.npy", rollout[0])
        attempt.save_array("sequences/square/rollout.npy", rollout)
        attempt.publish()
    return run


def red_square() -> Splats:
    """The look of the square, bound to nodes that no method has."""
    center = square(0.01)
    return Splats(
        center=center,
        scale=np.full(len(center), 0.006, np.float32),
        color=np.tile(np.array([200 / 255, 0, 0], np.float32), (len(center), 1)),
        opacity=np.full(len(center), 0.98, np.float32),
        rest_node=square(0.04),
    )


@pytest.mark.parametrize("spacing", [0.02, 0.01])
def test_pictures_are_those_of_the_method_whatever_its_nodes(
    seen: Sequence, tmp_path: Path, spacing: float
) -> None:
    still = run_with(tmp_path / "still", seen, np.stack([square(0.02)] * FRAMES))
    moved = np.arange(FRAMES)[:, None, None] * np.array([0.05, 0, 0]) + square(spacing)
    moved = moved.astype(np.float32)
    moved[3] = np.nan
    run = run_with(tmp_path / "run", seen, moved)
    curves = measure_cell(run, still, seen, splats=red_square())[1]
    stood = measure_cell(None, still, seen, splats=red_square())[1]
    # 30 and 20 of 40 columns are still covered after one and two steps.
    assert stood["iou_proper"][1:3] == pytest.approx([30 / 50, 20 / 60], abs=0.05)
    assert min(curves["iou_proper"][:3]) > 0.9
    assert curves["iou_proper"][3] == pytest.approx(stood["iou_proper"][3], abs=0.03)
    assert min(curves["psnr"][:3]) > stood["psnr"][1] + 3.0
    assert curves["psnr"][3] < curves["psnr"][2] - 3.0
    assert measure_cell(run, still, seen) == ({}, {})


def test_figures_of_pictures_are_named_by_their_definition(seen: Sequence) -> None:
    measured = {
        definition: {score: base + place + np.arange(4.0) for place, score in enumerate(scores)}
        for base, definition in ((10.0, "phystwin"), (20.0, "proper"), (30.0, "held_out"))
        for scores in [("psnr", "ssim", "iou")]
    }
    measured["held_out"]["iou"][2:] = np.nan
    report: dict[str, Any] = {"reconstruction": {"rollout": {}}, "future": {"rollout": {}}}
    curves: dict[str, Any] = {}
    add_photometric(report, curves, measured, seen)
    assert curves["psnr"] == [10.0, 11.0, 12.0, 13.0]
    assert curves["iou_held_out"] == [32.0, 33.0, None, None]
    fitted, future = (report[split]["rollout"] for split in ("reconstruction", "future"))
    assert (fitted["iou"], fitted["ssim_proper"], fitted["psnr_held_out"]) == (13.0, 22.0, 31.0)
    assert (future["iou"], future["iou_held_out"]) == (14.5, None)
    assert future["photometric"]["proper"] == {"psnr": 22.5, "ssim": 23.5, "iou": 24.5}


def test_a_look_is_fitted_once_for_all_methods_unless_the_order_leaves_it_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = write_filmed_sheet(tmp_path / "sheet")
    common = {"appearance.splat_count": 200, "appearance.iterations": 4}
    bench = Bench(tmp_path / "out", common=common, device="cpu", progress=NullProgress())
    still, follows = (bench.outcome(METHODS[n], recording) for n in ("static", "rigid_follow"))
    (look,) = (tmp_path / "out/looks").iterdir()
    # The sheet is lifted, so that of one that stays less and less is where it was.
    iou = still.curves["iou_proper"]
    assert iou[0] > 0.8
    assert iou[-1] < iou[0] - 0.2
    # The rigid one begins like it, and then goes along with the controls.
    assert follows.curves["psnr"][0] == still.curves["psnr"][0]
    assert np.abs(np.subtract(follows.curves["iou"], iou)).max() > 0.05
    assert np.isfinite(still.report["future"]["rollout"]["psnr_held_out"])
    # Methods themselves do not fit it, and it is found again.
    made = Run.open(tmp_path / "out/cells" / still.run)
    assert not made.config["profile"]["appearance"]["enabled"]
    assert made.config["profile"]["appearance"]["iterations"] == 300
    written = look.stat().st_mtime_ns
    again = Bench(tmp_path / "out", common=common, device="cpu", progress=NullProgress())
    assert again.look(recording) == look
    assert look.stat().st_mtime_ns == written
    off = {"appearance.enabled": False}
    without = Bench(tmp_path / "off", common=off, device="cpu", progress=NullProgress())
    outcome = without.outcome(METHODS["static"], recording)
    assert "iou" not in outcome.report["future"]["rollout"]
    assert not (tmp_path / "off/looks").exists()
    # With weights for LPIPS it is measured again; everything else stays.
    assert "lpips" not in still.curves
    monkeypatch.setenv("PHYSHANDI_LPIPS", str(write_lpips(tmp_path / "lpips")))
    more = Bench(tmp_path / "out", common=common, device="cpu", progress=NullProgress())
    found = more.outcome(METHODS["static"], recording)
    for metric in ("lpips", "lpips_proper", "lpips_held_out"):
        curve = found.curves[metric]
        assert curve[-1] > curve[0] > 0.0
        assert found.report["future"]["rollout"][metric] > 0.0
    assert found.curves["psnr"] == still.curves["psnr"]
    look.write_bytes(b"torn")
    with pytest.raises(RunError, match=look.name):
        read_look(look)


# What a cell is found again by


def statements(block: ast.AST) -> Iterator[ast.AST]:
    """Walk statements without the expressions in them, which are most of a file."""
    yield block
    for part in ("body", "orelse", "finalbody", "handlers", "cases"):
        for inner in getattr(block, part, ()):
            yield from statements(inner)


@cache
def imported_by(file: str) -> tuple[str, ...]:
    """Files of the library that one of it imports."""
    names: list[str] = []
    for node in statements(ast.parse((LIBRARY / file).read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    ours = [name.removeprefix("physhandi.") for name in names if name.startswith("physhandi.")]
    paths = [name.replace(".", "/") + ".py" for name in ours]
    return tuple(path for path in paths if (LIBRARY / path).is_file())


def needed(start: tuple[str, ...], without: tuple[str, ...]) -> set[str]:
    """Follow the imports of files of the library; some are left out."""
    found: set[str] = set()
    waiting = list(start)
    while waiting:
        file = waiting.pop()
        if file in found or file.startswith(without):
            continue
        found.add(file)
        waiting += imported_by(file)
    return found


# Words, looks (which no motion depends on), and the metrics that a run notes of itself, which no
# table takes.
NO_MATTER = (
    *("errors.py", "progress.py", "child.py", "devices.py", "synthetic/code_version.py"),
    *("srgb.py", "metrics/report.py", "metrics/photometric.py", "appearance/", "rendering/"),
)


@pytest.mark.parametrize(
    ("parts", "start", "without"),
    [
        (PREDICTIONS, ("synthetic/suite/methods.py",), NO_MATTER),
        (SCORES, ("metrics/report.py", "appearance/scoring.py"), NO_MATTER[:5]),
        (LOOKS, ("appearance/fit.py", "appearance/texture.py"), NO_MATTER[:5]),
        (PREDICTIONS, INPUTS, NO_MATTER),
    ],
    ids=["predictions", "scores", "looks", "inputs"],
)
def test_all_code_that_a_result_depends_on_is_in_its_hash(
    parts: tuple[str, ...], start: tuple[str, ...], without: tuple[str, ...]
) -> None:
    files = needed(start, without)
    assert len(files) > 3
    kept = {path if path.endswith(".py") else f"{path}/" for path in parts}
    assert not [file for file in files if not file.startswith(tuple(kept))]


def test_the_hash_tells_code_and_libraries(monkeypatch: pytest.MonkeyPatch) -> None:
    hashes = {code_version(parts) for parts in (INPUTS, PREDICTIONS, SCORES)}
    assert len(hashes) == 3
    with pytest.raises(FileNotFoundError, match=r"magic\.py"):
        code_version(("synthetic/magic.py",))
    monkeypatch.setattr("cv2.__version__", "0.0")
    code_version.cache_clear()
    try:
        assert not hashes & {code_version(parts) for parts in (INPUTS, PREDICTIONS, SCORES)}
    finally:
        code_version.cache_clear()


def test_another_processor_computes_a_cell_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = write_sheet(tmp_path / "sheet")
    first = bench_of(tmp_path / "suite").outcome(METHODS["static"], recording).run
    assert bench_of(tmp_path / "suite").outcome(METHODS["static"], recording).run == first
    monkeypatch.setattr(cells, "describe_device", lambda _device: "Another One 3000")
    assert bench_of(tmp_path / "suite").outcome(METHODS["static"], recording).run != first


# What is scored and told


def test_scores_are_taken_against_what_the_method_was_not_given(tmp_path: Path) -> None:
    plain = write_sheet(tmp_path / "plain")
    names = ("control", "marker", "marker_node", "object_node", "rest_node")
    arrays = {f"{name}.npy": np.load(plain.folder / f"{name}.npy") for name in names}
    # Not where the markers are, so that their error is another one.
    rise = np.arange(10)[:, None, None] * np.array([0, 0, 0.01])
    path = (NODE[:4] + rise).astype(np.float32)
    arrays["validation_track.npy"] = path
    meta = replace(plain.meta, name="sheet", provenance={"synthesize": {"seed": 3}})
    recording = write_sequence(tmp_path / "sheet", meta, arrays)
    outcome = bench_of(tmp_path / "suite").outcome(METHODS["static"], recording)
    future = range(FITTED, 10)
    expected = np.mean([0.01 * frame for frame in future])
    found = outcome.report["future"]["rollout"]
    assert found["track_error"] == pytest.approx(expected, rel=1e-4)
    gap = np.linalg.norm(arrays["marker.npy"][FITTED:] - NODE, axis=2).mean()
    assert found["marker_error"] == pytest.approx(gap, rel=1e-4)
    assert abs(gap - expected) > 0.003
    given = list((tmp_path / "suite/inputs").rglob("*"))
    assert [file for file in given if file.name == "marker.npy"]
    assert not [file for file in given if file.name == "validation_track.npy"]


def test_a_restart_and_a_last_residual_of_the_fit_itself(tmp_path: Path) -> None:
    recording = write_sheet(tmp_path / "sheet")
    bench = Bench(tmp_path / "out", common=SETTINGS, device="cpu", progress=NullProgress())
    off = "quick@prediction.restarts=false"
    names = ("quick", off, f"{off}+restart", f"{off}+last_residual", "quick+last_residual")
    rollout = {}
    for name in names:
        run = Run.open(tmp_path / "out/cells" / bench.outcome(parse_method(name), recording).run)
        rollout[name] = run.array("sequences/sheet/rollout.npy")
    np.testing.assert_array_equal(rollout[f"{off}+restart"], rollout["quick"])
    for name in names[1:]:
        np.testing.assert_array_equal(rollout[name][:FITTED], rollout["quick"][:FITTED])
    # What is added to a rollout that restarts is what the observed state still misses.
    added = [rollout[f"{n}+last_residual"] - rollout[n] for n in (off, "quick")]
    assert np.abs(added[0][FITTED:]).max() > 1e-3
    assert np.abs(added[1][FITTED:]).max() < 1e-4
    assert np.abs(rollout["quick"][FITTED:] - rollout[off][FITTED:]).max() > 1e-3


def test_a_cell_that_was_stopped_has_no_times(tmp_path: Path) -> None:
    recording = write_sheet(tmp_path / "sheet")

    class Stopper(Progress):
        def report(self, stage: str, *rest: Any, **more: Any) -> None:
            raise CancelledError("enough")

    through = bench_of(tmp_path / "through")
    methods = [parse_method(n) for n in ("static", "rigid_follow", "rigid_follow+last_residual")]
    for method in methods:
        assert through.outcome(method, recording).seconds["observation"] >= 0
    with pytest.raises(CancelledError):
        bench_of(tmp_path / "stopped", Stopper()).outcome(methods[0], recording)
    for method in methods:  # The first stages of all of them are those of the static object.
        outcome = bench_of(tmp_path / "stopped").outcome(method, recording)
        assert (outcome.error, outcome.seconds) == ("", {})


def test_a_setting_that_only_the_fit_refuses_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = write_sheet(tmp_path / "sheet")

    def refuse(*_: Any, **__: Any) -> None:
        raise UsageError("Self-collision is not simulated in a batch; switch it off.")

    monkeypatch.setattr(pipeline, "search_object", refuse)
    bench = bench_of(tmp_path / "suite")
    for _ in range(2):
        with pytest.raises(UsageError, match="'quick' on sequence 'sheet': Self-collision"):
            bench.outcome(METHODS["quick"], recording)
        with pytest.raises(UsageError, match="'quick' on sequence 'sheet': Self-collision"):
            bench.unseen(METHODS["quick"], recording, recording)
