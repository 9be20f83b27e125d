"""Runs measured from their files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import SequenceMeta, ViewMeta
from physhandi.data.sequence_writer import write_sequence
from physhandi.errors import RunError
from physhandi.metrics.report import frame_errors, measure_run, score_run

NODE = np.array([[0.0, 0, 0], [1.0, 0, 0]])
FRAMES = 4


def rising(speed: float) -> np.ndarray:
    """Nodes that rise by `speed` in each frame."""
    return NODE + np.arange(FRAMES)[:, None, None] * np.array([0.0, 0.0, speed])


def make_sequence(folder: Path, **more: np.ndarray) -> Sequence:
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
    truth = {f"truth/{name}.npy": array for name, array in more.items()}
    return write_sequence(folder / "rope", meta, arrays | truth)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run's folder of the sequence, with a rollout that lags behind."""
    folder = tmp_path / "out" / "sequences" / "rope"
    (folder / "observation").mkdir(parents=True)
    np.save(folder / "rollout.npy", rising(0.07).astype(np.float32))
    np.save(folder / "control.npy", rising(0.1).astype(np.float32))
    wrong = rising(0.1).astype(np.float32)
    wrong[1:, 0] += 7  # The controlled marker must not count.
    np.save(folder / "observation/point.npy", wrong)
    np.save(folder / "observation/is_visible.npy", np.ones((FRAMES, 2), bool))
    np.save(folder / "observation/node_of_track.npy", np.array([0, 1]))
    return folder


def test_a_run_is_scored_from_its_files(tmp_path: Path, folder: Path) -> None:
    sequence = make_sequence(tmp_path)
    report = score_run(tmp_path / "out", sequence)
    assert report["reconstruction"]["rollout"]["marker_error"] == pytest.approx(0.045, rel=1e-5)
    assert report["reconstruction"]["rollout"]["track_error"] == pytest.approx(0.045, rel=1e-5)
    assert report["future"]["static"]["chamfer_l1"] == pytest.approx(0.3, rel=1e-5)
    assert report["future"]["rigid_follow"]["marker_error"] == pytest.approx(0.0, abs=1e-6)
    assert "hands" not in report
    assert "topology" not in report
    (folder / "rollout.npy").write_bytes(b"torn")
    with pytest.raises(RunError, match=r"rollout\.npy is not a readable array"):
        score_run(tmp_path / "out", sequence)


def test_the_true_surface_is_read_and_scored_in_its_own_frames(
    tmp_path: Path, folder: Path
) -> None:
    # Specks of surface at both nodes rise by 0.1 a frame, observations do not rise at all.
    speck = np.array([[0.0, 0, 0], [1e-5, 0, 0], [0, 1e-5, 0]])
    np.save(folder / "observation/point.npy", rising(0.0))
    sequence = make_sequence(
        tmp_path,
        object_point=(rising(0.1)[:, :, None] + speck).reshape(FRAMES, 6, 3).astype(np.float32),
        object_face=np.arange(6).reshape(2, 3),
    )
    report, frames = measure_run(tmp_path / "out", sequence)
    for metric in ("chamfer_truth", "chamfer_truth_to_nodes", "chamfer_nodes_to_truth"):
        assert frames["rollout"][metric] == pytest.approx([0.0, 0.03, 0.06, 0.09], abs=2e-5)
        assert report["reconstruction"]["rollout"][metric] == pytest.approx(0.045, abs=2e-5)
        assert report["future"]["static"][metric] == pytest.approx(0.3, abs=2e-5)
        assert report["future"]["rigid_follow"][metric] == pytest.approx(0.0, abs=2e-5)
    assert report["future"]["rollout"]["chamfer_l2"] == pytest.approx(0.21)


def test_errors_of_every_frame(tmp_path: Path, folder: Path) -> None:
    sequence = make_sequence(tmp_path)
    errors = frame_errors(tmp_path / "out", sequence)
    assert (errors["unit"], errors["frames"]) == ("m", [0, 1, 2, 3])
    assert errors["rollout"]["track_error"] == pytest.approx([0.0, 0.03, 0.06, 0.09], abs=2e-7)
    assert errors["static"]["chamfer_l2"] == pytest.approx([0.0, 0.1, 0.2, 0.3], abs=2e-7)
    assert errors["rigid_follow"]["marker_error"] == pytest.approx([0.0] * 4, abs=2e-7)
    report = score_run(tmp_path / "out", sequence)
    for metric, curve in errors["rollout"].items():
        assert report["reconstruction"]["rollout"][metric] == pytest.approx(np.mean(curve[1:3]))
    visible = np.ones((FRAMES, 2), bool)
    visible[2] = False
    np.save(folder / "observation/is_visible.npy", visible)
    hidden = frame_errors(tmp_path / "out", sequence)["rollout"]
    assert hidden["track_error"][2] is None
    assert hidden["track_error_phystwin"][2] == 0.0
    assert measure_run(tmp_path / "out", sequence)[1]["rollout"] == hidden


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
    assert report["reconstruction"]["static"]["chamfer_phystwin"] == pytest.approx(0.15)
    assert report["reconstruction"]["static"]["track_error"] == pytest.approx(0.15)


