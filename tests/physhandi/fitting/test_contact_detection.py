"""When a made-up hand holds a made-up sheet: what it does is known to the frame."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physhandi.data.observation import ObjectObservation
from physhandi.fitting.contact_detection import find_contacts, observed_nodes
from physhandi.metrics.baselines import last_residual
from physhandi.simulation.contact_intervals import NEVER, ContactIntervals

SPACING, RATE, FRAMES = 0.01, 30.0, 40
SHEET = np.array([[SPACING * i, SPACING * j, 0.0] for i in range(9) for j in range(9)])
MIDDLE = 40
PALM = np.array([[0.004 * i, 0.004 * j, 0.0] for i in range(-3, 4) for j in range(-3, 4)])
"""A patch of 24 mm; its middle is control node 24."""
RISE = np.array([0.0, 0.0, 0.003])
ABOVE = SHEET[MIDDLE] + RISE


def seen(moved: np.ndarray, frames: int = FRAMES) -> ObjectObservation:
    """The sheet's nodes, moved by so much in every frame, each of them a track."""
    point = np.stack([SHEET + shift for shift in np.broadcast_to(moved, (frames, 3))])
    return observation(point)


def observation(point: np.ndarray) -> ObjectObservation:
    visible = np.ones(point.shape[:2], bool)
    return ObjectObservation(point=point, is_visible=visible, is_motion_valid=visible)


def hand(way: np.ndarray) -> np.ndarray:
    return PALM + np.broadcast_to(way, (len(way), 3))[:, None]


def found(what: ObjectObservation, control: np.ndarray, frames: int = FRAMES) -> ContactIntervals:
    return find_contacts(what, SHEET, control, frame_count=frames, frame_rate=RATE)


def at(contacts: ContactIntervals, node: int) -> list[list[int]]:
    return np.unique(contacts.interval[contacts.node == node], axis=0).tolist()


def ramp(begin: int, end: int, to: float, frames: int = FRAMES) -> np.ndarray:
    """0 until a frame, then evenly to a value that is reached in another."""
    return to * np.clip((np.arange(frames) - begin) / (end - begin), 0.0, 1.0)


def along(axis: int, value: np.ndarray) -> np.ndarray:
    return value[:, None] * np.eye(3)[axis]


def test_what_is_held_from_the_start_is_held_for_ever() -> None:
    way = along(0, ramp(5, 35, 0.06)) + along(2, ramp(20, 35, 0.03))
    contacts = found(seen(way), hand(ABOVE + way))
    assert np.unique(contacts.interval, axis=0).tolist() == [[0, NEVER]]
    held = np.unique(contacts.node)
    near = np.linalg.norm(SHEET[:, None] - (ABOVE + PALM)[None], axis=2)
    np.testing.assert_array_equal(held, np.flatnonzero(near.min(axis=1) < 1.5 * SPACING))
    assert len(contacts.node) == int((near[held] < 4.0 * SPACING).sum())
    for pair in range(0, len(contacts.node), 97):
        expected = near[contacts.node[pair], contacts.control[pair]]
        assert contacts.distance[pair] == pytest.approx(expected, rel=1e-6)
    # The nearest of a control node's nodes is its first.
    of_one = contacts.control == 32
    order = np.argsort(contacts.rank[of_one])
    np.testing.assert_array_equal(contacts.rank[of_one][order], np.arange(of_one.sum()))
    assert np.diff(contacts.distance[of_one][order]).min() > -1e-8
    assert contacts.node[of_one][order][0] == MIDDLE


@pytest.mark.parametrize(("gap", "limit"), [(0.3, 1.0), (0.8, 1.3), (1.2, 1.5)])
def test_less_of_a_solid_is_held_unless_its_hand_was_found_away_from_it(
    gap: float, limit: float
) -> None:
    place = SHEET[MIDDLE] + [0.0, 0.0, gap * SPACING]
    way = along(0, ramp(5, 35, 0.06))
    near = np.linalg.norm(SHEET[:, None] - (place + PALM)[None], axis=2).min(axis=1)
    for kind, farthest in (("solid", limit), ("sheet", 1.5), (None, 1.5)):
        contacts = find_contacts(
            seen(way), SHEET, hand(place + way), frame_count=FRAMES, frame_rate=RATE, kind=kind
        )
        held = np.flatnonzero(near < farthest * SPACING)
        np.testing.assert_array_equal(np.unique(contacts.node), held)
    # Which the limits tell apart: 25 of all objects, 21 of a solid that is touched.
    assert {0.3: 4, 0.8: 4, 1.2: 0}[gap] == ((near >= limit * SPACING) & (near < 0.015)).sum()


