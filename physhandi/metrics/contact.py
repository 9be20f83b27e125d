"""Contact scores: nodes that the virtual springs predict to touch a hand, against labels.

The paper's contact accuracy (appendix, contact consistency) is the share of nodes on which
prediction and label agree. As most nodes touch nothing, high accuracy is easy; precision, recall,
F1 and both shares of touching nodes are given too.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from physhandi.data.sequence_meta import Side
from physhandi.data.truth import Truth
from physhandi.metrics.alignment import REACH, carried_points
from physhandi.metrics.geometry import nearest_distance, nearest_node
from physhandi.metrics.truth_metrics import true_surface

THRESHOLDS = {"5mm": 0.005, "10mm": 0.010}
"""Nodes nearer to a hand than this count as touched [m]."""

_PLACES = 20_000
"""Samples of the true surface among which each node's own is searched; on table-top objects they
are 1 to 2 mm apart."""

LabelKind = Literal["true", "proximity"]


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactLabels:
    """Contact labels for one threshold."""

    is_contact: Bool[ndarray, "frame node"]
    """Whether a hand touches the node."""
    is_known: Bool[ndarray, "frame node"]
    """Whether the label is known; other nodes are not scored."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactReference:
    """Hands, springs and labels that contacts are scored by."""

    hand: Float[ndarray, "frame point 3"]
    """Vertices of all hands [m]."""
    is_joined: Bool[ndarray, "#frame node"]
    """Whether a virtual spring ends at the node; in all frames, or in each."""
    kind: LabelKind
    """True contact of the sequence, or proximity of what was observed to the fitted hands."""
    labels: dict[str, ContactLabels]
    """Labels of each threshold; the same for all of them if contact is the true one."""
    true_proximity: dict[str, ContactLabels] = field(default_factory=dict[str, ContactLabels])
    """Labels of each threshold by the distance of true surface and true hands; empty if unknown."""


def joined_nodes(
    virtual_spring_nodes: Int[ndarray, "spring 2"],
    node_count: int,
    attached: Int[ndarray, "spring 2"] | None = None,
    frame_count: int = 1,
) -> Bool[ndarray, "frame node"]:
    """Mark the object nodes at which at least one virtual spring ends.

    Args:
        virtual_spring_nodes: The two nodes of each spring.
        node_count: Number of object nodes.
        attached: First and last frame in which each spring is attached; all frames if left out.
        frame_count: Frames; one stands for all if springs are always attached.
    """
    node = virtual_spring_nodes.min(axis=1, initial=node_count)
    first, last = np.array([[0, frame_count]]).T if attached is None else attached.T
    frame = np.arange(frame_count)[:, None]
    acts = np.broadcast_to((first <= frame) & (frame <= last), (frame_count, len(node)))
    is_joined = np.zeros((frame_count, node_count), dtype=bool)
    at_frame, spring = np.nonzero(acts)
    is_joined[at_frame, node[spring]] = True
    return is_joined


def hand_distance(
    node: Float[ndarray, "frame node 3"], hand: Float[ndarray, "frame point 3"]
) -> Float[ndarray, "frame node"]:
    """Measure how far each node is from the nearest hand point of its frame [m]."""
    return np.stack(
        [nearest_distance(nodes, points) for nodes, points in zip(node, hand, strict=True)]
    )


def true_labels(truth: Truth, node: Float[ndarray, "node 3"]) -> ContactLabels | None:
    """Take each node's label from the nearest true point of frame 0; None without truth."""
    if truth.contact_point is None or truth.contact is None or not len(truth.contact_point):
        return None
    nearest = nearest_node(node.astype(np.float64), truth.contact_point.astype(np.float64))
    is_contact = truth.contact[:, nearest]
    return ContactLabels(is_contact=is_contact, is_known=np.ones_like(is_contact))


def true_proximity_labels(
    truth: Truth, node: Float[ndarray, "node 3"], sides: Iterable[Side]
) -> dict[str, ContactLabels]:
    """Label nodes as touched if their point of the true surface is near a true hand.

    This is the paper's label, computed from the truth alone. A node's point of the true surface is
    the one nearest to it in frame 0.

    Args:
        truth: The truth of a recording.
        node: Nodes in frame 0 [m].
        sides: Hands that the recording shows; all of them must be known.

    Returns:
        Labels of each of `THRESHOLDS`; empty if surface or hands are not known.

    Raises:
        SequenceError: If the true surface is invalid.
    """
    hands = [truth.hand_vertex.get(side) for side in sides]
    known_hands = [hand for hand in hands if hand is not None]
    surface = true_surface(truth, _PLACES)
    if surface is None or not known_hands or len(known_hands) < len(hands):
        return {}
    place = surface.picked(nearest_node(node.astype(np.float64), surface.samples(0)))
    distance = hand_distance(
        np.stack([place.samples(frame) for frame in range(len(place.point))]),
        np.concatenate(known_hands, axis=1).astype(np.float64),
    )
    return {
        name: ContactLabels(
            is_contact=distance < threshold, is_known=np.ones(distance.shape, dtype=bool)
        )
        for name, threshold in THRESHOLDS.items()
    }