def test_hands_are_compared_with_keypoints_points_and_truth(tmp_path: Path, folder: Path) -> None:
    joint = np.tile([0.03, 0.04, 1.0], (FRAMES, 21, 1))
    joint[..., 2] += np.linspace(0.0, 0.02, 21)
    vertex = joint[:, :5] + np.array([0.0, 0.0, 0.1])
    truth = {
        "hand_right_keypoint": joint + np.array([0.0, 0.006, 0.008]),
        "hand_right_vertex": vertex[:, :3],
    }
    sequence = make_sequence(tmp_path, **truth)
    np.save(folder / "hand_right_keypoint.npy", joint)
    np.save(folder / "hand_right_vertex.npy", vertex)
    seen = np.zeros((1, FRAMES, 1, 21, 3))
    seen[..., :2] = 100 * joint[None, :, None, :, :2] / joint[None, :, None, :, 2:]
    seen[..., :2] += [6.0, 8.0]
    seen[0, 0, 0, :11] = np.nan
    seen[0, 0, 0, 11:, :2] += [3.0, 4.0]  # 15 px off in 10 of 73 keypoints.
    np.save(folder / "keypoint.npy", seen)
    np.save(folder / "observation/hand_point.npy", vertex[:3, 0] + np.array([0.0, 0.03, 0.04]))
    np.save(folder / "observation/hand_point_end.npy", np.array([[1, 2, 2, 3]]))
    report, frames = measure_run(tmp_path / "out", sequence)
    right = report["hands"]["right"]
    assert right["reprojection_median"] == pytest.approx(10.0)
    assert right["reprojection_mean"] == pytest.approx(10.0 + 5.0 * 10 / 73)
    assert (right["scored_keypoints"], right["scored_frames"]) == (73, 4)
    assert right["mpjpe"] == pytest.approx(0.010)
    assert right["mpjpe_wrist"] == pytest.approx(0.0, abs=1e-9)
    assert "mpvpe" not in right  # The true mesh has other vertices.
    assert 0 < right["surface_error"] < 0.002
    assert right["chamfer_points_to_mesh"] == pytest.approx(
        np.linalg.norm(
            vertex[0, :, None] - (vertex[0, 0] + np.array([0.0, 0.03, 0.04])), axis=-1
        ).min()
    )
    curve = frames["hands"]["right"]["chamfer_points_to_mesh"]
    assert [value is None for value in curve] == [False, False, True, False]
    assert report["hands"]["right"]["substituted_frames"] == 0

    assert report["unit"] == right["unit"] == frames["unit"] == "m"
    squares = replace(sequence.meta, metric=False, length_unit="board square")
    report, frames = measure_run(tmp_path / "out", Sequence(sequence.folder, squares))
    assert report["hands"]["right"] == right | {"unit": "board square"}
    assert report["unit"] == frames["unit"] == "board square"


def test_a_hand_that_was_not_fitted_is_listed_without_figures(tmp_path: Path, folder: Path) -> None:
    truth = np.ones((FRAMES, 21, 3))
    sequence = make_sequence(tmp_path, hand_right_keypoint=truth)
    right = score_run(tmp_path / "out", sequence)["hands"]["right"]
    assert right["substituted_frames"] == FRAMES
    assert right["mpjpe"] is None
    lost = np.full_like(truth, np.nan)
    np.save(folder / "hand_right_keypoint.npy", lost)
    np.save(folder / "hand_right_vertex.npy", lost)
    save_model(folder, [[0, 2]])
    report = score_run(tmp_path / "out", sequence)
    assert report["hands"]["right"] == right
    assert "contact" not in report
    gap = truth.copy()
    gap[1] = np.nan
    gap[2:] += [0.0, 0.0, 0.05]
    np.save(folder / "hand_right_keypoint.npy", gap)
    right = score_run(tmp_path / "out", sequence)["hands"]["right"]
    assert right["substituted_frames"] == 1
    assert right["mpjpe"] == pytest.approx(0.025)


def save_model(folder: Path, virtual: list[list[int]]) -> None:
    springs = np.array([[0, 1], *virtual], dtype=np.int32)
    tensors = {"spring_nodes": springs, "object_spring_count": np.array([1], dtype=np.int32)}
    save_file(tensors, folder / "model.safetensors")