def test_a_late_hand_holds_once_it_has_come_to_rest() -> None:
    coming = along(2, 0.03 - ramp(2, 12, 0.03))
    way = along(1, ramp(20, 38, 0.04))
    contacts = found(seen(way), hand(ABOVE + coming + way))
    ((begin, end),) = at(contacts, MIDDLE)
    assert end == NEVER
    # It comes by 3 mm a frame; what is left when it is attached is a third of a node's distance.
    assert 10 <= begin <= 12
    pair = np.flatnonzero((contacts.node == MIDDLE) & (contacts.control == 24))[0]
    left = coming[begin, 2]
    assert contacts.distance[pair] == pytest.approx(0.003 + left, abs=1e-6)
    assert left < 0.004


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_what_slips_at_first_is_held_where_it_stays(sign: float) -> None:
    # A node's distance and half of that from the hand, 11.5 mm, is the way that counts.
    for slip, first in ((0.005, 0), (0.009, 7)):
        slipping = sign * along(1, ramp(0, 10, slip))
        way = along(0, ramp(12, 36, 0.05))
        contacts = found(seen(way), hand(ABOVE + slipping + way))
        ((begin, end),) = at(contacts, MIDDLE)
        assert begin == first
        assert end == NEVER
        # Springs are as long as they are then, so what was slipped before pulls at nothing.
        beside = PALM[24] + RISE + slipping[begin]
        pair = np.flatnonzero((contacts.node == MIDDLE) & (contacts.control == 24))[0]
        assert contacts.distance[pair] == pytest.approx(np.linalg.norm(beside), abs=1e-6)


def test_a_hand_that_lets_go_holds_until_then() -> None:
    way = along(0, ramp(3, 18, 0.05))
    leaving = along(2, ramp(22, 32, 0.04))
    ((begin, end),) = at(found(seen(way), hand(ABOVE + way + leaving)), MIDDLE)
    assert begin == 0
    assert 22 <= end <= 24


def test_a_hand_that_slides_takes_hold_of_other_places() -> None:
    sliding = along(0, ramp(14, 22, 0.05))
    contacts = found(seen(np.zeros(3)), hand(ABOVE + sliding - np.array([0.03, 0.0, 0.0])))
    ((begin, end),) = at(contacts, MIDDLE - 27)
    assert begin == 0
    assert 14 <= end <= 16
    ((begin, end),) = at(contacts, MIDDLE + 18)
    assert 20 <= begin <= 22
    assert end == NEVER


@pytest.mark.parametrize("height", [0.004, 0.05], ids=["past", "above"])
def test_a_hand_that_passes_holds_nothing(height: float) -> None:
    passing = along(0, np.linspace(-0.2, 0.2, FRAMES))
    contacts = found(seen(np.zeros(3)), hand(ABOVE + passing + np.array([0.0, 0.0, height])))
    assert len(contacts.node) == 0


def test_a_turning_hand_keeps_what_turns_with_it() -> None:
    turn = Rotation.from_rotvec(along(1, ramp(5, 35, 1.8))).as_matrix()
    offset = SHEET - ABOVE
    sheet = np.einsum("fij,nj->fni", turn, offset) + ABOVE
    control = np.einsum("fij,nj->fni", turn, PALM) + ABOVE
    assert at(found(observation(sheet), control), MIDDLE) == [[0, NEVER]]
    # A sheet that stays is let go of by a hand that turns away from it.
    ((begin, end),) = at(found(seen(np.zeros(3)), control), MIDDLE + 18)
    assert begin == 0
    assert end < 30


def test_a_point_controller_holds_what_keeps_its_distance() -> None:
    turn = Rotation.from_rotvec(along(2, ramp(5, 35, 2.5))).as_matrix()
    grip = SHEET[MIDDLE]
    sheet = np.einsum("fij,nj->fni", turn, SHEET - grip) + grip
    control = np.broadcast_to(grip, (FRAMES, 1, 3))
    contacts = found(observation(sheet), control)
    assert np.unique(contacts.interval, axis=0).tolist() == [[0, NEVER]]
    assert len(np.unique(contacts.node)) == 9
    # Control nodes that are farther apart than nodes reach as far.
    sparse = found(observation(sheet), sheet[:, [MIDDLE, MIDDLE + 2, MIDDLE + 18]])
    assert len(np.unique(sparse.node)) > 9
    assert np.unique(sparse.interval, axis=0).tolist() == [[0, NEVER]]


