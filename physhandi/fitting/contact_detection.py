"""When hands hold an object, found from what was seen of both.

A place of the object that is held stays where it is, seen from the hand; past a hand that arrives,
leaves, hovers or slides it moves. So each node near a hand is followed in the frame of the hand's
surface beside it: as long as it stays within a tolerance, the two are in contact.

Where no contact is found so, but what is near a hand stays in the air or is moved over the ground
with the hand, the hand holds it all the same.

Of frames after those that are fitted, only the hands are read: what holds in the last fitted frame
goes on holding, until the hand opens.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import median_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from physhandi.data.observation import ObjectObservation
from physhandi.data.sequence_meta import ShapeClass
from physhandi.fitting.rest_state import node_distance
from physhandi.fitting.search_bounds import neighbor_distance
from physhandi.metrics.baselines import Spread, placed_tracks, predicted_places
from physhandi.rotations import best_rotations
from physhandi.simulation.contact_intervals import NEVER, ContactIntervals

NEAR_HAND, LONGEST_HOLD = 1.5, 4.0
"""Distances from the hand within which a node can be held, and of the longest spring that can be
laid to it then. In distances of nodes, or of control nodes where these are farther apart."""
NEAR_HAND_SOLID, BEHIND_NEAREST = 1.0, 0.5
"""Distance from the hand within which a node of a solid can be held, and how much farther away than
the nearest node it can be, if that is more; both at most `NEAR_HAND`. Nodes of a solid lie on the
surface that fingers touch, and where these press it in, what is around moves along without being
held. Those of ropes and sheets lie on the side that is seen, and fingers hold them from the other
one."""
COARSEST_HAND = 3.0
"""Most that distances of control nodes count, in distances of nodes."""
SLIP = 1.0
"""Way by which a node in contact may move, seen from the hand, in distances of nodes."""
GIVE = 0.5
"""What its distance from the hand adds to that, as a part of it: what is between them deforms."""
LATE, EARLY = 0.3, 0.5
"""Parts of that way within which a node must be to be attached later than frame 0, where it is
approaching before, and to hold at frame 0 and before the last frame, where it still slips or
leaves. Springs as long as at frame 0 would pull what slipped then away from where it stays."""
SHORTEST = 0.2
"""Shortest contact [s]."""
SMOOTHING = 0.15
"""Time over which the median of a node's place beside the hand is taken [s]."""
SURFACE, SURFACE_NODES = 2.0, 8
"""Radius of a piece of the hand's surface, in distances of nodes, and the control nodes that it
must have to tell how it turns. Of fewer, only the distance from the node counts."""
MOST_SURFACE_NODES = 24
"""Most control nodes of a piece."""
OPENING = 0.75
"""Part of a hand's places that hold from which another one must be moved apart for it to open."""
EVIDENCE, FARTHER = 3.0, 2.0
"""Longest way from a node to the nearest track that tells its motion, in distances of nodes, or in
what it is at frame 0 if that is more. Where all are farther away, what holds a node is not told."""
FOLLOWS, OF_WAY = 2.0, 0.5
"""How far one may move, seen from the hand, that would be elsewhere if the hand did not hold it: so
many times as far as a node in contact, and at most this part of the way that it would be off."""
MOST_PAIRS = 80
"""Most pairs of a control node at a time."""


@dataclass(frozen=True, eq=False)
class _Hands:
    """The hands' surfaces over the fitted frames."""

    control: Float[ndarray, "frame control 3"]
    rotation: Float[ndarray, "frame control 3 3"]
    turns: Bool[ndarray, " control"]
    """Whether it is known how the surface around a control node turns."""

    def seen_from(
        self, place: Float[ndarray, "frame 3"], chosen: Int[ndarray, " chosen"]
    ) -> Float[ndarray, "chosen frame 3"]:
        """Give a moving place in the frames of some control nodes; or its distance alone."""
        offset = (place[:, None] - self.control[:, chosen]).transpose(1, 0, 2)
        rotation = self.rotation[:, chosen].transpose(1, 0, 2, 3)
        local = np.einsum("cfji,cfj->cfi", rotation, offset)
        away = np.zeros_like(local)
        away[..., 0] = np.linalg.norm(offset, axis=-1)
        return np.where(self.turns[chosen, None, None], local, away)


