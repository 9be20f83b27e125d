"""MANO through the stages: fitted, stored, simulated with, and opened again."""

import shutil
from pathlib import Path

import hand_scene as scene
import numpy as np
import pytest
import yaml
from scipy.spatial import cKDTree

from physhandi import pipeline
from physhandi.data.exporters import export_run
from physhandi.errors import MissingInputError, UsageError
from physhandi.fitting.artefacts import load_motions
from physhandi.fitting.config import HandFitConfig, PipelineConfig, load_profile
from physhandi.fitting.hand_reconstruction import reconstruct_hands
from physhandi.hand.loading import load_hand_model
from physhandi.hand.names import HandSide
from physhandi.run import Run

BUNDLED = Path(__file__).parents[3] / "sequences"
FRAMES, FITTED = 24, 17
"""Frames of it that are used, and how many of them are fitted."""
CAMERAS = [scene.looking_at_hand(angle) for angle in (0.0, 1.2, 2.6)]


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_known_mano_hand_is_found_again(tmp_path: Path, mano: Path, side: HandSide) -> None:
    truth = scene.grasping(side, model="mano")
    keypoint = scene.seen_keypoints([truth], CAMERAS)
    sequence = scene.write_scene(tmp_path / "a", [truth], CAMERAS, keypoint)
    fit = reconstruct_hands(sequence, HandFitConfig(model="mano", iterations=160))
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


@pytest.mark.slow
@pytest.mark.no_cover  # Its lines are those of the quick tests of stages and of MANO.
def test_a_whole_run_uses_mano_and_outlives_it(
    tmp_path: Path, mano: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = Run.open(BUNDLED / "runs" / "towel_fold_quick")
    folder = first_frames_of_towel(tmp_path, stored.array("sequences/towel_fold/keypoint.npy"))
    config = load_profile("quick")
    search = config.object_.search.replace(generations=1, population=4, widening_generations=0)
    first_order = config.object_.first_order.replace(iterations=1)
    config = config.replace(
        hand=config.hand.replace(model="mano", iterations=60, depth_iterations=0),
        refinement=config.refinement.replace(iterations=2),
        object_=config.object_.replace(search=search, first_order=first_order),
    )
    run = Run.create(
        tmp_path / "run",
        name="with MANO",
        kind="reconstruction",
        sequences=[str(folder)],
        config={"profile": config.to_dict()},
    )
    pipeline.run_job(run)

    run = Run.open(run.folder)
    assert run.state == "succeeded"
    (motion,) = load_motions(run.out, "towel_fold")
    assert motion.model == "mano"
    base = "sequences/towel_fold"
    vertex = run.array(f"{base}/hand_right_vertex.npy")
    assert vertex.shape[1:] == (778, 3)
    np.testing.assert_array_equal(vertex, motion.vertices(load_hand_model("right", "mano")))
    np.testing.assert_array_equal(run.array(f"{base}/control.npy"), vertex)
    assert run.array(f"{base}/hand_right_face.npy").shape == (1538, 3)
    assert np.isfinite(run.array(f"{base}/rollout.npy")).all()
    # The made-up MANO is cut out of the open hand, so it must lie on what the open hand fitted.
    known = stored.array(f"{base}/hand_right_vertex.npy")
    assert len(vertex) == FRAMES
    for frame in (0, FRAMES // 2, FRAMES - 1):
        assert cKDTree(vertex[frame]).query(known[frame])[0].mean() < 0.006

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
    for part in ("vertex", "face", "keypoint"):
        file = f"{base}/hand_right_{part}.npy"
        np.testing.assert_array_equal(again.array(file), run.array(file))
    assert export_run(again, "gltf", tmp_path / "again.glb").stat().st_size > 100_000