def test_later_frames_are_not_read() -> None:
    way = along(0, ramp(3, 18, 0.05))
    leaving = along(2, ramp(25, 30, 0.04))
    control = hand(ABOVE + way + leaving)
    whole, part = found(seen(way), control), found(seen(way), control, frames=22)
    assert at(whole, MIDDLE)[0][1] < 28
    assert at(part, MIDDLE) == [[0, NEVER]]
    nonsense = seen(way)
    nonsense.point[22:] = 7.0
    control[22:] = -5.0
    again = found(nonsense, control, frames=22)
    for name in ("node", "control", "distance", "rank", "interval"):
        np.testing.assert_array_equal(getattr(again, name), getattr(part, name))


def test_what_a_hand_holds_when_the_fit_ends_is_let_go_when_it_opens() -> None:
    # Two fingers above and below the sheet that part by 2 mm a frame.
    way = along(0, ramp(3, 18, 0.05))
    finger = np.concatenate([PALM + RISE, PALM - RISE])
    side = np.sign(finger[:, 2])[None, :, None]
    ends = []
    for first in (24, 25, 28):
        opening = along(2, ramp(first, first + 10, 0.01))
        control = SHEET[MIDDLE] + finger + way[:, None] + side * opening[:, None]
        ((begin, end),) = at(found(seen(way), control, frames=22), MIDDLE)
        assert begin == 0
        ends.append(end)
    # By more than a node's distance, seen along ways that are aslant.
    assert 24 + 5 <= ends[0] <= 24 + 9
    assert [end - ends[0] for end in ends] == [0, 1, 4]
    opening = along(2, ramp(25, 35, 0.01))
    control = SHEET[MIDDLE] + finger + way[:, None] + side * opening[:, None]
    # A hand that goes on, turns or closes does not open, nor do two hands that part.
    turn = Rotation.from_rotvec(along(1, ramp(24, 39, 1.0))).as_matrix()
    turned = np.einsum("fij,fnj->fni", turn, control - side * opening[:, None] - SHEET[MIDDLE])
    closing = SHEET[MIDDLE] + finger + way[:, None] - side * 0.3 * opening[:, None]
    for other in (turned + SHEET[MIDDLE], closing):
        assert at(found(seen(way), other, frames=22), MIDDLE) == [[0, NEVER]]
    hands = np.concatenate(
        [
            hand(ABOVE + way),
            hand(ABOVE + along(1, np.full(FRAMES, 0.04) + 3 * opening[:, 2]) + way),
        ],
        axis=1,
    )
    contacts = found(seen(way), hands, frames=22)
    assert np.unique(contacts.interval, axis=0).tolist() == [[0, NEVER]]
    assert np.any(contacts.control < len(PALM))
    assert np.any(contacts.control >= len(PALM))


def test_a_single_node_is_held_and_no_hand_holds_nothing() -> None:
    lone = observation(np.zeros((FRAMES, 1, 3)))
    control = np.zeros((FRAMES, 2, 3)) + RISE
    fields = {"frame_count": FRAMES, "frame_rate": RATE}
    contacts = find_contacts(lone, np.zeros((1, 3)), control, **fields)
    assert contacts.interval.tolist() == [[0, NEVER], [0, NEVER]]
    np.testing.assert_allclose(contacts.distance, 0.003, rtol=1e-6)
    assert len(find_contacts(lone, np.zeros((1, 3)), control[:, :0], **fields).node) == 0


def test_the_nearest_control_nodes_hold_a_node_if_there_are_many() -> None:
    control = hand(np.zeros((FRAMES, 3)) + ABOVE)
    every = found(seen(np.zeros((FRAMES, 3))), control)
    few = find_contacts(
        seen(np.zeros((FRAMES, 3))),
        SHEET,
        control,
        frame_count=FRAMES,
        frame_rate=RATE,
        most_grips=3,
    )
    assert set(few.node) == set(every.node)
    limited = 0
    for node in set(every.node.tolist()):
        nearest = np.sort(every.distance[every.node == node])
        limited += len(nearest) > 3
        np.testing.assert_array_equal(np.sort(few.distance[few.node == node]), nearest[:3])
    assert limited > 3


