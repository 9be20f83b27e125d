"""How a steered hand follows held keys and the gizmo."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from app.viewer.live.drive import LAG, TOP_TURN, Drives, HandDrive, HandLimits, HandOrder
from physhandi.simulation.fingers import BENDS, CURLS, Fingers
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.steering import POSE, SteeredHand, SteeredMotion
from physhandi.simulation.topology import build_model

RATE = 30.0
GROUND = 0.01
NO_PULL = np.zeros(3)


def drive(
    top_speed: float = 10.0,
    reach: float = 100.0,
    depth: Callable[[np.ndarray], float] = lambda _: -math.inf,
) -> HandDrive:
    limits = HandLimits(top_speed=top_speed, reach=reach)
    return HandDrive(np.zeros(POSE), frame_rate=RATE, limits=limits, depth=depth)


def two_hands(**changes: object) -> SteeredMotion:
    """Two hands above the ground, one of which was recorded with a node 2 mm in it."""
    control = np.array(
        [[0.0, 0.0, 0.05], [0.04, 0.0, 0.05], [0.5, 0.0, 0.008], [0.54, 0.0, 0.1]], np.float32
    )
    parameters = SimulationParameters(ground_height=GROUND, frame_rate=RATE).replace(**changes)
    model = build_model(control, control, parameters)
    hands = tuple(
        SteeredHand(name=name, control=own, wrist=control[own[0]].astype(float))
        for name, own in (("right", np.array([0, 1])), ("left", np.array([2, 3])))
    )
    start = (control, np.zeros_like(control))
    return SteeredMotion(
        model=model,
        start=start,
        parameters=parameters,
        control=control,
        hands=hands,
        pose=np.zeros((1, 2, POSE)),
    )


def poses(hand: HandDrive, count: int) -> np.ndarray:
    return np.stack([hand.next(NO_PULL)[:6] for _ in range(count)])


def test_a_hand_takes_up_its_speed_smoothly_keeps_it_and_stops_smoothly() -> None:
    hand = drive()
    hand.order = HandOrder(velocity=(0.3, 0.0, -0.6, 0.0, 0.0, 0.9))
    way = poses(hand, 60)
    speed = np.diff(way, axis=0, prepend=0.0) * RATE
    lag = 1.0 - np.exp(-np.arange(1, 61) / (RATE * LAG))
    for axis, top in ((0, 0.3), (2, -0.6), (5, 0.9)):
        np.testing.assert_allclose(speed[:, axis], top * lag, rtol=1e-6)
    np.testing.assert_array_equal(way[:, [1, 3, 4]], 0.0)
    hand.order = HandOrder()
    speed = np.diff(poses(hand, 60), axis=0, prepend=way[-1:]) * RATE
    assert (np.diff(speed[:, 0]) < 0).all()
    assert 0 < speed[-1, 0] < 1e-6


def test_a_hand_reaches_its_goal_without_passing_it() -> None:
    hand = drive()
    goal = (0.1, -0.2, 0.05, 0.0, 0.4, 0.0)
    hand.order = HandOrder(goal=goal)
    way = poses(hand, 120)
    assert (np.diff(way[:30, 0]) > 0).all()
    assert way[:, 0].max() <= 0.1 + 1e-12
    assert way[:, 1].min() >= -0.2 - 1e-12
    np.testing.assert_allclose(way[-1], goal, atol=1e-12)
    assert np.linalg.norm(way[9] - goal) < 0.06  # After a third of a second.


def test_no_hand_is_faster_than_its_top_speeds() -> None:
    for order in (
        HandOrder(goal=(50.0, 0.0, 0.0, 0.0, 0.0, 3.0)),
        HandOrder(velocity=(300.0, 400.0, 0.0, 0.0, 0.0, 40.0)),
    ):
        hand = drive(top_speed=1.5)
        hand.order = order
        step = np.diff(poses(hand, 30), axis=0, prepend=0.0)
        assert np.linalg.norm(step[:, :3], axis=1).max() == pytest.approx(1.5 / RATE)
        turn = np.abs((step[:, 5] + math.pi) % (2 * math.pi) - math.pi)
        assert turn.max() == pytest.approx(TOP_TURN / RATE)


def test_each_hand_follows_its_own_order_until_the_next() -> None:
    drives = Drives(two_hands(), HandLimits(top_speed=1.0, reach=1.0))
    orders = [
        HandOrder(velocity=(0.0, 0.1, 0.0, 0.0, 0.0, 0.0)),
        HandOrder(goal=(0.2,) + (0.0,) * 5),
    ]
    drives.obey([order.to_dict() for order in orders], None)
    for _ in range(40):
        pose = drives.next(np.zeros((2, 3)))
    assert pose[0, 1] == pytest.approx(0.1 * (40 / RATE - LAG), abs=0.003)
    np.testing.assert_allclose(pose[1], [0.2, *np.zeros(POSE - 1)], atol=1e-5)
    np.testing.assert_array_equal(pose[0, [0, 2, 3, 4, 5]], 0.0)


def test_a_hand_goes_as_far_as_it_reaches_and_turns_round_at_once() -> None:
    hand = drive(reach=0.2)
    hand.order = HandOrder(velocity=(0.3, 0.4, 0.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(poses(hand, 60)[-1], [0.12, 0.16, 0, 0, 0, 0], atol=1e-12)
    hand.order = HandOrder(velocity=(-0.3, -0.4, 0.0, 0.0, 0.0, 0.0))
    # It has not gathered speed at its bound.
    first = 0.5 * (1.0 - math.exp(-1.0 / (RATE * LAG))) / RATE
    np.testing.assert_allclose(0.2 - np.linalg.norm(hand.next(NO_PULL)[:3]), first, rtol=1e-6)


@pytest.mark.parametrize("kind", ["goal", "velocity"])
def test_no_hand_goes_through_the_ground(kind: str) -> None:
    motion = two_hands()
    drives = Drives(motion, HandLimits(top_speed=1.0, reach=1.0))
    down = (0.1, 0.0, -0.5, 0.0, 0.0, 0.0)
    drives.obey([HandOrder(**{kind: down}).to_dict()] * 2, None)
    height = np.stack([motion.control_at(drives.next(np.zeros((2, 3))))[:, 2] for _ in range(60)])
    # The lowest node of a hand lies on the ground, or where it was recorded below it.
    np.testing.assert_allclose(height[-1], [GROUND, GROUND, 0.008, 0.1], atol=1e-7)
    assert height[:, :2].min() >= GROUND - 1e-7
    # Along the ground it goes on.
    assert drives.next(np.zeros((2, 3)))[0, 0] > 0.095
    # A hand that tips forward is lifted by its own length: its node stays above the ground.
    drives.obey([HandOrder(goal=(0.0, 0.0, -0.5, 0.0, np.pi / 2, 0.0)).to_dict()] * 2, None)
    for _ in range(90):
        pose = drives.next(np.zeros((2, 3)))
    np.testing.assert_allclose(motion.control_at(pose)[:2, 2], [GROUND + 0.04, GROUND], atol=1e-6)


def test_without_ground_a_hand_goes_down() -> None:
    drives = Drives(two_hands(ground_height=None), HandLimits(top_speed=1.0, reach=1.0))
    drives.obey([HandOrder(goal=(0.0, 0.0, -0.5, 0.0, 0.0, 0.0)).to_dict()] * 2, None)
    for _ in range(90):
        pose = drives.next(np.zeros((2, 3)))
    np.testing.assert_allclose(pose[:, 2], -0.5, atol=1e-5)


def test_a_hand_gives_way_along_a_pull_that_is_too_strong() -> None:
    top = 1.5
    for force, speed in ((9.9, 0.6), (12.5, -0.2 * top * 0.25), (50.0, -0.2 * top)):
        hand = drive(top_speed=top)
        hand.most_force = 10.0
        hand.order = HandOrder(velocity=(0.3, 0.0, 0.6, 0.0, 0.0, 0.0))
        way = np.stack([hand.next(np.array([0.0, 0.0, -force])) for _ in range(60)])
        last = RATE * (way[-1] - way[-2])
        np.testing.assert_allclose(
            last, [0.3, 0, speed, *np.zeros(POSE - 3)], rtol=1e-6, atol=1e-12
        )
    # One that is told to go along the pull, and faster, does so.
    hand.order = HandOrder(velocity=(0.0, 0.0, -1.0, 0.0, 0.0, 0.0))
    way = np.stack([hand.next(np.array([0.0, 0.0, -12.5])) for _ in range(60)])
    np.testing.assert_allclose(RATE * (way[-1] - way[-2])[2], -1.0, rtol=1e-6)


def test_fingers_close_while_a_key_is_held_and_no_farther_than_a_fist() -> None:
    hand = drive()
    hand.order = HandOrder(goal=(0.1,) + (0.0,) * 5, closing=0.5)
    curl = np.array([hand.next(NO_PULL)[6] for _ in range(30)])
    expected = 0.5 * np.cumsum(1.0 - np.exp(-np.arange(1, 31) / (RATE * LAG))) / RATE
    np.testing.assert_allclose(curl, expected, rtol=1e-6)
    for closing, end in ((0.8, 1.0), (-0.8, -1.0)):
        hand.order = HandOrder(closing=closing)
        for _ in range(120):
            pose = hand.next(NO_PULL)
        assert pose[6] == end
    assert HandOrder.from_dict(hand.order.to_dict()) == hand.order


def with_fingers(motion: SteeredMotion) -> SteeredMotion:
    """Both hands have straight fingers along x that bend down at the wrist, and there alone.

    The second of their control nodes, 4 cm away, hangs on the first finger.
    """
    hands = []
    for hand in motion.hands:
        joint = np.tile(hand.wrist, (len(CURLS), 15, 1))
        weight = np.zeros((2, 15))
        weight[1, 0] = 1.0
        fingers = Fingers(
            origin=joint,
            axis=np.tile([0.0, 1.0, 0.0], (len(CURLS), 15, 1)),
            swing_axis=np.tile([0.0, 0.0, 1.0], (5, 1)),
            tip=joint[:, :5] + [0.04, 0.0, 0.0],
            turn=np.tile(np.maximum(CURLS, 0.0)[:, None], (1, 15)),
            low=np.full(BENDS, -0.2),
            high=np.full(BENDS, 1.5),
            weight=weight,
        )
        curls = np.repeat(motion.control[hand.control][None], len(CURLS), axis=0)
        hands.append(replace(hand, curls=curls, fingers=fingers))
    return replace(motion, hands=tuple(hands))


def test_a_finger_goes_smoothly_to_its_bend_and_no_farther_than_its_joint() -> None:
    motion = with_fingers(two_hands(ground_height=None))
    drives = Drives(motion, HandLimits(top_speed=1.0, reach=1.0))
    bend = np.zeros(BENDS)
    bend[[1, 6]] = [0.1, 9.0]
    orders = [HandOrder(bend=tuple(bend)), HandOrder()]
    drives.obey([order.to_dict() for order in orders], None)
    way = np.stack([drives.next(np.zeros((2, 3))) for _ in range(60)])
    lag = np.exp(-np.arange(1, 61) / (RATE * LAG))
    np.testing.assert_allclose(way[:, 0, 8], 0.1 * (1.0 - lag), atol=2e-6)
    assert way[-1, 0, 13] == pytest.approx(1.5)
    assert np.diff(way[:, 0, 13]).max() <= TOP_TURN / RATE + 1e-12
    np.testing.assert_array_equal(np.delete(way[:, 0], [8, 13], axis=1), 0.0)
    np.testing.assert_array_equal(way[:, 1], 0.0)
    # What all fingers close is taken from what one may bend.
    drives.obey([HandOrder(closing=0.8).to_dict()] * 2, None)
    for _ in range(90):
        pose = drives.next(np.zeros((2, 3)))
    np.testing.assert_allclose(pose[0, [6, 8, 13]], [1.0, 0.1, 0.5], atol=2e-6)
    assert HandOrder.from_dict(orders[0].to_dict()) == orders[0]


def test_a_finger_stops_above_the_ground_and_its_wrist_stays() -> None:
    motion = with_fingers(two_hands())
    drives = Drives(motion, HandLimits(top_speed=1.0, reach=1.0))
    lowered, bend = 0.03, np.zeros(BENDS)
    drives.obey([HandOrder(goal=(0.0, 0.0, -lowered, 0.0, 0.0, 0.0)).to_dict()] * 2, None)
    for _ in range(90):
        before = drives.next(np.zeros((2, 3)))[0]
    bend[1] = 1.5  # 4 cm below its wrist, which is 1 cm above the ground.
    drives.obey([HandOrder(bend=tuple(bend)).to_dict()] * 2, None)
    way = np.stack([drives.next(np.zeros((2, 3)))[0] for _ in range(90)])
    np.testing.assert_array_equal(np.delete(way - before, 8, axis=1), 0.0)
    moved = np.stack([before, *way])[:, None] * [[1.0], [0.0]]
    height = np.stack([motion.control_at(pose)[1, 2] for pose in moved])
    assert (np.diff(height) <= 1e-7).all()
    assert GROUND - 1e-7 <= height[-1] < GROUND + 5e-4
