"""Steered hands: what they move where, against the oracle in float64, closed forms and bits."""

from dataclasses import replace

import numpy as np
import pytest
from reference.scenes import as_model, cube_scene
from reference.spring_mass import simulate

from physhandi.errors import UsageError
from physhandi.simulation.fingers import BENDS, CURLS, Fingers
from physhandi.simulation.steering import (
    POSE,
    SteeredHand,
    SteeredMotion,
    SteeredSimulation,
    from_quaternion,
    nearest_surface,
    to_quaternion,
    turn_between,
    turn_on,
)

FRAMES = 6
AHEAD = np.array([0.03, 0.0, 0.0])


def rotation(axis: int, angle: float) -> np.ndarray:
    """Turn about an axis as textbooks write it."""
    c, s = np.cos(angle), np.sin(angle)
    return {
        0: np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        1: np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        2: np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


def steered_cube(frames: int = FRAMES) -> SteeredMotion:
    """The cube whose controls 0 to 2 follow one hand, and control 3 another one that rests."""
    scene = cube_scene()
    model, parameters = as_model(scene)
    way = np.linspace(0, 1, frames)[:, None]
    pose = np.zeros((frames, 2, POSE))
    pose[:, 0, :3] = way * [0.004, -0.002, 0.006]
    pose[:, 0, 3:6] = way * [0.0, 0.0, 0.3]
    hands = (
        SteeredHand(name="right", control=np.array([0, 1, 2]), wrist=np.array([0.02, 0.0, 0.03])),
        SteeredHand(name="left", control=np.array([3]), wrist=np.zeros(3)),
    )
    control = scene.control[0].astype(np.float32)
    return SteeredMotion(
        model=model,
        start=(model.object_node, model.initial_velocity),
        parameters=parameters,
        control=control,
        hands=hands,
        pose=pose,
    )


def test_a_steered_hand_moves_the_object_as_the_oracle_says(device: str) -> None:
    motion, scene = steered_cube(), cube_scene()
    control = np.repeat(scene.control[:1], FRAMES, axis=0)
    for frame in range(FRAMES):
        part = frame / (FRAMES - 1)
        turn, wrist = rotation(2, 0.3 * part), motion.hands[0].wrist
        at = wrist + part * np.array([0.004, -0.002, 0.006])
        control[frame, :3] = [turn @ (point - wrist) + at for point in scene.control[0, :3]]
    np.testing.assert_allclose(motion.controls(), control, atol=1e-8)
    expected = simulate(replace(scene, control=control))[0]
    found = np.stack([position for position, _ in motion.simulate(device)])
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert (
        np.abs(found - simulate(replace(scene, control=control[:1].repeat(6, 0)))[0]).max() > 1e-3
    )


def test_the_same_take_gives_the_same_bits_from_any_of_its_frames_on() -> None:
    motion = steered_cube()
    frames = list(motion.simulate())
    for first, last in ((0, 5), (2, 5), (3, 4)):
        part = motion.part(first, last, frames[first])
        again = list(part.simulate())
        assert len(again) == last - first + 1
        for old, new in zip(frames[first:], again, strict=False):
            np.testing.assert_array_equal(old, new)
    steered = SteeredSimulation(motion)
    for pose, expected in zip(motion.pose[1:], frames[1:], strict=True):
        np.testing.assert_array_equal(steered.step(pose), expected)
    assert steered.frame == 5


def test_fingers_move_control_nodes_between_the_shapes_that_are_known() -> None:
    motion = steered_cube()
    own = motion.control[[0, 1, 2]]
    # Of the three nodes the second goes along x with the curl, and the third by its square.
    shapes = np.repeat(own[None], len(CURLS), axis=0)
    shapes[:, 1, 0] += np.float32(0.01) * CURLS.astype(np.float32)
    shapes[:, 2, 0] += np.float32(0.01) * CURLS.astype(np.float32) ** 2
    right = replace(motion.hands[0], curls=shapes)
    pose = np.zeros((4, 2, POSE))
    pose[:, 0, 6] = [0.0, 0.3, 1.0, -1.0]
    closing = replace(motion, hands=(right, motion.hands[1]), pose=pose)
    moved = closing.controls() - motion.control
    np.testing.assert_array_equal(moved[0], 0.0)
    np.testing.assert_allclose(moved[:, 1, 0], [0.0, 0.003, 0.01, -0.01], atol=1e-8)
    low, high = 0.25**2, 0.375**2
    np.testing.assert_allclose(
        moved[:, 2, 0], [0.0, 0.01 * (low + 0.4 * (high - low)), 0.01, 0.01], atol=1e-8
    )
    np.testing.assert_array_equal(moved[:, [0, 3]], 0.0)
    again = SteeredMotion.from_tensors(closing.to_tensors(), closing.parameters)
    np.testing.assert_array_equal(again.controls(), closing.controls())
    with pytest.raises(ValueError, match="curls of right has shape"):
        replace(motion, hands=(replace(right, curls=shapes[1:]), motion.hands[1]))
    # Where fingers are turned in the same way, the wrist takes them along.
    pose[2, 0, 3:6] = [0.0, 0.0, np.pi / 2]
    turned = closing.control_at(pose[2])[1] - motion.hands[0].wrist
    still = motion.control[1] + [0.01, 0, 0] - motion.hands[0].wrist
    np.testing.assert_allclose(turned, [-still[1], still[0], still[2]], atol=1e-7)


def fingers_of_cube(motion: SteeredMotion) -> Fingers:
    """Fingers along x, which bend about y and swing about z; node 1 hangs on the first, at its end.

    All five begin at the wrist of the first hand; their joints are 0, 1 and 2 cm from it.
    """
    wrist = motion.hands[0].wrist
    origin = np.tile(wrist + 0.01 * np.eye(3)[[0]] * [[0], [1], [2]], (len(CURLS), 5, 1))
    weight = np.zeros((3, 15))
    weight[1, 2] = 1.0
    return Fingers(
        origin=origin,
        axis=np.tile([0.0, 1.0, 0.0], (len(CURLS), 15, 1)),
        swing_axis=np.tile([0.0, 0.0, 1.0], (5, 1)),
        tip=np.tile(wrist + AHEAD, (len(CURLS), 5, 1)),
        turn=np.zeros((len(CURLS), 15)),
        low=np.full(BENDS, -1.0),
        high=np.full(BENDS, 1.6),
        weight=weight,
    )


def test_a_finger_takes_its_control_nodes_along_and_the_wrist_takes_all() -> None:
    motion = steered_cube()
    own = motion.control[[0, 1, 2]]
    shapes = np.repeat(own[None], len(CURLS), axis=0)
    shapes[:, 1] = motion.hands[0].wrist + AHEAD
    right = replace(motion.hands[0], curls=shapes, fingers=fingers_of_cube(motion))
    hands = (right, motion.hands[1])
    pose = np.zeros((3, 2, POSE))
    pose[1, 0, 7:11] = [0.0, 0.0, np.pi / 2, 0.0]  # The middle joint of the first finger.
    pose[2] = pose[1]
    pose[2, 0, 7] = np.pi / 2  # It swings, too, and the hand turns about x and goes up.
    pose[2, 0, 3:6] = [np.pi / 2, 0.0, 0.0]
    pose[2, 0, 2] = 0.005
    motion = replace(motion, hands=hands, pose=pose)
    wrist = right.wrist
    moved = np.stack([motion.control_at(its)[1] for its in pose]) - wrist
    expected = [[0.03, 0, 0], [0.01, 0, -0.02], [0.0, 0.02, 0.01 + 0.005]]
    np.testing.assert_allclose(moved, expected, atol=1e-7)
    np.testing.assert_array_equal(motion.control_at(pose[1])[[0, 2, 3]], motion.control[[0, 2, 3]])
    np.testing.assert_allclose(right.tip(0, pose[2, 0]) - wrist, expected[2], atol=1e-12)
    np.testing.assert_allclose(right.tip(1, pose[2, 0]) - wrist, [0.03, 0, 0.005], atol=1e-12)

    # The other way round: from where the tip shall be in the world to the bends.
    place = np.array([0.01, 0.02, 0.005])
    for start in (pose[2, 0], np.concatenate([pose[2, 0, :7], np.full(BENDS, 0.3)])):
        bend = right.follow(0, wrist + place, start)
        there = np.concatenate([start[:7], bend])
        np.testing.assert_allclose(right.tip(0, there) - wrist, place, atol=1e-6)
        np.testing.assert_array_equal(bend[4:], start[11:])
    with pytest.raises(UsageError, match="left has no fingers that bend"):
        motion.hands[1].follow(0, wrist, pose[0, 1])
    with pytest.raises(UsageError, match="finite"):
        right.follow(0, np.full(3, np.nan), pose[0, 0])
    with pytest.raises(ValueError, match="fingers of right move 2 points; expected one for each"):
        replace(motion, hands=(replace(right, fingers=right.fingers.of_points([0, 1])), hands[1]))

    again = SteeredMotion.from_tensors(motion.to_tensors(), motion.parameters)
    np.testing.assert_array_equal(again.controls(), motion.controls())
    smooth = replace(motion, pose=np.repeat(pose[1:2], 5, axis=0)).smoothed(0.1)
    np.testing.assert_allclose(smooth.pose[:, 0], np.tile(pose[1, 0], (5, 1)), atol=1e-12)


def test_a_take_of_before_fingers_bent_one_by_one_opens() -> None:
    motion = steered_cube()
    tensors = motion.to_tensors()
    old = SteeredMotion.from_tensors(
        {**tensors, "pose": tensors["pose"][..., :7]}, motion.parameters
    )
    np.testing.assert_array_equal(old.pose, motion.pose)
    np.testing.assert_array_equal(old.controls(), motion.controls())


def test_a_take_is_stored_with_every_bit() -> None:
    motion = steered_cube()
    again = SteeredMotion.from_tensors(motion.to_tensors(), motion.parameters)
    np.testing.assert_array_equal(again.controls(), motion.controls())
    assert [hand.name for hand in again.hands] == ["right", "left"]
    assert [hand.control.tolist() for hand in again.hands] == [[0, 1, 2], [3]]
    for old, new in zip(motion.simulate(), again.simulate(), strict=True):
        np.testing.assert_array_equal(old, new)


def test_smoothing_takes_jitter_out_and_leaves_straight_ways_and_the_start() -> None:
    motion = steered_cube(60)
    rng = np.random.default_rng(2)
    jitter = motion.pose + rng.normal(0.0, 0.002, motion.pose.shape)
    smooth = replace(motion, pose=jitter).smoothed(0.1).pose
    np.testing.assert_array_equal(smooth[0], jitter[0])
    middle = slice(12, 48)  # At the last frame there is nothing to average with.
    left = np.abs(smooth - motion.pose)[middle].std() / np.abs(jitter - motion.pose)[middle].std()
    assert 0.2 < left < 0.6  # A Gaussian of three frames keeps 0.31 of white noise.
    np.testing.assert_allclose(motion.smoothed(0.1).pose[middle], motion.pose[middle], atol=2e-5)
    assert motion.smoothed(0.0) is motion
    # A hand that turns beyond half a turn does not spin back.
    pose = np.zeros((60, 2, POSE))
    pose[:, 0, 5] = (np.linspace(0, 1.5 * np.pi, 60) + np.pi) % (2 * np.pi) - np.pi
    steps = np.diff(np.unwrap(replace(motion, pose=pose).smoothed(0.1).pose[:, 0, 5]))
    assert 0.0 < steps.min() <= steps.max() < 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pose": np.full((2, 2, POSE), np.nan)}, "pose is not finite at frame 0, hand 0"),
        ({"pose": np.zeros((2, 1, POSE))}, "at least one frame, 2 hands and 27 numbers"),
        ({"pose": np.zeros((0, 2, POSE))}, "at least one frame"),
        ({"control": np.zeros((3, 3), np.float32)}, r"expected \(frames, 4, 3\)"),
    ],
)
def test_what_does_not_fit_is_refused(change, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(steered_cube(), **change)


def test_hands_of_the_same_or_unknown_control_nodes_are_refused() -> None:
    motion = steered_cube()
    for numbers in ([0, 0], [4], [-1]):
        hand = SteeredHand(name="right", control=np.array(numbers), wrist=np.zeros(3))
        with pytest.raises(ValueError, match="must name different control nodes"):
            replace(motion, hands=(hand,), pose=np.zeros((1, 1, POSE)))
    with pytest.raises(ValueError, match="frames 3 to 6 are not among the 6"):
        motion.part(3, 6, next(motion.simulate()))
    tensors = motion.to_tensors()
    del tensors["wrist"]
    with pytest.raises(ValueError, match="A take needs the arrays"):
        SteeredMotion.from_tensors(tensors, motion.parameters)


def test_rotations_follow_one_another_about_the_axes_of_the_world() -> None:
    quarter = np.pi / 2
    both = turn_on(np.array([quarter, 0.0, 0.0]), np.array([0.0, 0.0, quarter]))
    expected = rotation(2, quarter) @ rotation(0, quarter)
    hand = SteeredHand(name="right", control=np.array([0]), wrist=np.zeros(3))
    moved = hand.moved(np.eye(3), np.concatenate([np.zeros(3), both, np.zeros(POSE - 6)]))
    np.testing.assert_allclose(moved, expected.T, atol=1e-12)
    start = np.array([0.3, -0.2, 0.1])
    np.testing.assert_allclose(turn_on(start, turn_between(start, both)), both, atol=1e-12)
    np.testing.assert_allclose(
        to_quaternion(np.array([0.0, 0.6, 0.0])), [np.cos(0.3), 0, np.sin(0.3), 0]
    )
    np.testing.assert_allclose(from_quaternion(3.0 * to_quaternion(both)), both)


def test_points_belong_to_the_surface_whose_vertex_is_nearest() -> None:
    surfaces = [np.array([[0.0, 0, 0], [5, 0, 0]]), np.array([[2.0, 0, 0]])]
    point = np.array([[0.9, 0, 0], [1.1, 0, 0], [4, 0, 0], [2, 3, 0]])
    assert nearest_surface(point, surfaces).tolist() == [0, 1, 0, 1]