def hidden_around(middle: int, frames: np.ndarray, point: np.ndarray) -> ObjectObservation:
    """Tracks of which those within 35 mm of a node are not seen in some frames."""
    visible = np.ones(point.shape[:2], bool)
    visible[np.ix_(frames, np.linalg.norm(SHEET - SHEET[middle], axis=1) < 0.035)] = False
    return ObjectObservation(point=point, is_visible=visible, is_motion_valid=visible)


def test_what_hands_hide_is_not_let_go_because_tracks_far_from_it_stay_behind() -> None:
    way = along(0, ramp(3, 36, 0.06))
    point = np.stack([SHEET + shift for shift in way])
    far = np.linalg.norm(SHEET - SHEET[MIDDLE], axis=1) >= 0.035
    point[:, far] = SHEET[far]  # The sheet bends between them.
    assert at(found(observation(point), hand(ABOVE + way)), MIDDLE) == [[0, NEVER]]
    hidden = hidden_around(MIDDLE, np.arange(14, FRAMES), point)
    assert at(found(hidden, hand(ABOVE + way)), MIDDLE) == [[0, NEVER]]


def test_what_was_let_go_while_it_was_hidden_is_held_as_far_as_it_was_seen() -> None:
    # The hand goes on alone from frame 16, and the sheet is seen again where it was then.
    way, own = along(0, ramp(3, 36, 0.06)), along(0, np.minimum(ramp(3, 36, 0.06), 0.06 * 13 / 33))
    point = np.stack([SHEET + shift for shift in own])
    hidden = hidden_around(MIDDLE, np.arange(12, 30), point)
    ((begin, end),) = at(found(hidden, hand(ABOVE + way)), MIDDLE)
    assert begin == 0
    assert 10 <= end <= 11


def test_what_no_frame_shows_from_near_is_told_by_what_is_nearest() -> None:
    way = along(0, ramp(3, 30, 0.06))
    point = np.stack([SHEET + shift for shift in way])
    hidden = hidden_around(MIDDLE, np.arange(FRAMES), point)
    assert at(found(hidden, hand(ABOVE + way)), MIDDLE) == [[0, NEVER]]
    leaving = along(2, ramp(22, 32, 0.04))
    ((begin, end),) = at(found(hidden, hand(ABOVE + way + leaving)), MIDDLE)
    assert begin == 0
    assert 22 <= end <= 24


BELOW = np.full(len(SHEET), -0.3)
"""Ground far below the sheet."""


def held_steps(contacts: ContactIntervals, frames: int = FRAMES) -> list[int]:
    """Frames from each of which a hand holds something until the next one."""
    steps = np.arange(frames - 1)[:, None]
    return np.flatnonzero(
        ((contacts.interval[:, 0] <= steps) & (steps < contacts.interval[:, 1])).any(axis=1)
    ).tolist()


def test_what_stays_in_the_air_beside_a_hand_is_held() -> None:
    """A hand that is found 18 mm above the sheet from frame 12 to 24: too far to hold it."""
    away = np.zeros((FRAMES, 3))
    away[12:25, 2] = 0.015
    way = along(0, ramp(5, 35, 0.06))
    control = hand(ABOVE + way + away)
    every = list(range(FRAMES - 1))

    def steps_held(what: ObjectObservation | None = None, **options: object) -> list[int]:
        fields = {"frame_count": FRAMES, "frame_rate": RATE, "gravity": 9.81} | options
        return held_steps(find_contacts(what or seen(way), SHEET, control, **fields))

    left_alone = steps_held(ground=BELOW, gravity=0.0)
    assert {*every} - {*left_alone} >= {*range(13, 23)}
    assert steps_held(ground=BELOW) == every
    assert steps_held() == every  # There is no ground.
    # It lies on the ground, or would lie there after less than the way by which held nodes move.
    assert steps_held(ground=SHEET[:, 2]) == left_alone
    assert steps_held(ground=SHEET[:, 2] - 0.009) == left_alone
    # A solid stands if one of its nodes does; a sheet hangs down from where it is held.
    one_stands = np.where(np.arange(len(SHEET)) == 0, 0.0, BELOW)
    assert steps_held(ground=one_stands, kind="sheet") == every
    assert steps_held(ground=one_stands, kind="solid") == left_alone
    assert steps_held(ground=BELOW, kind="solid") == every
    # It falls while nothing holds it, and is caught.
    fall = np.zeros((FRAMES, 3))
    fall[12:25, 2] = -0.5 * 9.81 * (np.arange(13) / RATE) ** 2
    fall[25:, 2] = fall[24, 2]
    control = hand(ABOVE + way + away + fall * (np.arange(FRAMES) >= 25)[:, None])
    assert 20 not in steps_held(seen(way + fall), ground=BELOW)


