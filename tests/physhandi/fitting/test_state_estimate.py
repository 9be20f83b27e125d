"""The state in the last observed frame, worked out node by node in float64."""

from dataclasses import replace

import numpy as np
import pytest
from reference.scenes import as_model, bare_scene, cube_scene
from reference.spring_mass import simulate

from physhandi.data.observation import ObjectObservation
from physhandi.errors import MissingInputError
from physhandi.fitting.observed.state_estimate import observed_state
from physhandi.simulation.simulator import Simulator

LAST = 2
SCENE = cube_scene()


def observed(shift: np.ndarray, **changes) -> ObjectObservation:
    """The nodes of the oracle, moved by `shift` in the last frame and nonsense after it."""
    point = simulate(SCENE)[0].astype(np.float32)
    point[LAST] += shift.astype(np.float32)
    point[LAST + 1 :] += 7.0
    seen = np.ones(point.shape[:2], bool)
    fields = {"is_visible": seen, "is_motion_valid": seen, "node_of_track": np.arange(8)}
    return ObjectObservation(**({"point": point} | fields | changes))


def estimate(observation: ObjectObservation, frame: int = LAST):
    model, parameters = as_model(SCENE)
    return observed_state(model, parameters, SCENE.control, observation, frame)


def test_a_node_that_is_seen_is_where_it_is_seen_and_moves_as_it_did() -> None:
    shift = np.random.default_rng(1).normal(0, 0.004, (8, 3))
    shift[:, 2] = np.abs(shift[:, 2])
    position = simulate(SCENE)[0]
    found = estimate(observed(shift))
    assert found.frame == LAST
    np.testing.assert_allclose(found.position, position[LAST] + shift, atol=2e-6)
    # The line that fits three points best is as steep as the one through the outer two.
    mean = (position[LAST] + shift - position[0]) / 2.0 * SCENE.frame_rate
    np.testing.assert_allclose(found.velocity, mean, atol=1e-4)
    assert np.abs(mean).max() > 0.1
    # The frame before shows no residual.
    np.testing.assert_allclose(
        estimate(observed(shift), LAST - 1).position, position[LAST - 1], atol=2e-6
    )
    assert np.abs(position[LAST] - position[LAST - 1]).max() > 1e-3


def test_a_node_that_is_not_seen_takes_the_mean_of_the_tracks_around_it() -> None:
    shift = np.random.default_rng(2).uniform(0.001, 0.006, (8, 3))
    seen = np.ones((4, 8), bool)
    seen[LAST, [2, 5]] = False
    found = estimate(observed(shift, is_visible=seen))
    position = simulate(SCENE)[0]
    for node in (2, 5):
        total, weights = np.zeros(3), 0.0
        for track in (0, 1, 3, 4, 6, 7):
            weight = 1.0 / (np.linalg.norm(SCENE.node[node] - SCENE.node[track]) + 1e-6)
            total += weight * shift[track]
            weights += weight
        np.testing.assert_allclose(
            found.position[node], position[LAST, node] + total / weights, atol=2e-6
        )


def test_the_velocity_is_that_of_three_frames_whatever_the_rollout_does() -> None:
    random = np.random.default_rng(3)
    node = random.uniform(0.1, 0.2, (4, 3))
    point = (node + random.normal(0, 0.01, (9, 4, 3))).astype(np.float32)
    point[0] = node
    seen = np.ones((9, 4), bool)
    observation = ObjectObservation(
        point=point, is_visible=seen, is_motion_valid=seen, node_of_track=np.arange(4)
    )
    scene = bare_scene(node, velocity=np.full((4, 3), 3.0), frames=9)
    model, parameters = as_model(scene)
    found = observed_state(model, parameters, scene.control, observation, 7)
    slope = np.polyfit(np.arange(5, 8) / scene.frame_rate, point[5:8].reshape(3, -1), 1)[0]
    np.testing.assert_allclose(found.velocity, slope.reshape(4, 3), atol=1e-4)
    assert np.abs(slope).max() > 0.05