def proximity_labels(
    node: Float[ndarray, "node 3"],
    hand: Float[ndarray, "frame point 3"],
    point: Float[ndarray, "frame track 3"] | None,
    is_visible: Bool[ndarray, "frame track"] | None,
) -> dict[str, ContactLabels]:
    """Label nodes as touched if they are near a fitted hand, independently of the simulation.

    In frame 0 the nodes are at their initial positions. In later frames the observed tracks carry
    them; a node without visible tracks around it is unknown.

    Args:
        node: Nodes in frame 0 [m].
        hand: Vertices of all hands [m].
        point: Observed tracks [m]; None leaves later frames unknown.
        is_visible: Which of them are visible.
    """
    moved = np.full((len(hand), *node.shape), np.nan)
    if point is not None and is_visible is not None and point.shape[1]:
        moved = carried_points(node, point, is_visible, reach=REACH)
    moved[0] = node
    is_known = np.asarray(np.isfinite(moved).all(axis=2))
    distance = hand_distance(np.where(is_known[..., None], moved, 1e3), hand)
    return {
        name: ContactLabels(is_contact=is_known & (distance < threshold), is_known=is_known)
        for name, threshold in THRESHOLDS.items()
    }


def agreement(
    is_predicted: Bool[ndarray, "frame node"], labels: ContactLabels
) -> Float[ndarray, " frame"]:
    """Compute the share of known nodes on which prediction and label agree; NaN without any."""
    right = (is_predicted == labels.is_contact) & labels.is_known
    count = labels.is_known.sum(axis=1)
    return np.where(count > 0, right.sum(axis=1) / np.maximum(count, 1), np.nan)


def contact_scores(
    is_predicted: Bool[ndarray, "frame node"], labels: ContactLabels, suffix: str
) -> dict[str, float | None]:
    """Score predicted contacts over the frames given.

    Args:
        is_predicted: Predicted contacts.
        labels: Labels of the same frames.
        suffix: Name of the threshold, which ends every key.

    Returns:
        ``accuracy``, the mean over frames of the agreement over nodes; ``precision``, ``recall``
        and ``f1`` over all nodes and frames together; ``predicted_share`` and ``label_share``, the
        shares of touching nodes, and ``known_share``, that of labelled ones. None where there is
        nothing to divide by.
    """
    is_known = labels.is_known
    hit = int((is_predicted & labels.is_contact & is_known).sum())
    predicted = int((is_predicted & is_known).sum())
    positive = int((labels.is_contact & is_known).sum())
    shares = agreement(is_predicted, labels)
    scores = {
        "accuracy": float(np.nanmean(shares)) if np.isfinite(shares).any() else None,
        "precision": _ratio(hit, predicted),
        "recall": _ratio(hit, positive),
        "f1": _ratio(2 * hit, predicted + positive),
        "predicted_share": _ratio(predicted, int(is_known.sum())),
        "label_share": _ratio(positive, int(is_known.sum())),
        "known_share": _ratio(int(is_known.sum()), is_known.size),
    }
    return {f"{name}_{suffix}": value for name, value in scores.items()}


def predicted_contacts(
    reference: ContactReference, distance: Float[ndarray, "frame node"], threshold: float
) -> Bool[ndarray, "frame node"]:
    """Predict contact where a virtual spring ends and the hand is nearer than the threshold.

    In frame 0 the springs alone decide: they are the contacts that the model found there.

    Args:
        reference: Where springs end.
        distance: Distance of each node from the hands, see `hand_distance` [m].
        threshold: Distance below which it counts [m].
    """
    is_near = distance < threshold
    is_near[0] = True
    joined = reference.is_joined
    return (joined if len(joined) == 1 else joined[: len(distance)]) & is_near


def _ratio(part: int, whole: int) -> float | None:
    return part / whole if whole else None