def test_a_hand_that_is_found_beside_what_it_lifts_holds_the_nearest_node() -> None:
    way = along(2, ramp(5, 35, 0.1))
    aside = SHEET[MIDDLE] + [0.0, 0.0, 0.018]
    fields = {"frame_count": FRAMES, "frame_rate": RATE, "ground": SHEET[:, 2]}
    assert len(find_contacts(seen(way), SHEET, hand(aside + way), **fields).node) == 0
    contacts = find_contacts(seen(way), SHEET, hand(aside + way), **fields, gravity=9.81)
    near = np.linalg.norm(SHEET[:, None] - (aside + PALM)[None], axis=2)
    assert np.unique(contacts.interval, axis=0).tolist() == [[0, NEVER]]
    (node,) = np.unique(contacts.node)
    assert near[node].min() == pytest.approx(0.018)
    np.testing.assert_allclose(contacts.distance, near[node, contacts.control], rtol=1e-6)
    # A hand that stays where it is while the sheet rises lifts nothing.
    beside = SHEET[4] - [0.012 + 0.018, 0.0, 0.0]
    still = hand(np.broadcast_to(beside, (FRAMES, 3)))
    assert len(find_contacts(seen(way), SHEET, still, **fields, gravity=9.81).node) == 0


@pytest.mark.parametrize(
    ("sheet_way", "hand_way", "is_held"),
    [
        pytest.param(0.06, 0.06, True, id="together"),
        pytest.param(0.06, 0.04, True, id="the hand slides over it"),
        pytest.param(0.06, 0.02, False, id="the hand stays behind"),
        pytest.param(0.06, 0.0, False, id="it moves by itself"),
        pytest.param(0.0, 0.06, False, id="it stays where it is"),
        pytest.param(0.015, 0.015, False, id="by less than held nodes may move"),
    ],
)
def test_what_moves_over_the_ground_with_a_hand_beside_it_is_held(
    sheet_way: float, hand_way: float, is_held: bool
) -> None:
    """A hand that is found 18 mm above the sheet, which lies on the ground: too far to hold it."""
    what = seen(along(0, ramp(5, 35, sheet_way)))
    control = hand(SHEET[MIDDLE] + [0.0, 0.0, 0.018] + along(0, ramp(5, 35, hand_way)))
    fields = {"frame_count": FRAMES, "frame_rate": RATE, "ground": SHEET[:, 2]}
    contacts = find_contacts(what, SHEET, control, **fields, gravity=9.81)
    assert at(contacts, MIDDLE) == ([[0, NEVER]] if is_held else [])
    assert set(contacts.node) == ({MIDDLE} if is_held else set())
    if is_held:
        assert contacts.distance.min() == pytest.approx(0.018)
    # Where nothing weighs anything, nothing is held by friction.
    assert len(find_contacts(what, SHEET, control, **fields).node) == 0


@pytest.mark.parametrize("follows_late_tracks", [False, True])
def test_nodes_are_seen_in_a_frame_as_its_tracks_alone_say(follows_late_tracks: bool) -> None:
    random = np.random.default_rng(1)
    node, place = random.random((20, 3)), random.random((30, 3))
    point = (place + random.normal(scale=0.1, size=(6, 30, 3))).astype(np.float32)
    is_visible = np.ones((6, 30), bool)
    is_visible[2:5, :12] = False
    is_visible[3] = False
    of_track = random.integers(0, 20, 30) if follows_late_tracks else None
    observation = ObjectObservation(
        point=point, is_visible=is_visible, is_motion_valid=is_visible, node_of_track=of_track
    )
    seen = observed_nodes(observation, node, 6)
    for frame in (1, 2, 4, 5):
        own = last_residual(node, node, point, is_visible, frame, of_track)
        np.testing.assert_array_equal(seen[frame], node + own)
    np.testing.assert_array_equal(seen[3], seen[2])