def find_contacts(
    observation: ObjectObservation,
    node: Float[ndarray, "node 3"],
    control: Float[ndarray, "frame control 3"],
    *,
    frame_count: int,
    frame_rate: float,
    kind: ShapeClass | None = None,
    most_grips: int | None = None,
    ground: Float[ndarray, " node"] | None = None,
    gravity: float = 0.0,
) -> ContactIntervals:
    """Find what hands hold, and when, in the frames that are fitted.

    Args:
        observation: What was seen of the object.
        node: Object nodes at frame 0 [m].
        control: Control nodes in all frames, also those to predict [m].
        frame_count: Frames to fit; nothing but the control nodes is read of later ones.
        frame_rate: Frames a second [Hz].
        kind: Kind of the object; None if it is not known.
        most_grips: Most control nodes, the nearest ones, that hold a node at a time; None for all.
        ground: Height at which each node lies on the ground [m]; None without ground.
        gravity: Acceleration along -z [m/s²]; without it nothing needs to be held.

    Returns:
        The contacts; a node's distance from each control node is that of the frame in which its
        contact begins. One that holds in the last fitted frame lasts until the hand opens.
    """
    if control.shape[1] == 0:
        return _pairs([], control, control, 0.0, most_grips)
    start = np.asarray(node, dtype=np.float64)
    spacing = node_distance(start)
    hands = _hands(np.asarray(control[:frame_count], np.float64), SURFACE * spacing)
    seen = observed_nodes(observation, start, frame_count)
    is_told = _told_nodes(observation, start, frame_count, spacing)
    last_told = np.maximum.accumulate(np.where(is_told, np.arange(frame_count)[:, None], 0), axis=0)
    near = [KDTree(hand).query(nodes) for hand, nodes in zip(hands.control, seen, strict=True)]
    distance, nearest = (np.array(values) for values in zip(*near, strict=True))
    reach = np.clip(neighbor_distance(hands.control[0]), spacing, COARSEST_HAND * spacing)
    near_hand = _near_hand(distance, reach, kind)
    shortest = max(2, round(SHORTEST * frame_rate))
    window = 2 * round(SMOOTHING * frame_rate / 2) + 1
    # What nothing shows stays beside the hand where it was seen last.
    distance = np.take_along_axis(distance, last_told, axis=0)
    nearest = np.take_along_axis(nearest, last_told, axis=0)
    held: list[tuple[int, int, int]] = []
    for index in np.flatnonzero((distance < near_hand[:, None]).any(axis=0)):
        candidate, which = np.unique(nearest[:, index], return_inverse=True)
        local = hands.seen_from(seen[:, index], candidate)[:, last_told[:, index]]
        local = median_filter(local, size=(1, window, 1), mode="nearest")
        is_near = distance[:, index] < near_hand
        tolerance = SLIP * spacing + GIVE * distance[:, index]
        held += [
            (int(index), *contact)
            for contact in _contacts_of(
                local[which], is_near, tolerance, is_told[:, index], shortest
            )
        ]
    last = frame_count - 1
    shown = np.take_along_axis(seen, last_told[..., None], axis=0)
    height = shown[..., 2] - (-np.inf if ground is None else ground)
    if kind in {"solid", "shell"}:  # It stands if one of its nodes does.
        height = np.broadcast_to(height.min(axis=1, keepdims=True), height.shape)
    for begin, end in _runs_without(held, last):
        fall = np.minimum(0.5 * gravity * ((end - begin) / frame_rate) ** 2, height[end])
        way = np.linalg.norm(shown[begin : end + 1] - shown[begin], axis=2).max(axis=0)
        stays = (height[begin] < spacing) & (gravity > 0.0)  # By friction.
        off = np.where(stays, np.maximum(fall, way), fall)
        index = _follower(hands, shown, (begin, end), off, LONGEST_HOLD * reach, spacing)
        if index is not None:
            held.append((index, begin, end))
    holding = np.unique([nearest[last, index] for index, _, end in held if end == last]).astype(int)
    until = _openings(np.asarray(control, np.float64), holding, last, window, spacing)
    held = [
        (index, begin, end if end < last else until[int(nearest[last, index])])
        for index, begin, end in held
    ]
    return _pairs(held, shown, hands.control, LONGEST_HOLD * reach, most_grips)