def test_contact_and_topology_come_from_the_fitted_model(tmp_path: Path, folder: Path) -> None:
    contact = np.array([[True, False]] * 3 + [[False, False]])
    sequence = make_sequence(tmp_path, contact_point=NODE[::-1] * 0.9, contact=contact)
    save_model(folder, [[0, 2], [1, 3]])
    np.save(folder / "hand_right_vertex.npy", rising(0.07)[:, 1:] + np.array([0.0, 0.004, 0.0]))
    parameters = tmp_path / "out" / "object" / "parameters.yaml"
    parameters.parent.mkdir()
    parameters.write_text("connection_radius: 4.5\nvirtual_connection_radius: 1.5\n")
    report = score_run(tmp_path / "out", sequence)
    # Both nodes are joined, and node 1 stays at the hand. The truth calls node 1 touched, as it
    # lists its places the other way round, but not in frame 3.
    assert report["contact"]["labels"] == "true"
    assert report["contact"]["frame_0"]["accuracy_5mm"] == 0.5
    assert report["contact"]["reconstruction"]["accuracy_5mm"] == 1.0
    assert report["future"]["rollout"]["contact_accuracy_5mm"] == 0.5
    topology = report["topology"]
    assert topology["resolution"] == pytest.approx(1.0)
    assert topology["rrd_object"] == pytest.approx(0.5)
    assert topology["rrd_virtual"] == pytest.approx(0.5)
    parameters.write_text("connection_radius: wide\n")
    with pytest.raises(RunError, match=r"parameters\.yaml does not tell the connection radii"):
        score_run(tmp_path / "out", sequence)
    (folder / "model.safetensors").write_bytes(b"torn")
    with pytest.raises(RunError, match=r"model\.safetensors is not a readable model"):
        score_run(tmp_path / "out", sequence)


def test_true_contact_and_true_proximity_are_told_apart(tmp_path: Path, folder: Path) -> None:
    # The engine calls node 1 touched in frames 0 and 1. The true hand is 4 mm from the true surface
    # at node 0 in frame 1, 8 mm in frame 2, and far away else. Springs join node 0 to a fitted hand
    # that stays at it.
    contact = np.array([[False, True]] * 2 + [[False, False]] * 2)
    speck = np.array([[0.0, 0, 0], [1e-5, 0, 0], [0, 1e-5, 0]])
    corner = (rising(0.1)[:, :, None] + speck).reshape(FRAMES, 6, 3)
    hand = np.array([0.0, 0.0, 5.0]) + 0 * rising(0.1)[:, :1]
    hand[1:3, 0, 2] = [0.104, 0.208]
    np.save(folder / "rollout.npy", rising(0.1))
    np.save(folder / "hand_right_vertex.npy", rising(0.1)[:, :1] + np.array([0.0, 0.0, 0.004]))
    save_model(folder, [[0, 2]])
    sequence = make_sequence(
        tmp_path,
        contact_point=corner[0],
        contact=np.repeat(contact, 3, axis=1),
        hand_right_vertex=hand,
        object_point=corner,
        object_face=np.arange(6).reshape(2, 3),
    )
    report = score_run(tmp_path / "out", sequence)
    scores = report["reconstruction"]["rollout"]  # Frames 1 and 2.
    assert scores["contact_accuracy_5mm"] == scores["contact_accuracy_10mm"] == 0.25
    assert scores["contact_f1_5mm"] == 0.0
    assert scores["contact_accuracy_proximity_5mm"] == 0.75
    assert scores["contact_accuracy_proximity_10mm"] == 1.0
    assert scores["contact_f1_proximity_5mm"] == pytest.approx(2 / 3)
    assert report["future"]["rollout"]["contact_accuracy_proximity_10mm"] == 0.5
    assert report["future"]["static"]["contact_accuracy_proximity_10mm"] == 1.0
    assert report["contact"]["reconstruction"]["label_share_proximity_5mm"] == 0.25
    assert report["contact"]["frame_0"]["accuracy_5mm"] == 0.0


def test_without_truth_contact_is_what_is_near_the_hand(tmp_path: Path, folder: Path) -> None:
    sequence = make_sequence(tmp_path)
    save_model(folder, [[0, 2]])
    np.save(
        folder / "hand_right_vertex.npy",
        np.tile(NODE[1:] + np.array([0.0, 0, 0.008]), (FRAMES, 1, 1)),
    )
    report = score_run(tmp_path / "out", sequence)
    contact = report["contact"]
    assert contact["labels"] == "proximity"
    assert report["future"]["rollout"]["contact_accuracy_proximity_5mm"] is None
    assert contact["frame_0"]["accuracy_5mm"] == 0.5  # Node 0 is held, and nothing is near.
    assert contact["frame_0"]["accuracy_10mm"] == 0.0  # Node 0 is held, and node 1 is near.