def test_the_velocity_is_the_rollouts_if_the_frame_before_shows_no_track() -> None:
    seen = np.ones((4, 8), bool)
    seen[LAST - 1] = False
    found = estimate(observed(np.full((8, 3), 0.002), is_visible=seen))
    np.testing.assert_allclose(found.velocity, simulate(SCENE)[1][LAST], atol=5e-6)


def test_no_node_is_seen_below_the_ground_and_springs_go_on_from_beside() -> None:
    found = estimate(observed(np.full((8, 3), -1.0)))
    assert found.position[:, 2].tolist() == [0.0] * 8
    assert found.position[:, 0].max() < -0.5
    position = simulate(SCENE)[0]
    np.testing.assert_allclose(
        found.node_shift(position[LAST]), found.position - position[LAST], atol=2e-6
    )
    # What is flatter now than in frame 0 is seen lower than where it touched the ground then.
    model, parameters = as_model(SCENE)
    thick = replace(model, clearance=np.full(8, 0.5, np.float32))
    low = np.tile([0.0, 0.0, 0.2], (8, 1)) - simulate(SCENE)[0][LAST]
    found = observed_state(thick, parameters, SCENE.control, observed(low), LAST)
    own = Simulator(thick, parameters).rollout(SCENE.control[: LAST + 1]).position[LAST]
    assert own[:, 2].min() > 0.5 - 1e-6
    np.testing.assert_allclose(found.position[:, 2], 0.2, atol=2e-5)


def test_strain_is_averaged_over_a_time() -> None:
    model, parameters = as_model(SCENE)
    shift = observed(np.full((8, 3), 0.002))
    rate = parameters.simulated_frame_rate
    for time, frames in ((0.0, 1), (0.4 / rate, 1), (2.6 / rate, 3), (0.5, round(0.5 * rate))):
        found = observed_state(model, parameters, SCENE.control, shift, LAST, strain_time=time)
        assert found.strain_frames == frames
        assert found.averages_in_air


def test_grips_share_some_times_the_weight_of_the_object() -> None:
    model, parameters = as_model(SCENE)
    shift = observed(np.full((8, 3), 0.002))
    found = observed_state(model, parameters, SCENE.control, shift, LAST, grip_strength=3.0)
    # Eight nodes of 1 kg, held by five springs.
    assert found.grip_strength == pytest.approx(3.0 * 8 * 9.81 / 5)
    attached = np.array([[0, 99], [0, 99], [0, 1], [0, 99], [LAST, 99]], np.int32)
    fewer = replace(model, attached=attached)
    found = observed_state(fewer, parameters, SCENE.control, shift, LAST, grip_strength=3.0)
    assert found.grip_strength == pytest.approx(3.0 * 8 * 9.81 / 3)
    assert estimate(shift).grip_strength == 0.0


FORCE, FRICTION, PACE = 2.0, 0.8, 0.06
"""What pulls a weight of 1 kg over the ground [N], friction that holds it, and how fast it is seen
to slide nevertheless [m/s]."""