def _pairs(
    held: list[tuple[int, int, int]],
    seen: Float[ndarray, "frame node 3"],
    control: Float[ndarray, "frame control 3"],
    farthest: float,
    most_grips: int | None,
) -> ContactIntervals:
    """Pair nodes that are held with what is near them when the contact begins.

    Args:
        held: Node, first and last frame of each contact.
        seen: Places of the nodes [m].
        control: Control nodes [m].
        farthest: Longest distance of a pair [m].
        most_grips: Most control nodes, the nearest ones, of a contact; None for all.
    """
    pairs: list[ndarray] = []
    for index, begin, end in held:
        away = np.linalg.norm(control[begin] - seen[begin, index], axis=1)
        near_by = np.flatnonzero(away < farthest)
        if most_grips is not None:
            nearest_first = np.argsort(away[near_by], kind="stable")
            near_by = np.sort(near_by[nearest_first[:most_grips]])
        row = np.broadcast_to(np.array([index, begin, end]), (len(near_by), 3))
        pairs.append(np.column_stack([near_by, away[near_by], row]))
    table = np.concatenate(pairs) if pairs else np.zeros((0, 5))
    interval = table[:, 3:].astype(np.int64)
    rank = _ranks(table[:, 0], table[:, 1], interval)
    is_used = rank < MOST_PAIRS
    return ContactIntervals(
        node=table[is_used, 2].astype(np.int32),
        control=table[is_used, 0].astype(np.int32),
        distance=table[is_used, 1].astype(np.float32),
        rank=rank[is_used].astype(np.int32),
        interval=interval[is_used].astype(np.int32),
    )


def _near_hand(
    distance: Float[ndarray, "frame node"], reach: float, kind: ShapeClass | None
) -> Float[ndarray, " frame"]:
    """Compute within which distance from the hands nodes can be held [m], in each frame."""
    farthest = np.full(len(distance), NEAR_HAND * reach)
    if kind != "solid":
        return farthest
    behind_nearest = distance.min(axis=1) + BEHIND_NEAREST * reach
    return np.clip(behind_nearest, NEAR_HAND_SOLID * reach, farthest)


def observed_nodes(
    observation: ObjectObservation, node: Float[ndarray, "node 3"], frame_count: int
) -> Float[ndarray, "frame node 3"]:
    """Move the nodes of frame 0 as the tracks around them were seen to move [m].

    In a frame that shows no track whose place on the object is known they stay where they were.
    """
    start, of_track = node.astype(np.float64), observation.node_of_track
    is_placed, place = placed_tracks(start, observation.point, observation.is_visible, of_track)
    seen = np.empty((frame_count, *node.shape))
    seen[0] = node
    shown, spread, still = np.zeros(len(place), bool), None, place
    for frame in range(1, frame_count):
        if not is_placed[frame].any():
            seen[frame] = seen[frame - 1]
            continue
        # Neighbouring frames mostly show the same tracks.
        if spread is None or not np.array_equal(is_placed[frame], shown):
            shown = is_placed[frame]
            anchor, of_shown = place[shown], None if of_track is None else of_track[shown]
            spread, still = Spread(start, anchor), predicted_places(start, start, anchor, of_shown)
        seen[frame] = node + spread.over_nodes(observation.point[frame, shown] - still)
    return seen


