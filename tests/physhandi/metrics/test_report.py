"""The report of a run on cases that were computed by hand."""

from pathlib import Path

import numpy as np
import pytest

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_schema import SequenceMeta, ViewMeta
from physhandi.data.sequence_writer import write_sequence
from physhandi.errors import RunError
from physhandi.metrics.report import METRICS, Reference, score_rollout, score_run

NODE = np.array([[0.0, 0, 0], [1.0, 0, 0]])
FRAMES = 4


def rising(speed: float) -> np.ndarray:
    """Nodes that rise by `speed` in each frame."""
    lift = np.arange(FRAMES)[:, None, None] * np.array([0.0, 0.0, speed])
    return NODE + lift


def make_reference() -> Reference:
    """The true motion rises by 0.1 a frame; its nodes are tracked."""
    truth = rising(0.1)
    return Reference(
        object_node=NODE,
        point=truth,
        is_visible=np.ones((FRAMES, 2), bool),
        marker=truth,
        marker_node=np.array([0, 1]),
        controlled_markers=(0,),
    )


def test_splits_and_baselines() -> None:
    control = np.array([[[5.0, 0, 0], [6.0, 0, 0], [5.0, 1, 0]]] * FRAMES)
    control += np.arange(FRAMES)[:, None, None] * np.array([0.0, 0.0, 0.1])
    report = score_rollout(
        rising(0.07),
        make_reference(),
        control=control,
        reconstruction_frames=range(3),
        future_frames=range(3, 4),
    )
    assert report["reconstruction"]["frames"] == [1, 3]
    assert report["future"]["frames"] == [3, 4]
    assert report["substituted_frames"] == 0
    for metric in METRICS:
        # Frames 1 and 2 lag by 0.03 and 0.06, frame 3 by 0.09; static lags by 0.1, 0.2, 0.3.
        assert report["reconstruction"]["rollout"][metric] == pytest.approx(0.045), metric
        assert report["future"]["rollout"][metric] == pytest.approx(0.09), metric
        assert report["reconstruction"]["static"][metric] == pytest.approx(0.15), metric
        assert report["future"]["static"][metric] == pytest.approx(0.3), metric
        assert report["future"]["rigid_follow"][metric] == pytest.approx(0.0, abs=1e-9), metric


def test_missing_output_counts_as_static() -> None:
    broken = rising(0.1)
    broken[2] = np.nan
    splits = {"reconstruction_frames": range(2), "future_frames": range(2, 4)}
    for rollout, substituted, expected in (
        (None, 4, 0.25),
        (broken, 1, 0.1),  # Frame 2 counts as static (0.2), frame 3 is right.
        (broken[:2], 2, 0.25),
    ):
        report = score_rollout(rollout, make_reference(), **splits)
        assert report["substituted_frames"] == substituted
        assert report["future"]["rollout"]["track_error"] == pytest.approx(expected)
        assert report["future"]["rollout"]["chamfer_l2"] == pytest.approx(expected)
    assert "rigid_follow" not in report["future"]


def test_dynamic_chamfer_leaves_out_points_at_rest() -> None:
    truth = rising(0.1)
    truth[:, 1] = NODE[1]
    reference = Reference(object_node=NODE, point=truth, is_visible=np.ones((FRAMES, 2), bool))
    report = score_rollout(None, reference, reconstruction_frames=range(FRAMES))
    scores = report["reconstruction"]["rollout"]
    assert scores["chamfer_l2"] == pytest.approx(0.1)
    assert scores["chamfer_dynamic_l2"] == pytest.approx(0.2)
    assert scores["marker_error"] is None
    assert "future" not in report


def test_nothing_dynamic_gives_no_figure() -> None:
    reference = Reference(
        object_node=NODE, point=rising(0.0), is_visible=np.ones((FRAMES, 2), bool)
    )
    report = score_rollout(None, reference, reconstruction_frames=range(FRAMES))
    assert report["reconstruction"]["rollout"]["chamfer_dynamic_l1"] is None
    assert report["reconstruction"]["rollout"]["track_error"] == 0.0


