"""Stage 1 on a made-up hand that is known exactly, and on the real two-camera recording."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.inputs.recordings import recording
from support.physics import hand_scene as scene
from support.physics.stopped_fits import check_resumed, write_always

import physhandi as ph
from physhandi.data.checkpoint import Checkpointer
from physhandi.data.importers.stereo import import_stereo
from physhandi.data.sequence import Sequence
from physhandi.errors import CancelledError, FitError, MissingInputError, SettingsError
from physhandi.fitting.hand_reconstruction import (
    HandFit,
    HandFitConfig,
    _without_jumps,
    observed_keypoints,
    reconstruct_hands,
)
from physhandi.fitting.hands.observed import DepthTarget, depth_target
from physhandi.fitting.hands.wrist_guess import way_to_depth
from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.metrics.hands import evaluate_hands
from physhandi.perception.keypoints import detect_sequence
from physhandi.progress import NullProgress, Progress

QUICK = HandFitConfig(iterations=100)
RECORDED = 32
"""Frames of the real recording that are used."""


CAMERAS = [scene.looking_at_hand(angle) for angle in (0.0, 1.2, 2.6)]


def _vertex_error(fit: HandFit, truth: HandMotion, hand: int = 0) -> np.ndarray:
    """Distance of every vertex from the true one, mean of each frame [length unit]."""
    model = load_hand_model(truth.side)
    found = fit.motions[hand].vertices(model) - truth.vertices(model)
    return np.linalg.norm(found, axis=-1).mean(axis=1)


def test_a_known_hand_is_found_again_and_frames_that_no_view_saw_are_bridged(
    tmp_path: Path,
) -> None:
    truth = scene.grasping()
    keypoint = scene.seen_keypoints([truth], CAMERAS)
    keypoint[:, 6:9] = np.nan
    keypoint[:2, 12] = np.nan
    keypoint[:, 15] = np.nan
    fit = reconstruct_hands(scene.write_scene(tmp_path / "a", [truth], CAMERAS, keypoint), QUICK)
    error = _vertex_error(fit, truth)
    assert len(error) == 16
    assert np.delete(error, [6, 7, 8, 12, 15]).max() < 0.003
    assert error[6:9].max() < 0.008
    assert error[12] < 0.006
    assert error[15] < 0.02
    joint = fit.motions[0].keypoints(load_hand_model("right"))
    (score,) = evaluate_hands(CAMERAS, [joint], keypoint)
    assert score.fitted.median < 0.5
    assert score.frame_count == 12
    assert fit.loss_before > 10 * fit.loss_after
    assert 10 < fit.curve[-1][0] == len(fit.curve) < 40
    np.testing.assert_allclose(fit.keypoint, keypoint)
    assert np.abs(np.diff(fit.motions[0].wrist_rotation, axis=0)).max() < 0.3


def test_both_hands_and_the_scale_of_a_sequence_without_metres(tmp_path: Path) -> None:
    motions = [scene.grasping("right", scale=20.0), scene.grasping("left", scale=20.0)]
    cameras = []
    for camera in CAMERAS:
        pose = camera.T_world_camera.copy()
        pose[:3, 3] *= 20
        fields = {**camera.to_dict(), "T_world_camera": pose.tolist()}
        cameras.append(type(camera).from_dict(fields))
    keypoint = scene.seen_keypoints(motions, cameras)
    sequence = scene.write_scene(tmp_path / "a", motions, cameras, keypoint, metric=False)
    fit = reconstruct_hands(sequence, HandFitConfig(iterations=90))
    assert [motion.side for motion in fit.motions] == ["right", "left"]
    for hand, truth in enumerate(motions):
        # A sequence without metres cannot tell a large hand from a small unit.
        size, true_size = fit.motions[hand].shape[0], truth.shape[0]
        product = fit.motions[hand].scale * np.exp(0.05 * size)
        assert product == pytest.approx(20 * np.exp(0.05 * true_size), rel=0.03)
        assert _vertex_error(fit, truth, hand).max() < 20 * 0.004


def test_a_view_that_errs_is_outvoted(tmp_path: Path) -> None:
    truth = scene.grasping()
    keypoint = scene.seen_keypoints([truth], CAMERAS)
    keypoint[1, 4:6, :, :, 0] += 60
    keypoint[2, 10, 0, 8:, 1] -= 45
    sequence = scene.write_scene(tmp_path / "a", [truth], CAMERAS, keypoint)
    fit = reconstruct_hands(sequence, HandFitConfig(iterations=110))
    assert _vertex_error(fit, truth).max() < 0.005


def test_without_masks_a_hand_is_measured_at_its_keypoints(tmp_path: Path) -> None:
    truth = scene.grasping(frames=3)
    keypoint = scene.seen_keypoints([truth], CAMERAS[:1])
    sequence = scene.write_scene(tmp_path / "a", [truth], CAMERAS[:1], keypoint, depth=True)
    masked = depth_target(sequence, "right", 10_000)
    folder = sequence.views[0].folder
    for path in sorted((folder / "depth").iterdir()):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image is not None
        image[image == 0] = 900  # A wall behind the hand, and something that hides some fingers.
        image[:, : int(np.nanmin(keypoint[0, :, 0, :, 0]) + 12)] = 200
        cv2.imwrite(str(path), image)
    shutil.rmtree(folder / "mask")
    blank = Sequence.load(sequence.folder)
    assert depth_target(blank, "right", 64) is None
    found = depth_target(blank, "right", 64, keypoint[:, :, 0])
    assert masked is not None
    assert found is not None
    for frame in range(3):
        true = masked.point[frame][masked.weight[frame] > 0]
        point = found.point[frame][found.weight[frame] > 0]
        assert len(point) > 20
        assert torch.cdist(point, true).min(dim=1).values.max() < 0.015
    unseen = np.full_like(keypoint[:, :, 0], np.nan)
    assert depth_target(blank, "right", 64, unseen) is None


def test_a_turn_by_more_than_half_a_circle_goes_on_without_a_jump() -> None:
    turned = np.outer(np.linspace(2.8, 3.6, 9), [0.6, 0.0, 0.8])
    vector = Rotation.from_rotvec(turned).as_rotvec()
    assert np.abs(np.diff(vector, axis=0)).max() > 3.0
    np.testing.assert_allclose(_without_jumps(vector), turned, atol=1e-9)


def test_depth_places_a_hand_of_unknown_size_that_one_view_takes_for_a_nearer_one(
    tmp_path: Path,
) -> None:
    """A hand that is larger by a seventh looks like one that is nearer by a seventh of 0.6 m."""
    truth = replace(scene.grasping(frames=4), scale=1.15)
    keypoint = scene.seen_keypoints([truth], CAMERAS[:1])
    sequence = scene.write_scene(tmp_path / "a", [truth], CAMERAS[:1], keypoint, depth=True)
    config = HandFitConfig(iterations=60, depth_iterations=0, search_iterations=20)
    assert _vertex_error(reconstruct_hands(sequence, config), truth).mean() > 0.05
    for is_new in (True, False):
        config = HandFitConfig(
            gauss_newton=is_new,
            iterations=60,
            depth_iterations=60,
            search_iterations=20,
            starts_at_depth=is_new,
            fixed_normals=is_new,
        )
        assert _vertex_error(reconstruct_hands(sequence, config), truth).mean() < 0.007


def test_the_way_to_measured_depth_is_along_the_line_of_sight() -> None:
    """A ball of dots, seen from above and from aside, that was measured elsewhere."""
    normal = np.random.default_rng(4).normal(size=(2000, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    vertex = 0.05 * normal
    sights = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 0.0, 1.0]])
    ways = np.array([0.08, -0.03, 0.08])
    point = np.zeros((3, 40, 3))
    for frame, (sight, way) in enumerate(zip(sights, ways, strict=True)):
        point[frame] = vertex[normal @ sight > 0.5][:40] + way * sight
    weight = np.full((3, 40), 1 / 40)
    weight[2] = 0.0  # Nothing was measured: as in the frame before.
    target = DepthTarget(
        point=torch.tensor(point, dtype=torch.float32),
        towards_camera=torch.tensor(np.repeat(sights[:, None], 40, axis=1), dtype=torch.float32),
        weight=torch.tensor(weight, dtype=torch.float32),
    )
    frames = np.repeat(vertex[None], 3, axis=0), np.repeat(normal[None], 3, axis=0)
    # At 3 frames a second the median over time is that of a single one.
    found = way_to_depth(*frames, target, frame_rate=3.0)
    expected = ways[[0, 1, 1], None] * sights[[0, 1, 1]]
    np.testing.assert_allclose(found, expected, atol=1e-3)
    target.weight[:] = 0.0
    assert np.all(way_to_depth(*frames, target, frame_rate=3.0) == 0.0)


def test_a_hand_that_nobody_sees_does_not_stop_the_other(tmp_path: Path) -> None:
    motions = [scene.grasping("right", frames=6), scene.grasping("left", frames=6)]
    keypoint = scene.seen_keypoints(motions, CAMERAS)
    keypoint[:, :, 1, :19] = np.nan  # Two fingertips do not place a hand.
    few = HandFitConfig(iterations=20)
    both = reconstruct_hands(scene.write_scene(tmp_path / "both", motions, CAMERAS, keypoint), few)
    assert [motion.side for motion in both.motions] == ["right"]
    assert list(both.left_out) == ["left"]
    assert "left hand cannot be placed" in both.left_out["left"]
    assert both.keypoint.shape[2] == 2
    alone = reconstruct_hands(
        scene.write_scene(tmp_path / "one", motions[:1], CAMERAS, keypoint[:, :, :1]), few
    )
    assert alone.left_out == {}
    assert (both.loss_before, both.loss_after) == (alone.loss_before, alone.loss_after)
    # The same input gives the same bits.
    for name, array in alone.motions[0].to_tensors().items():
        assert np.array_equal(array, both.motions[0].to_tensors()[name]), name


def test_a_run_goes_on_without_a_hand_that_nobody_sees_and_says_so(tmp_path: Path) -> None:
    motions = [scene.grasping("right", frames=6), scene.grasping("left", frames=6)]
    keypoint = scene.seen_keypoints(motions, CAMERAS)
    keypoint[:, :, 1] = np.nan
    keypoint[:, 2:, 0] = np.nan
    sequence = scene.write_scene(tmp_path / "both", motions, CAMERAS, keypoint)
    few = {"hand.iterations": 2, "hand.depth_iterations": 0}
    run = ph.reconstruct(sequence, profile="quick", overrides=few, out=tmp_path / "run")
    warnings = {w["code"]: w["message"] for w in run.warnings}
    assert set(warnings) == {"hand_left_out", "hand_filled"}
    assert "The left hand was left out" in warnings["hand_left_out"]
    assert "seen in 0 of 6 frames" in warnings["hand_left_out"]
    assert "The right hand is seen in few frames" in warnings["hand_filled"]
    assert "seen in 2 of 6 frames" in warnings["hand_filled"]
    (stage,) = [stage for stage in run.stages() if stage["name"] == "hand_reconstruction"]
    assert stage["summary"]["note"].startswith("Left out. The left hand cannot be placed")
    assert run.has("sequences/both/hand_right_vertex.npy")
    assert not run.has("sequences/both/hand_left_vertex.npy")


def test_a_view_without_color_and_keypoints_leaves_hands_to_the_others(tmp_path: Path) -> None:
    truth = scene.grasping(frames=4)
    keypoint = scene.seen_keypoints([truth], CAMERAS)
    sequence = scene.write_scene(tmp_path / "a", [truth], CAMERAS, keypoint)
    (sequence.folder / "views/view0/keypoint.npy").unlink()
    seen = observed_keypoints(Sequence.load(sequence.folder), NullProgress())
    assert np.isnan(seen[0]).all()
    np.testing.assert_array_equal(seen[1:], keypoint[1:])


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    truth = scene.grasping(frames=2)
    keypoint = scene.seen_keypoints([truth], CAMERAS)
    keypoint[..., 3:, :] = np.nan
    keypoint[..., :3, :] = np.nan
    with pytest.raises(FitError, match="right hand cannot be placed"):
        reconstruct_hands(scene.write_scene(tmp_path / "a", [truth], CAMERAS, keypoint))
    with pytest.raises(MissingInputError, match=r"'b': stage 1 lacks views: describe"):
        reconstruct_hands(scene.write_scene(tmp_path / "b", [truth], [], None))
    with pytest.raises(MissingInputError, match=r"'c': stage 1 lacks color or keypoint"):
        reconstruct_hands(scene.write_scene(tmp_path / "c", [truth], CAMERAS, None, depth=True))
    with pytest.raises(SettingsError, match="iterations is 0; expected a whole number from 1"):
        HandFitConfig(iterations=0)


@pytest.mark.parametrize(
    ("gauss_newton", "numbers", "total"), [(True, (1, 2), 40), (False, (10, 20), 100)]
)
def test_the_fit_reports_and_stops_when_asked(
    gauss_newton: bool, numbers: tuple[int, ...], total: int, tmp_path: Path
) -> None:
    truth = scene.grasping(frames=2)
    keypoint = scene.seen_keypoints([truth], CAMERAS)
    sequence = scene.write_scene(tmp_path / "a", [truth], CAMERAS, keypoint)
    seen: list[tuple] = []

    class Stop(Progress):
        def report(self, stage, iteration, total, loss=None, message=""):
            seen.append((stage, iteration, total, message))

        def check_cancelled(self):
            if len(seen) == 2:
                raise CancelledError("stop")

    threads = torch.get_num_threads()
    with pytest.raises(CancelledError):
        reconstruct_hands(
            sequence, HandFitConfig(gauss_newton=gauss_newton, iterations=100), Stop()
        )
    assert seen == [("hand_reconstruction", i, total, "Right hand") for i in numbers]
    assert torch.get_num_threads() == threads


@pytest.mark.slow
@pytest.mark.no_cover  # Made-up hands go through the same lines.
def test_the_recorded_hand_is_reconstructed(tmp_path: Path) -> None:
    whole = import_stereo(recording("stereo_hand"), tmp_path / "hand")
    assert (whole.frame_count, whole.frame_rate) == (378, 30.0)
    assert whole.views[0].color(100).shape == (720, 720, 3)
    left, right = (view.camera.T_world_camera for view in whole.views)
    assert min(left[2, 3], right[2, 3]) > 14
    stated = [0.29888, 0.83498, -0.46204]
    np.testing.assert_allclose((np.linalg.inv(right) @ left)[0, :3], stated, atol=0.02)
    # The first of its frames: to find keypoints in all of them takes longer than to fit them.
    sequence = Sequence(whole.folder, replace(whole.meta, frame_count=RECORDED))
    keypoint = detect_sequence(sequence)
    # A tenth of what was seen is kept from the fit, to score it.
    is_drawn = np.random.default_rng(0).random(keypoint.shape[:4]) < 0.1
    hidden = is_drawn & np.isfinite(keypoint).all(-1)
    given = np.where(hidden[..., None], np.nan, keypoint).astype(np.float32)
    fit = reconstruct_hands(sequence, keypoint=given)
    joint = fit.motions[0].keypoints(load_hand_model("right"))
    assert joint.shape == (RECORDED, 21, 3)
    assert np.isfinite(joint).all()
    cameras = [view.camera for view in sequence.views]
    (score,) = evaluate_hands(cameras, [joint], keypoint, hidden, least_views=2)
    assert score.frame_count >= RECORDED - 12  # It comes into view first.
    assert score.fitted.median <= 4
    assert score.hidden.median <= 6
    assert score.hidden.keypoint_count > 3.7 * score.frame_count
    assert max(score.joint_median) < 8


@pytest.mark.parametrize(
    ("config", "stops", "resumed"),
    [
        # A search is not stored; the fit to depth that follows is.
        (HandFitConfig(search_iterations=20, depth_iterations=4), (3,), 21),
        (HandFitConfig(starts_at_depth=False, iterations=12, depth_iterations=6), (3, 12, 3), 16),
        # Once before depth is seen, at the end of that, and between two looks for nearest vertices.
        (
            HandFitConfig(
                gauss_newton=False,
                iterations=20,
                depth_iterations=25,
                starts_at_depth=False,
                fixed_normals=False,
            ),
            (1, 2, 2),
            30,
        ),
    ],
    ids=["searched", "steps", "descent"],
)
def test_a_stopped_fit_goes_on_to_the_same_bits(
    config: HandFitConfig,
    stops: tuple[int, ...],
    resumed: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write_always(monkeypatch)
    truth = scene.grasping(frames=3)
    keypoint = scene.seen_keypoints([truth], CAMERAS[:1])
    sequence = scene.write_scene(tmp_path / "a", [truth], CAMERAS[:1], keypoint, depth=True)

    def fit(progress: Progress, checkpointer: Checkpointer | None) -> HandFit:
        return reconstruct_hands(sequence, config, progress, checkpointer=checkpointer)

    reports = check_resumed(fit, tmp_path / "ckpt", stops)
    assert reports[0][1] == resumed


def test_of_two_hands_the_first_is_not_fitted_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_always(monkeypatch)
    motions = [scene.grasping("right", frames=3), scene.grasping("left", frames=3)]
    keypoint = scene.seen_keypoints(motions, CAMERAS)
    sequence = scene.write_scene(tmp_path / "a", motions, CAMERAS, keypoint)

    def fit(progress: Progress, checkpointer: Checkpointer | None) -> HandFit:
        config = HandFitConfig(iterations=6, depth_iterations=0)
        return reconstruct_hands(sequence, config, progress, checkpointer=checkpointer)

    reports = check_resumed(fit, tmp_path / "ckpt", (3,))
    told = [report[1] for report in reports]
    # The first goes on after its third step, to its last one; then the second begins.
    assert told[:2] == [3, 4]
    assert told.count(6) == 2
    assert told[told.index(6) + 1] == 1
