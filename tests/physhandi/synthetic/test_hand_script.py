import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physhandi.synthetic.hands.script import HandMove, HandScript, Tremor, minimum_jerk
from physhandi.synthetic.hands.true_hand import BONE_COUNT, TrueHandPose


def key(x: float, *, turn: float = 0.0, flexion: float = 0.0) -> TrueHandPose:
    bend = np.zeros((BONE_COUNT, 3))
    bend[4, 0] = flexion
    return TrueHandPose(
        orientation=np.array([0.0, 0.0, turn]), position=np.array([x, 0.0, 0.1]), bend=bend
    )


def still() -> Tremor:
    return Tremor(np.random.default_rng(0), level=0.0)


def test_minimum_jerk_is_the_polynomial_without_speed_and_acceleration_at_its_ends():
    time = np.linspace(0.2, 0.7, 2001)
    move = minimum_jerk(time, 0.2, 0.7)
    speed = np.gradient(move, time)
    acceleration = np.gradient(speed, time)
    assert (move[0], move[-1]) == (0, 1)
    assert speed.max() == pytest.approx(1.875 / 0.5, rel=1e-3)
    assert abs(acceleration[3]) < 0.02 * np.abs(acceleration).max()


def test_it_goes_from_pose_to_pose_and_waits_in_between():
    moves = [
        HandMove(-1.0, 0.0, (key(0.0), key(0.2, turn=0.6, flexion=1.0))),
        HandMove(1.0, 2.0, (key(0.2, turn=0.6, flexion=1.0), key(-0.1))),
    ]
    script = HandScript("left", moves, still())
    assert (script.side, script.begin, script.end) == ("left", -1.0, 2.0)
    assert script.at(-3.0).position[0] == 0
    middle = script.at(-0.5)
    assert middle.position[0] == pytest.approx(0.1)
    assert middle.orientation[2] == pytest.approx(0.3)
    assert middle.bend[4, 0] == pytest.approx(0.5)
    assert script.at(-0.75).position[0] == pytest.approx(
        0.2 * minimum_jerk(np.array([0.25]), 0, 1)[0]
    )
    for time in (0.0, 0.5, 1.0):
        assert script.at(time).position[0] == pytest.approx(0.2)
    assert script.at(5.0).position[0] == pytest.approx(-0.1)


def test_a_move_passes_smoothly_through_all_its_poses():
    angles = np.linspace(0, 1.2, 9)
    poses = [
        TrueHandPose(
            orientation=np.array([0.0, angle, 0.0]),
            position=0.1 * np.array([1 - np.cos(angle), 0.0, np.sin(angle)]),
            bend=np.zeros((BONE_COUNT, 3)),
        )
        for angle in angles
    ]
    script = HandScript("right", [HandMove(0.0, 1.0, poses)], still())
    times = np.linspace(0, 1, 50)
    phase = minimum_jerk(times, 0.0, 1.0)
    for time, angle in zip(times, 1.2 * phase, strict=True):
        at = script.at(float(time))
        circle = [1 - np.cos(angle), 0.0, np.sin(angle)]
        assert at.position == pytest.approx(0.1 * np.array(circle), abs=2e-5)
        assert at.orientation[1] == pytest.approx(angle, abs=1e-4)


def test_tremor_is_a_third_of_a_millimetre_around_six_hertz():
    script = HandScript(
        "right", [HandMove(-1.0, 0.0, (key(0.0), key(0.0)))], Tremor(np.random.default_rng(3))
    )
    times = np.arange(0, 20, 1 / 50)
    place = np.array([script.at(float(time)).position for time in times])
    place -= place.mean(axis=0)
    assert np.sqrt((place**2).mean()) == pytest.approx(0.0003, rel=0.25)
    power = np.abs(np.fft.rfft(place, axis=0)) ** 2
    frequency = np.fft.rfftfreq(len(times), 1 / 50)
    band = (frequency > 4) & (frequency < 8)
    assert power[band].sum() > 0.99 * power.sum()
    bends = np.array([script.at(float(time)).bend for time in times[:100]])
    assert not bends[:, 0].any()
    assert bends[:, 1:, 0].std() == pytest.approx(0.004, rel=0.3)


def test_tremor_comes_from_the_seed_alone():
    def turn(seed: int) -> np.ndarray:
        tremor = Tremor(np.random.default_rng(seed))
        return (
            HandScript("right", [HandMove(-1.0, 1.0, (key(0.0), key(0.3, turn=2.0)))], tremor)
            .at(0.4)
            .orientation
        )

    assert np.array_equal(turn(8), turn(8))
    apart = Rotation.from_rotvec(turn(8)) * Rotation.from_rotvec(turn(9)).inv()
    assert 0 < apart.magnitude() < 0.03


@pytest.mark.parametrize(
    ("moves", "message"),
    [
        ([], "needs moves"),
        ([HandMove(1.0, 1.0, (key(0.0), key(1.0)))], "needs moves"),
        ([HandMove(0.0, 1.0, (key(0.0),)), HandMove(0.5, 2.0, (key(0.0),))], "overlap"),
    ],
)
def test_scripts_without_a_timeline_are_refused(moves: list[HandMove], message: str):
    with pytest.raises(ValueError, match=message):
        HandScript("right", moves, still())
