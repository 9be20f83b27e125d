"""The report of a rollout on cases that were computed by hand."""

import numpy as np
import pytest

from physhandi.data.truth import Truth
from physhandi.metrics.contact import THRESHOLDS, ContactLabels, ContactReference
from physhandi.metrics.report import (
    CONTACT_METRICS,
    CURVES,
    METRICS,
    ScoringReference,
    error_curves,
    score_rollout,
)
from physhandi.metrics.truth_metrics import true_surface

NODE = np.array([[0.0, 0, 0], [1.0, 0, 0]])
FRAMES = 4


def rising(speed: float, frames: int = FRAMES) -> np.ndarray:
    """Nodes that rise by `speed` in each frame."""
    return NODE + np.arange(frames)[:, None, None] * np.array([0.0, 0.0, speed])


def touched() -> ContactReference:
    """A hand that touches node 0 in frames 0 to 2, while a spring holds it in all."""
    is_contact = np.array([[1, 0], [1, 0], [1, 0], [0, 0]], dtype=bool)
    label = ContactLabels(is_contact=is_contact, is_known=np.ones_like(is_contact))
    hand = rising(0.1)[:, :1] + np.array([0.0, 0.0, 0.004])
    return ContactReference(
        hand=hand,
        is_joined=np.array([[True, False]]),
        kind="true",
        labels=dict.fromkeys(THRESHOLDS, label),
    )