def dragged(
    friction: float = FRICTION,
    pace: float = PACE,
    pull: float = FORCE,
    lifted: int = 0,
    still: int = 0,
    frames: int = 9,
    jerk: float = 0.0,
) -> tuple[float, np.ndarray]:
    """Give the friction that is left for a weight on the ground, and where it goes with that.

    A hand pulls it by a soft spring and moves as fast as it is seen to slide; at first by `jerk`
    more, of which it slips. Other weights are in the air, or are seen to lie still.
    """
    rate, last = 30.0, 4
    node = np.zeros((1 + still + lifted, 3))
    node[:, 1] = np.arange(len(node))
    node[1 + still :, 2] = 0.3
    time = np.arange(frames) / rate
    control = np.zeros((frames, 1, 3))
    control[:, 0, 0] = 1.0 + pull / 40.0 + pace * (time - last / rate)
    control[:3, 0, 0] += jerk / 40.0
    scene = bare_scene(
        node,
        springs=[[0, len(node)]],
        rest=[1.0],
        stiffness=[40.0],
        damping=[0.0],
        control=control,
        ground=0.0,
        gravity=9.81,
        restitution=0.0,
        friction=friction,
        frame_rate=rate,
    )
    point = np.zeros((frames, *node.shape), np.float32)
    point[:] = node
    point[:, 0, 0] = pace * np.maximum(time - 1 / rate, 0.0)
    seen = np.ones(point.shape[:2], bool)
    observation = ObjectObservation(
        point=point, is_visible=seen, is_motion_valid=seen, node_of_track=np.arange(len(node))
    )
    model, parameters = as_model(scene)
    found, held = (
        observed_state(model, parameters, control, observation, last, keeps_sliding=keeps)
        for keeps in (True, False)
    )
    assert held.friction_share == 1.0
    np.testing.assert_array_equal(found.position, held.position)
    position = Simulator(model, parameters).rollout(control, found).position
    slips = jerk > 0.0 or friction < 0.3
    np.testing.assert_allclose(position[: last + 1, 0, 0], 0.0, atol=1.0 if slips else 1e-4)
    return found.friction_share, position[last:, 0, 0] - point[last, 0, 0]


def test_what_is_seen_to_slide_slides_on_with_the_friction_that_its_pull_overcomes() -> None:
    share, way = dragged()
    # Friction that is as large as the pull lets it go on as fast as it was; the interval that is
    # searched is halved six times.
    assert share == pytest.approx(FORCE / (9.81 * FRICTION), rel=0.06)
    np.testing.assert_allclose(way[1:4], PACE * np.arange(1, 4) / 30.0, atol=6e-4)
    assert way[3] > 0.005


@pytest.mark.parametrize(
    "settings",
    [
        {"pace": 0.01},  # As slow as tracks of what lies still.
        {"friction": 0.1},  # It slides by itself.
        {"lifted": 10},  # Next to nothing of it lies.
        {"still": 2, "pace": 0.2},  # Most of what lies is seen to lie still.
        {"pull": -FORCE},  # The hand pulls it back, so it is no friction that holds it.
        {"frames": 5},  # Nothing is to be predicted.
    ],
    ids=["slow", "slides", "lifted", "still", "back", "last"],
)
def test_friction_stays_where_nothing_tells_that_there_is_less(settings) -> None:
    assert dragged(**settings)[0] == 1.0


def test_what_sticks_for_a_moment_and_has_slipped_before_is_not_stuck() -> None:
    slipped, stuck = (dragged(jerk=jerk) for jerk in (10.0, 5.0))
    # 5 N more do not overcome friction, 10 N more do.
    assert slipped[0] == 1.0
    assert stuck[0] == dragged()[0] < 0.5
    # It stands still when prediction begins, and would with all of its friction.
    np.testing.assert_allclose(np.diff(slipped[1][1:4]), 0.0, atol=1e-4)


def test_the_least_friction_is_left_where_it_holds_too_much_still() -> None:
    # A hand that goes along beside it without a pull: any friction makes it slower.
    share, way = dragged(pace=0.5, pull=0.0, friction=2.0)
    assert share == 1.0 / 32.0
    time = 3 / 30.0
    assert way[3] == pytest.approx(0.5 * time - 0.5 * 2.0 * share * 9.81 * time**2, abs=5e-4)


def test_without_a_track_there_is_no_state() -> None:
    seen = np.ones((4, 8), bool)
    seen[LAST] = False
    with pytest.raises(MissingInputError, match="frame 2 shows no track"):
        estimate(observed(np.zeros((8, 3)), is_visible=seen))