def make_sequence(folder: Path) -> Sequence:
    camera = PinholeCamera(np.diag([100.0, 100.0, 1.0]), np.eye(4), 64, 48)
    meta = SequenceMeta(
        name="rope",
        frame_rate=30.0,
        frame_count=FRAMES,
        hands=("right",),
        views=(ViewMeta(name="a", camera=camera),),
        reconstruction=3,
        controlled_markers=(0,),
    )
    arrays = {
        "marker.npy": rising(0.1),
        "marker_node.npy": np.array([0, 1]),
        "object_node.npy": NODE,
        "views/a/keypoint.npy": np.zeros((FRAMES, 1, 21, 3)),
    }
    return write_sequence(folder / "rope", meta, arrays)


def test_a_run_is_scored_from_its_files(tmp_path: Path) -> None:
    sequence = make_sequence(tmp_path)
    folder = tmp_path / "out" / "sequences" / "rope"
    (folder / "observation").mkdir(parents=True)
    np.save(folder / "rollout.npy", rising(0.07).astype(np.float32))
    np.save(folder / "control.npy", rising(0.1).astype(np.float32))
    wrong = rising(0.1).astype(np.float32)
    wrong[1:, 0] += 7  # The controlled marker must not count.
    np.save(folder / "observation/point.npy", wrong)
    np.save(folder / "observation/is_visible.npy", np.ones((FRAMES, 2), bool))
    np.save(folder / "observation/node_of_track.npy", np.array([0, 1]))
    joint = np.tile([0.03, 0.04, 1.0], (FRAMES, 21, 1))
    np.save(folder / "hand_right_keypoint.npy", joint)
    np.save(folder / "keypoint.npy", np.zeros((1, FRAMES, 1, 21, 3)))
    report = score_run(tmp_path / "out", sequence)
    assert report["reconstruction"]["rollout"]["marker_error"] == pytest.approx(0.045, rel=1e-5)
    assert report["reconstruction"]["rollout"]["track_error"] == pytest.approx(0.045, rel=1e-5)
    assert report["future"]["static"]["chamfer_l1"] == pytest.approx(0.3, rel=1e-5)
    assert report["future"]["rigid_follow"]["marker_error"] == pytest.approx(0.0, abs=1e-6)
    assert report["hands"]["right"]["reprojection_median"] == pytest.approx(5.0)
    (folder / "rollout.npy").write_bytes(b"torn")
    with pytest.raises(RunError, match=r"rollout\.npy is not a readable array"):
        score_run(tmp_path / "out", sequence)


def test_a_run_without_output_scores_as_static(tmp_path: Path) -> None:
    report = score_run(tmp_path / "out", make_sequence(tmp_path))
    assert report["substituted_frames"] == FRAMES
    assert report["future"]["rollout"]["marker_error"] == pytest.approx(0.3)
    assert "hands" not in report


def test_a_cloud_is_preferred_to_tracks(tmp_path: Path) -> None:
    sequence = make_sequence(tmp_path)
    folder = tmp_path / "out" / "sequences" / "rope" / "observation"
    folder.mkdir(parents=True)
    np.save(folder / "point.npy", rising(0.1))
    np.save(folder / "is_visible.npy", np.ones((FRAMES, 2), bool))
    np.save(folder / "cloud.npy", np.tile([[0.0, 0.0, 0.5]], (7, 1)))
    np.save(folder / "cloud_end.npy", np.array([1, 3, 5, 7]))
    report = score_run(tmp_path / "out", sequence)
    assert report["reconstruction"]["static"]["chamfer_l2"] == pytest.approx(0.5)
    assert report["reconstruction"]["static"]["track_error"] == pytest.approx(0.15)