def make_reference() -> ScoringReference:
    """The true motion rises by 0.1 a frame; its nodes are tracked, and its surface is known."""
    truth = rising(0.1)
    speck = np.array([[0.0, 0, 0], [1e-10, 0, 0], [0, 1e-10, 0]])
    surface = true_surface(
        Truth(
            hand_keypoint={},
            hand_vertex={},
            object_point=(truth[:, :, None] + speck).reshape(FRAMES, 6, 3),
            object_face=np.arange(6).reshape(2, 3),
        )
    )
    return ScoringReference(
        object_node=NODE,
        point=truth,
        is_visible=np.ones((FRAMES, 2), bool),
        marker=truth,
        marker_node=np.array([0, 1]),
        controlled_markers=(0,),
        true_surface=surface,
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
    assert tuple(report["future"]["rollout"]) == METRICS
    for metric in CURVES:
        # Frames 1 and 2 lag by 0.03 and 0.06, frame 3 by 0.09; static lags by 0.1, 0.2, 0.3.
        assert report["reconstruction"]["rollout"][metric] == pytest.approx(0.045), metric
        assert report["future"]["rollout"][metric] == pytest.approx(0.09), metric
        assert report["reconstruction"]["static"][metric] == pytest.approx(0.15), metric
        assert report["future"]["static"][metric] == pytest.approx(0.3), metric
        assert report["future"]["rigid_follow"][metric] == pytest.approx(0.0, abs=1e-9), metric
    for metric in CONTACT_METRICS:
        assert report["reconstruction"]["rollout"][metric] is None
    assert "contact" not in report


def test_a_motion_one_frame_late_costs_one_frame() -> None:
    late = rising(0.1)[[0, 0, 1, 2]]
    splits = {"reconstruction_frames": range(3), "future_frames": range(3, 4)}
    report = score_rollout(late, make_reference(), **splits)
    for metric in CURVES:
        assert report["reconstruction"]["rollout"][metric] == pytest.approx(0.1), metric
        assert report["future"]["rollout"][metric] == pytest.approx(0.1), metric


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
    reference = ScoringReference(
        object_node=NODE, point=truth, is_visible=np.ones((FRAMES, 2), bool)
    )
    report = score_rollout(None, reference, reconstruction_frames=range(FRAMES))
    scores = report["reconstruction"]["rollout"]
    assert scores["chamfer_l2"] == pytest.approx(0.1)
    assert scores["chamfer_dynamic_l2"] == pytest.approx(0.2)
    assert scores["chamfer_dynamic_symmetric"] == pytest.approx(0.2)
    assert scores["chamfer_symmetric"] == pytest.approx(0.1)
    assert scores["marker_error"] is None
    assert "future" not in report


def test_nothing_dynamic_gives_no_figure() -> None:
    reference = ScoringReference(
        object_node=NODE, point=rising(0.0), is_visible=np.ones((FRAMES, 2), bool)
    )
    report = score_rollout(None, reference, reconstruction_frames=range(FRAMES))
    assert report["reconstruction"]["rollout"]["chamfer_dynamic_l1"] is None
    assert report["reconstruction"]["rollout"]["chamfer_dynamic_symmetric"] is None
    assert report["reconstruction"]["rollout"]["track_error"] == 0.0


def test_the_two_kinds_of_chamfer_see_different_points_in_different_norms() -> None:
    visible = np.ones((2, 2), bool)
    cloud = (NODE, np.array([[0.0, 0.3, 0.4], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))
    point = np.stack([NODE, NODE + np.array([0.0, 0.6, 0.8])])
    reference = ScoringReference(object_node=NODE, point=point, is_visible=visible, cloud=cloud)
    curves = error_curves(np.stack([NODE, NODE]), reference)
    assert curves["chamfer_phystwin"][1] == pytest.approx(1.4)  # Tracks, |dx| + |dy| + |dz|.
    assert curves["chamfer_l1"][1] == pytest.approx((0.7 + 0 + 1) / 3)
    assert curves["chamfer_l2"][1] == pytest.approx((0.5 + 0 + 1) / 3)
    assert curves["chamfer_symmetric"][1] == pytest.approx(((0.5 + 0 + 1) / 3 + 0.5 / 2) / 2)


def test_inner_nodes_do_not_help_a_surface_but_may_hold_a_track() -> None:
    node = np.array([[0.0, 0, 0], [0.0, 0, 0.5]])
    point = np.array([[[0.0, 0, 0.45]], [[0.0, 0, 0.45]]])
    reference = ScoringReference(
        object_node=node, surface_count=1, point=point, is_visible=np.ones((2, 1), bool)
    )
    curves = error_curves(np.stack([node, node]), reference)
    for metric in ("chamfer_phystwin", "chamfer_l1", "chamfer_l2", "chamfer_symmetric"):
        assert curves[metric][1] == pytest.approx(0.45), metric
    assert curves["track_error_phystwin"][1] == pytest.approx(0.05)
    assert curves["track_error"][1] == pytest.approx(0.0, abs=1e-12)


def test_tracks_are_known_by_their_node_or_carried_by_those_around() -> None:
    rollout = rising(0.07)
    point = rising(0.1) + np.array([0.0, 0.5, 0.0])
    visible = np.ones((FRAMES, 2), bool)
    visible[0, 1] = False  # Nobody knows where on the object this one is.
    visible[3] = False
    point[:, 1] += 5.0
    plain = ScoringReference(object_node=NODE, point=point, is_visible=visible)
    carried = error_curves(rollout, plain)
    assert carried["track_error"][:3] == pytest.approx([0.0, 0.03, 0.06], abs=1e-12)
    assert np.isnan(carried["track_error"][3])
    assert carried["track_error_phystwin"][1] == pytest.approx(np.hypot(0.5, 0.03))
    assert carried["track_error_phystwin"][3] == 0.0
    named = ScoringReference(
        object_node=NODE, point=point, is_visible=visible, node_of_track=np.array([1, 1])
    )
    gaps = np.linalg.norm(point[1] - rollout[1, 1], axis=1)
    assert error_curves(rollout, named)["track_error"][1] == pytest.approx(gaps.mean())


def test_annotated_points_replace_tracks_where_tracks_are_scored() -> None:
    annotated = rising(0.2)
    annotated[2, 0] = np.nan
    reference = ScoringReference(
        object_node=NODE,
        point=rising(0.1),
        is_visible=np.ones((FRAMES, 2), bool),
        validation=annotated,
    )
    curves = error_curves(rising(0.1), reference)
    assert curves["track_error"] == pytest.approx([0.0, 0.1, 0.2, 0.3], abs=1e-12)
    assert curves["track_error_phystwin"] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert curves["chamfer_phystwin"] == pytest.approx(0.0)


def test_contact_is_scored_for_every_method() -> None:
    reference = ScoringReference(
        object_node=NODE,
        point=rising(0.1),
        is_visible=np.ones((FRAMES, 2), bool),
        contact=touched(),
    )
    splits = {"reconstruction_frames": range(3), "future_frames": range(3, 4)}
    report = score_rollout(rising(0.1), reference, **splits)
    # The rollout stays at the hand, so it is right while the hand touches, wrong in frame 3.
    assert report["reconstruction"]["rollout"]["contact_accuracy_5mm"] == 1.0
    assert report["reconstruction"]["rollout"]["contact_f1_5mm"] == 1.0
    assert report["future"]["rollout"]["contact_accuracy_5mm"] == 0.5
    assert report["reconstruction"]["static"]["contact_accuracy_10mm"] == 0.5
    assert report["reconstruction"]["static"]["contact_f1_10mm"] == 0.0
    assert report["future"]["static"]["contact_accuracy_5mm"] == 1.0
    contact = report["contact"]
    assert contact["labels"] == "true"
    assert contact["frame_0"]["recall_5mm"] == contact["frame_0"]["precision_5mm"] == 1.0
    assert contact["reconstruction"]["label_share_5mm"] == 0.5
    assert contact["future"]["precision_5mm"] == 0.0
    assert contact["future"]["recall_5mm"] is None
    # Only 4 mm lie between hand and node; one frame late, 100 mm do.
    late = score_rollout(rising(0.1)[[0, 0, 1, 2]], reference, **splits)
    assert late["reconstruction"]["rollout"]["contact_f1_5mm"] == 0.0