def _told_nodes(
    observation: ObjectObservation,
    node: Float[ndarray, "node 3"],
    frame_count: int,
    spacing: float,
) -> Bool[ndarray, "frame node"]:
    """Tell which nodes have a track near them in a frame; at frame 0 all places are known."""
    is_placed, place = placed_tracks(
        node, observation.point, observation.is_visible, observation.node_of_track
    )
    away = np.full((frame_count, len(node)), np.inf)
    for frame in np.flatnonzero(is_placed[:frame_count].any(axis=1)):
        away[frame] = KDTree(place[is_placed[frame]]).query(node)[0]
    is_told = away <= np.maximum(EVIDENCE * spacing, FARTHER * away[0])
    is_told[0] = True
    return is_told


def _hands(control: Float[ndarray, "frame control 3"], radius: float) -> _Hands:
    """Find how the hand's surface around each control node turns after frame 0."""
    count = control.shape[1]
    most = min(MOST_SURFACE_NODES, count)
    distance, near = (
        np.reshape(value, (count, most)) for value in KDTree(control[0]).query(control[0], k=most)
    )
    weight = (distance <= radius).astype(np.float64)
    weight /= weight.sum(axis=1, keepdims=True)

    def shape(place: ndarray) -> ndarray:
        piece = place[near]
        return piece - np.einsum("cn,cni->ci", weight, piece)[:, None]

    start = shape(control[0])
    covariance = [np.einsum("cn,cni,cnj->cij", weight, shape(place), start) for place in control]
    turns = (weight > 0.0).sum(axis=1) >= SURFACE_NODES
    rotation = np.broadcast_to(np.eye(3), (*control.shape, 3)).copy()
    rotation[:, turns] = best_rotations(np.array(covariance)[:, turns])
    return _Hands(control, rotation, turns)


def _contacts_of(
    local: Float[ndarray, "seed frame 3"],
    is_near: Bool[ndarray, " frame"],
    tolerance: Float[ndarray, " frame"],
    is_told: Bool[ndarray, " frame"],
    shortest: int,
) -> list[tuple[int, int]]:
    """Find a node's contacts: the longest runs of frames in which it stays, and do not overlap.

    Args:
        local: For each frame as a seed, the node's places seen from the surface nearest to it then.
        is_near: Whether the node is near a hand.
        tolerance: How far it may be from its place in a seed's frame.
        is_told: Whether anything shows where it is. Frames that tell nothing neither begin nor end
            a contact, but for the last one, up to which goes on what held before.
        shortest: Fewest frames of a contact that tell of it.

    Returns:
        First and last frame of each.
    """
    count = len(is_near)
    frame = np.arange(count)
    free = is_near.copy()
    away = np.linalg.norm(local - local[frame, frame][:, None], axis=-1)
    told_before = np.concatenate([[0], is_told.cumsum()])
    contacts: list[tuple[int, int]] = []
    while free.any():
        blocked = ~((away < tolerance[:, None]) & free)
        first = np.where(blocked & (frame <= frame[:, None]), frame, -1).max(axis=1) + 1
        last = np.where(blocked & (frame >= frame[:, None]), frame, count).min(axis=1) - 1
        length = np.where(free & is_told, told_before[last + 1] - told_before[first], 0)
        if length.max() < shortest:
            break
        longest = np.flatnonzero(length == length.max())
        drift = [
            away[seed, first[seed] : last[seed] + 1][is_told[first[seed] : last[seed] + 1]].mean()
            for seed in longest
        ]
        seed = longest[np.argmin(drift)]
        begin, end = int(first[seed]), int(last[seed])
        free[begin : end + 1] = False
        observed = begin + np.flatnonzero(is_told[begin : end + 1])
        place = local[seed, observed]
        off = np.linalg.norm(place - np.median(place, axis=0), axis=1) / tolerance[seed]
        attached = observed[off < max(LATE, 1.001 * off.min())]
        holding = observed[off < max(EARLY, 1.001 * off.min())]
        begin = 0 if holding[0] == 0 else int(attached[0])
        end = end if end == count - 1 else int(holding[-1])
        if begin < end:
            contacts.append((begin, end))
    return sorted(contacts)


