"""MANO through the stages: fitted, refined, stored, simulated with, and opened again."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial import cKDTree
from support.physics import hand_scene as scene

from physhandi import pipeline
from physhandi.data.exporters import export_run
from physhandi.data.sequence import Sequence
from physhandi.errors import CancelledError, MissingInputError, UsageError
from physhandi.fitting.artefacts import load_model, load_motions
from physhandi.fitting.config import HandFitConfig, PipelineConfig, load_profile
from physhandi.fitting.hand_reconstruction import reconstruct_hands
from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.hand.names import HandSide
from physhandi.progress import Progress
from physhandi.run import Run

BUNDLED = Path(__file__).parents[3] / "sequences"
FRAMES, FITTED = 14, 10
"""Frames of it that are used, and how many of them are fitted."""
CAMERAS = [scene.looking_at_hand(angle) for angle in (0.0, 1.2, 2.6)]


def test_a_known_mano_hand_is_found_again(tmp_path: Path, mano: Path) -> None:
    side: HandSide = "left"
    truth = scene.grasping(side, model="mano")
    keypoint = scene.seen_keypoints([truth], CAMERAS)
    sequence = scene.write_scene(tmp_path / "a", [truth], CAMERAS, keypoint)
    fit = reconstruct_hands(sequence, HandFitConfig(model="mano", iterations=120))
    hand = load_hand_model(side, "mano")
    found, expected = fit.motions[0].vertices(hand), truth.vertices(hand)
    assert fit.motions[0].model == "mano"
    assert found.shape == (16, 778, 3)
    assert np.linalg.norm(found - expected, axis=-1).mean(axis=1).max() < 0.003
    assert np.linalg.norm(expected[15] - expected[0], axis=-1).max() > 0.05
    assert fit.loss_before > 10 * fit.loss_after


def test_without_mano_the_fit_says_how_to_bring_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PHYSHANDI_HANDS", str(tmp_path))
    truth = scene.grasping(frames=2)
    keypoint = scene.seen_keypoints([truth], CAMERAS)
    sequence = scene.write_scene(tmp_path / "a", [truth], CAMERAS, keypoint)
    with pytest.raises(MissingInputError, match="physhandi import mano"):
        reconstruct_hands(sequence, HandFitConfig(model="mano"))
    with pytest.raises(UsageError, match=r"hand.model is 'smpl'; expected one of open, mano"):
        PipelineConfig.from_dict({"hand": {"model": "smpl"}})


def first_frames_of_towel(place: Path, keypoint: np.ndarray) -> Path:
    """Copy the start of the bundled sequence: depth, masks, tracks and keypoints of the run."""
    folder = place / "towel_fold"
    shutil.copytree(BUNDLED / "towel_fold", folder)
    about = yaml.safe_load((folder / "sequence.yaml").read_text())
    about |= {"frame_count": FRAMES, "split": {"reconstruction": FITTED}}
    (folder / "sequence.yaml").write_text(yaml.safe_dump(about))
    for view, seen in zip(about["views"], keypoint, strict=True):
        of_view = folder / "views" / view["name"]
        np.save(of_view / "keypoint.npy", seen[:FRAMES])
        for name in ("track.npy", "track_visible.npy"):
            np.save(of_view / name, np.load(of_view / name)[:FRAMES])
        (of_view / "color.mp4").unlink()
        for image in of_view.glob("*/*"):
            if int(image.stem) >= FRAMES:
                image.unlink()
    return folder


class Impatient(Progress):
    """Asks to stop after so many reports of the refinement."""

    def __init__(self, patience: int) -> None:
        self.stages: list[str] = []
        self.patience = patience

    def report(self, stage: str, *rest: Any, **more: Any) -> None:
        self.stages.append(stage)

    def check_cancelled(self) -> None:
        if self.stages.count(pipeline.REFINEMENT) == self.patience:
            raise CancelledError


def brief_config_with_mano() -> PipelineConfig:
    """Little of each stage, with steps of the refinement that keypoints hold back nowhere."""
    config = load_profile("quick")
    # Four candidates are better spent on springs than on friction.
    variables = config.object_.search.variables | {}
    del variables["friction"]
    search = config.object_.search.replace(
        generations=1, population=4, widening_generations=0, variables=variables
    )
    first_order = config.object_.first_order.replace(iterations=1)
    return config.replace(
        hand=config.hand.replace(model="mano", iterations=60, depth_iterations=0),
        refinement=config.refinement.replace(
            iterations=4, articulation_rate=0.001, rotation_rate=0.001, translation_rate=0.0001
        ),
        object_=config.object_.replace(
            search=search, first_order=first_order, follows_late_tracks=False
        ),
    )


def finished_after_a_stop(place: Path, folder: Path) -> Run:
    """Fit the towel with MANO, stopped in the middle of the refinement and gone on with."""
    run = Run.create(
        place,
        name="with MANO",
        kind="reconstruction",
        sequences=[str(folder)],
        config={"profile": brief_config_with_mano().to_dict()},
    )
    with pytest.raises(CancelledError):
        pipeline.run_job(run, Impatient(2))
    resumed = Impatient(1000)
    pipeline.run_job(run, resumed)
    assert set(resumed.stages) == {pipeline.REFINEMENT, pipeline.EVALUATION, "rollout"}
    return Run.open(run.folder)


def measured_without_hand_points(run: Run, folder: Path) -> dict[str, Any]:
    """Measure a run from which the points of its hand are taken away."""
    points = list(run.out.rglob("hand_point*.npy"))
    assert points
    for path in points:
        path.unlink()
    measured = pipeline.evaluate(run, [Sequence.load(folder)])["towel_fold"]
    assert 0.002 < measured["hands"]["right"]["chamfer_points_to_mesh"] < 0.005
    assert measured["contact"]["frame_0"]["accuracy_10mm"] > 0.8
    return measured


@pytest.mark.slow
def test_a_whole_run_refines_mano_goes_on_after_a_stop_and_outlives_mano(
    tmp_path: Path, mano: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = Run.open(BUNDLED / "runs" / "towel_fold_quick")
    folder = first_frames_of_towel(tmp_path, stored.array("sequences/towel_fold/keypoint.npy"))
    run = finished_after_a_stop(tmp_path / "run", folder)
    assert run.state == "succeeded"
    run.verify()
    losses = run.json("losses.json")
    assert list(losses) == list(pipeline.STAGES)
    assert losses[pipeline.REFINEMENT]["after"] < losses[pipeline.REFINEMENT]["before"]
    base, model = "sequences/towel_fold", load_hand_model("right", "mano")
    (motion,) = load_motions(run.out, "towel_fold")
    assert motion.model == "mano"
    vertex = run.array(f"{base}/hand_right_vertex.npy")
    assert vertex.shape == (FRAMES, 778, 3)
    np.testing.assert_array_equal(vertex, motion.vertices(model))
    np.testing.assert_array_equal(run.array(f"{base}/control.npy"), vertex)
    face = run.array(f"{base}/hand_right_face.npy")
    assert face.shape == (1538, 3)
    np.testing.assert_array_equal(run.tensors(f"{base}/model.safetensors")["hand_face"], face)
    assert np.isfinite(run.array(f"{base}/rollout.npy")).all()
    # What the hand holds was decided before it was refined.
    first = HandMotion.from_tensors(run.tensors(f"{base}/hand_right_initial.safetensors"))
    before = first.vertices(model).astype(np.float32)
    np.testing.assert_array_equal(run.array(f"{base}/attachment.npy"), before[0])
    assert np.abs(vertex - before)[:FITTED].max() > 2e-4
    # The made-up MANO is cut out of the open hand, so it must lie on what the open hand fitted.
    # Hands of three views are better than an object that is wrong by 7 mm: they must stay so.
    known = stored.array(f"{base}/hand_right_vertex.npy")
    for frame in (0, FRAMES // 2, FRAMES - 1):
        off, off_before = (
            cKDTree(hand[frame]).query(known[frame])[0].mean() for hand in (vertex, before)
        )
        assert off < 0.006
        assert off < off_before + 2e-4

    monkeypatch.setenv("PHYSHANDI_HANDS", str(tmp_path / "nowhere"))
    again = Run.create(
        tmp_path / "again",
        name="without MANO",
        kind="simulation",
        sequences=[str(folder)],
        config={"source": str(run.folder), "parameters": {}},
    )
    pipeline.run_job(again)
    again = Run.open(again.folder)
    rollout = [one.array(f"{base}/rollout.npy") for one in (run, again)]
    np.testing.assert_array_equal(rollout[1], rollout[0])
    held = [load_model(one.out, "towel_fold") for one in (run, again)]
    np.testing.assert_array_equal(held[1].rest_length, held[0].rest_length)
    for file in (f"{base}/hand_right_{part}.npy" for part in ("vertex", "face", "keypoint")):
        np.testing.assert_array_equal(again.array(file), run.array(file))
    assert export_run(again, "gltf", tmp_path / "again.glb").stat().st_size > 100_000
    # Without points of the hand a run is measured with those of its sequence.
    assert measured_without_hand_points(run, folder) == run.json("metrics.json")["towel_fold"]
