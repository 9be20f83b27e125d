"""Contacts counted by hand, and against plain loops."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from physhandi.data.truth import Truth
from physhandi.metrics.contact import (
    THRESHOLDS,
    ContactLabels,
    ContactReference,
    agreement,
    contact_scores,
    hand_distance,
    joined_nodes,
    predicted_contacts,
    proximity_labels,
    true_labels,
    true_proximity_labels,
)

NODE = np.array([[0.0, 0, 0], [0.02, 0, 0], [0.04, 0, 0], [0.06, 0, 0], [0.05, 0.02, 0]])


def labels(is_contact: list[list[int]], is_known: list[list[int]] | None = None) -> ContactLabels:
    contact = np.array(is_contact, dtype=bool)
    known = np.ones_like(contact) if is_known is None else np.array(is_known, dtype=bool)
    return ContactLabels(is_contact=contact, is_known=known)


def test_nodes_with_a_virtual_spring_are_joined() -> None:
    springs = np.array([[0, 5], [3, 5], [7, 3]])  # Nodes from 5 on are control nodes.
    assert joined_nodes(springs, 5).tolist() == [[True, False, False, True, False]]
    assert not joined_nodes(np.zeros((0, 2), int), 5).any()


def test_scores_counted_by_hand() -> None:
    predicted = np.array([[1, 1, 0, 0], [1, 0, 0, 0]], dtype=bool)
    truth = labels([[1, 0, 0, 1], [1, 0, 1, 0]], [[1, 1, 1, 1], [1, 1, 1, 0]])
    # Frame 0: right are nodes 0 and 2, 2 of 4. Frame 1: right are 0 and 1, 2 of 3 known.
    assert agreement(predicted, truth).tolist() == pytest.approx([0.5, 2 / 3])
    assert contact_scores(predicted, truth, "5mm") == pytest.approx(
        {
            "accuracy_5mm": (0.5 + 2 / 3) / 2,
            "precision_5mm": 2 / 3,  # Predicted: two in frame 0, one in frame 1; two are right.
            "recall_5mm": 2 / 4,
            "f1_5mm": 2 * (2 / 3) * 0.5 / (2 / 3 + 0.5),
            "predicted_share_5mm": 3 / 7,
            "label_share_5mm": 4 / 7,
            "known_share_5mm": 7 / 8,
        }
    )


def test_scores_agree_with_plain_loops() -> None:
    rng = np.random.default_rng(4)
    predicted, contact, known = rng.random((3, 6, 30)) < np.array([0.3, 0.4, 0.8])[:, None, None]
    scores = contact_scores(predicted, ContactLabels(is_contact=contact, is_known=known), "x")
    right, count = [], {"tp": 0, "fp": 0, "fn": 0}
    for frame in range(6):
        told = [
            (bool(predicted[frame, n]), bool(contact[frame, n]))
            for n in range(30)
            if known[frame, n]
        ]
        right.append(sum(p == c for p, c in told) / len(told))
        count["tp"] += told.count((True, True))
        count["fp"] += told.count((True, False))
        count["fn"] += told.count((False, True))
    assert scores["accuracy_x"] == pytest.approx(np.mean(right))
    assert scores["precision_x"] == pytest.approx(count["tp"] / (count["tp"] + count["fp"]))
    assert scores["recall_x"] == pytest.approx(count["tp"] / (count["tp"] + count["fn"]))
    shifted = ContactLabels(
        is_contact=np.roll(contact, 1, axis=0), is_known=np.roll(known, 1, axis=0)
    )
    assert contact_scores(predicted, shifted, "x") != scores


def test_nothing_to_divide_by_gives_no_figure() -> None:
    nobody = labels([[0, 0]])
    scores = contact_scores(np.zeros((1, 2), bool), nobody, "5mm")
    assert scores["accuracy_5mm"] == 1.0  # Agreement is cheap where nothing touches.
    assert scores["precision_5mm"] is scores["recall_5mm"] is scores["f1_5mm"] is None
    unknown = contact_scores(np.zeros((1, 2), bool), labels([[1, 1]], [[0, 0]]), "5mm")
    assert unknown["accuracy_5mm"] is None
    assert unknown["known_share_5mm"] == 0.0


def test_distance_to_the_hand_is_that_of_the_same_frame() -> None:
    rng = np.random.default_rng(1)
    node, hand = rng.normal(size=(3, 8, 3)), rng.normal(size=(3, 12, 3))
    expected = [cdist(node[f], hand[f]).min(axis=1) for f in range(3)]
    assert hand_distance(node, hand) == pytest.approx(np.array(expected))


def test_springs_predict_in_frame_0_and_proximity_afterwards() -> None:
    hand = np.zeros((3, 1, 3))
    hand[:, 0, 0] = [0.5, 0.0, 0.02]  # Far away at first, then at node 0, then at node 1.
    reference = ContactReference(
        hand=hand,
        is_joined=np.array([[True, True, False, False, False]]),
        kind="true",
        labels={},
    )
    distance = hand_distance(np.stack([NODE] * 3), reference.hand)
    predicted = predicted_contacts(reference, distance, 0.005)
    assert predicted.astype(int).tolist() == [[1, 1, 0, 0, 0], [1, 0, 0, 0, 0], [0, 1, 0, 0, 0]]
    assert predicted_contacts(reference, distance, 0.021)[1].sum() == 2


def test_true_contact_goes_to_the_nearest_node() -> None:
    truth = Truth(
        hand_keypoint={},
        hand_vertex={},
        contact_point=np.array([[0.001, 0, 0], [0.055, 0.0, 0.0]]),
        contact=np.array([[True, False], [False, True]]),
    )
    found = true_labels(truth, NODE)
    assert found is not None
    assert found.is_contact.astype(int).tolist() == [[1, 1, 0, 0, 0], [0, 0, 1, 1, 1]]
    assert found.is_known.all()
    assert true_labels(Truth(hand_keypoint={}, hand_vertex={}), NODE) is None


def rising_sheet() -> tuple[Truth, np.ndarray]:
    """A square sheet, 0.1 wide, that rises by 0.1 a frame, and a hand over one of its places.

    In frame 1 the hand is 4 mm above the place (0.03, 0.02), in frame 2 8 mm, else far away.
    """
    corner = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])
    rise = np.arange(4)[:, None, None] * np.array([0.0, 0.0, 0.1])
    hand = np.array([0.03, 0.02, 0.0]) + rise + np.array([0.0, 0.0, 0.5])
    hand[1:3, 0, 2] = [0.104, 0.208]
    truth = Truth(
        hand_keypoint={},
        hand_vertex={"right": hand},
        object_point=corner + rise,
        object_face=np.array([[0, 1, 2], [0, 2, 3]]),
    )
    return truth, np.array([[0.03, 0.02, 0.003], [0.07, 0.02, 0.003], [0.04, 0.02, -0.003]])


def test_true_proximity_is_that_of_true_surface_and_true_hand() -> None:
    truth, node = rising_sheet()
    found = true_proximity_labels(truth, node, ("right",))
    # Node 0 lies 3 mm above its place, which counts; node 2 is 10.8 mm away in frame 1.
    assert found["5mm"].is_contact.astype(int).tolist() == [[0] * 3, [1, 0, 0], [0] * 3, [0] * 3]
    assert found["10mm"].is_contact.astype(int).tolist() == [
        [0] * 3,
        [1, 0, 0],
        [1, 0, 0],
        [0] * 3,
    ]
    assert found["5mm"].is_known.all()
    nearer = np.array([[0.036, 0.02, 0.0], [0.0415, 0.02, 0.0]])  # 7.2 and 12.2 mm in frame 1.
    by_node = true_proximity_labels(truth, nearer, ("right",))
    assert by_node["5mm"].is_contact.sum() == 0
    assert by_node["10mm"].is_contact[1].tolist() == [True, False]


def test_true_proximity_needs_the_surface_and_every_hand() -> None:
    truth, node = rising_sheet()
    assert true_proximity_labels(truth, node, ("right", "left")) == {}
    assert true_proximity_labels(truth, node, ()) == {}
    unknown = Truth(hand_keypoint={}, hand_vertex=truth.hand_vertex)
    assert true_proximity_labels(unknown, node, ("right",)) == {}


def test_proximity_is_that_of_what_was_observed() -> None:
    # The tracks lie around nodes 2 to 4 and rise by 0.1; the hand waits there in frame 1.
    track = NODE[[2, 3, 4]][None] + np.arange(3)[:, None, None] * np.array([0.0, 0.0, 0.1])
    is_visible = np.ones((3, 3), bool)
    is_visible[2, 0] = False
    hand = np.array([[[0.008, 0, 0]], [[0.04, 0, 0.104]], [[0.04, 0, 0.204]]])
    found = proximity_labels(NODE, hand, track, is_visible)
    near5, near10 = found["5mm"], found["10mm"]
    assert near5.is_known.astype(int).tolist() == [
        [1, 1, 1, 1, 1],
        [0, 0, 1, 1, 1],  # Nodes 0 and 1 have not three tracks within reach.
        [0, 0, 0, 0, 0],
    ]
    assert near5.is_contact.astype(int).tolist() == [[0] * 5, [0, 0, 1, 0, 0], [0] * 5]
    assert near10.is_contact.astype(int).tolist() == [[1, 0, 0, 0, 0], [0, 0, 1, 0, 0], [0] * 5]


def test_without_tracks_only_frame_0_has_proximity_labels() -> None:
    hand = np.repeat(NODE[None, :1] + 0.001, 2, axis=0)
    found = proximity_labels(NODE, hand, None, None)
    assert set(found) == set(THRESHOLDS)
    assert found["5mm"].is_contact.astype(int).tolist() == [[1, 0, 0, 0, 0], [0] * 5]
    assert found["5mm"].is_known.all(axis=1).tolist() == [True, False]