def _runs_without(held: list[tuple[int, int, int]], last: int) -> list[tuple[int, int]]:
    """Give first and last frame of the stretches of time in which hands hold nothing."""
    is_held = np.zeros(last, bool)
    for _, begin, end in held:
        is_held[begin:end] = True
    edge = np.flatnonzero(np.diff(np.concatenate([[True], is_held, [True]]).astype(int)))
    return [(int(begin), int(end)) for begin, end in edge.reshape(-1, 2)]


def _follower(  # noqa: PLR0917  (who moves, and what bounds it)
    hands: _Hands,
    seen: Float[ndarray, "frame node 3"],
    stretch: tuple[int, int],
    off: Float[ndarray, " node"],
    farthest: float,
    spacing: float,
) -> int | None:
    """Find the node that goes with a hand and would be elsewhere if the hand did not hold it.

    Args:
        hands: The hands.
        seen: Places of the nodes [m].
        stretch: First and last frame of a time in which nothing is held.
        off: How far each node would be from where it was seen then [m].
        farthest: Longest distance from the hand at first [m].
        spacing: Distance of nodes [m].

    Returns:
        The nearest of these; None if all would stay or leave the hand.
    """
    begin, end = stretch
    distance, nearest = KDTree(hands.control[begin]).query(seen[begin])
    way = SLIP * spacing + GIVE * distance
    candidate = np.flatnonzero((distance < farthest) & (off > way))
    for index in candidate[np.argsort(distance[candidate], kind="stable")]:
        local = hands.seen_from(seen[:, index], nearest[index : index + 1])[0, begin : end + 1]
        moved = np.linalg.norm(local - local[0], axis=1).max()
        if moved < min(FOLLOWS * way[index], OF_WAY * off[index]):
            return int(index)
    return None


def _openings(
    control: Float[ndarray, "frame control 3"],
    holding: Int[ndarray, " holding"],
    last: int,
    window: int,
    spacing: float,
) -> dict[int, int]:
    """Find when hands that hold something in the last fitted frame open.

    A hand opens when the places with which it holds move apart: when half of them are farther from
    `OPENING` of the others than they were, by the way by which a node in contact may move.

    Args:
        control: Control nodes in all frames [m].
        holding: Those that hold.
        last: The last fitted frame.
        window: Fitted frames over the median of which they are where they hold.
        spacing: Distance of nodes [m].

    Returns:
        For each of `holding` the last frame in which its hand is not open.
    """
    until = dict.fromkeys(holding.tolist(), int(NEVER))
    pair = KDTree(control[0]).query_pairs(spacing, output_type="ndarray")
    count = control.shape[1]
    joined = coo_array((np.ones(len(pair)), (pair[:, 0], pair[:, 1])), shape=(count, count))
    hand = connected_components(joined, directed=False)[1][holding]
    for number in np.unique(hand):
        own = holding[hand == number]
        apart = np.linalg.norm(control[:, own, None] - control[:, None, own], axis=-1)
        before = np.median(apart[max(0, last + 1 - window) : last + 1], axis=0)
        growth = np.quantile(apart[last + 1 :] - before, OPENING, axis=2)
        opened = np.flatnonzero(np.median(growth, axis=1) > SLIP * spacing)
        if len(opened):
            until |= dict.fromkeys(own.tolist(), last + int(opened[0]))
    return until


def _ranks(
    control: Float[ndarray, " pair"],
    distance: Float[ndarray, " pair"],
    interval: Int[ndarray, "pair 2"],
) -> Int[ndarray, " pair"]:
    """Count, for each pair, the nearer ones of its control node that hold at the same time."""
    rank = np.zeros(len(control), dtype=np.int64)
    order = np.argsort(control, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(control[order])) + 1):
        away, (first, last) = distance[part], interval[part].T
        is_nearer = away[None] < away[:, None]
        is_nearer |= (away[None] == away[:, None]) & (part[None] < part[:, None])
        holds_too = (first[None] < last[:, None]) & (first[:, None] < last[None])
        rank[part] = (is_nearer & holds_too).sum(axis=1)
    return rank
