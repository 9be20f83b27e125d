"""How a steered hand follows held keys and the gizmo."""

import math

import numpy as np
import pytest

from app.viewer.live.drive import LAG, TOP_TURN, Drives, HandDrive, HandOrder

RATE = 30.0


def drive(top_speed: float = 10.0) -> HandDrive:
    return HandDrive(np.zeros(6), frame_rate=RATE, top_speed=top_speed)


def poses(hand: HandDrive, count: int) -> np.ndarray:
    return np.stack([hand.next() for _ in range(count)])


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
    drives = Drives(np.zeros((2, 6)), frame_rate=RATE, top_speed=1.0)
    orders = [
        HandOrder(velocity=(0.0, 0.1, 0.0, 0.0, 0.0, 0.0)),
        HandOrder(goal=(0.2,) + (0.0,) * 5),
    ]
    drives.obey([order.to_dict() for order in orders])
    for _ in range(40):
        drives.obey(())
        pose = drives.next()
    assert pose[0, 1] == pytest.approx(0.1 * (40 / RATE - LAG), abs=0.003)
    np.testing.assert_allclose(pose[1], [0.2, 0, 0, 0, 0, 0], atol=1e-5)
    np.testing.assert_array_equal(pose[0, [0, 2, 3, 4, 5]], 0.0)
