"""A rollout that continues from another state: against the oracle, closed forms and bits."""

import math
from dataclasses import replace

import numpy as np
import pytest
from reference.scenes import as_model, cube_scene
from reference.spring_mass import Scene, simulate

from physhandi.simulation.contact_intervals import NEVER
from physhandi.simulation.forces import spring_strains
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.restart import Restart
from physhandi.simulation.simulator import Simulator

AT = 2
GRAVITY, STIFFNESS = 9.81, 50.0
HANGING = 1.0 + GRAVITY / STIFFNESS
"""Length at which a spring of 1 m that holds 1 kg is at rest [m]."""


def another_state(scene: Scene, frame: int = AT) -> Restart:
    rng = np.random.default_rng(5)
    node = simulate(scene)[0][frame] + rng.normal(0, 0.003, scene.node.shape)
    node[:, 2] = np.maximum(node[:, 2], 0.001)
    velocity = rng.normal(0, 0.1, node.shape)
    state = {"position": node.astype(np.float32), "velocity": velocity.astype(np.float32)}
    return Restart(frame=frame, **state)


def continued_oracle(scene: Scene, restart: Restart, frame: int = AT) -> np.ndarray:
    """Simulate the frames after a restart in float64, with rest lengths scaled by their ratio."""
    first, second = scene.springs.T

    def lengths(node: np.ndarray, at: int) -> np.ndarray:
        point = np.vstack([node, scene.control[at]])
        return np.sqrt(((point[second] - point[first]) ** 2).sum(axis=1))

    motion = simulate(scene)[0]
    own, frames = motion[frame], range(frame + 1 - restart.strain_frames, frame + 1)
    before = np.mean([lengths(motion[at], at) for at in frames], axis=0)
    ratio = np.maximum(lengths(restart.position.astype(float), frame) / before, 0.64)
    later = replace(
        scene,
        node=restart.position.astype(float),
        velocity=restart.velocity.astype(float),
        rest=scene.rest * ratio,
        control=scene.control[frame:],
        clearance=np.where(own[:, 2] < 0.003, restart.position[:, 2].astype(float), 0.0),
        rest_shape=scene.node,
    )
    return (
        slipping_oracle(later, restart.grip_strength)
        if restart.grip_strength
        else simulate(later)[0]
    )


def slipping_oracle(scene: Scene, strength: float) -> np.ndarray:
    """Simulate one frame after the other in float64; springs of controls slip between them."""
    motion, is_virtual = [scene.node], scene.springs.max(axis=1) >= len(scene.node)
    for frame in range(1, len(scene.control)):
        position, velocity = simulate(replace(scene, control=scene.control[frame - 1 : frame + 1]))
        motion.append(position[1])
        point = np.vstack([position[1], scene.control[frame]])
        rest = scene.rest.copy()
        for spring in np.flatnonzero(is_virtual):
            length = math.dist(*point[scene.springs[spring]])
            tension = scene.stiffness[spring] * (length - rest[spring]) / rest[spring]
            if abs(tension) > strength:
                bears = math.copysign(strength, tension)
                rest[spring] = length / (1.0 + bears / scene.stiffness[spring])
        scene = replace(scene, node=position[1], velocity=velocity[1], rest=rest)
    return np.stack(motion)


@pytest.mark.parametrize("distance", [None, 0.002], ids=["engine", "self_collision"])
def test_frames_after_a_restart_agree_with_the_oracle(device: str, distance: float | None) -> None:
    scene = cube_scene(distance=distance)
    restart = another_state(scene)
    rollout = Simulator(*as_model(scene), device=device).rollout(scene.control, restart)
    before, after = simulate(scene)[0], continued_oracle(scene, restart)
    np.testing.assert_allclose(rollout.position[: AT + 1], before[: AT + 1], atol=2e-7)
    np.testing.assert_allclose(rollout.position[AT + 1 :], after[1:], atol=1e-6)
    # One frame too early or too late would be seen, and so would rest lengths that are not scaled.
    unscaled = replace(scene, rest=scene.rest * 0.99)
    averaged = continued_oracle(scene, replace(restart, strain_frames=2))[1:]
    for wrong in (before[AT + 1 :], continued_oracle(unscaled, restart)[1:], averaged):
        assert np.abs(rollout.position[AT + 1 :] - wrong).max() > 1e-4
    early = continued_oracle(scene, restart, AT - 1)
    assert np.abs(rollout.position[AT + 1] - early[1]).max() > 1e-4


def test_strain_that_is_averaged_agrees_with_the_oracle(device: str) -> None:
    scene = cube_scene()
    restart = replace(another_state(scene), strain_frames=2)
    rollout = Simulator(*as_model(scene), device=device).rollout(scene.control, restart)
    after = continued_oracle(scene, restart)
    np.testing.assert_allclose(rollout.position[AT + 1 :], after[1:], atol=1e-6)
    # A frame without one before it: the strain of those that there are.
    early, late = (replace(restart, strain_frames=n) for n in (AT + 1, 100))
    assert early.strained_frames == late.strained_frames == range(AT + 1)
    first, second = (
        Simulator(*as_model(scene), device=device).rollout(scene.control, each)
        for each in (early, late)
    )
    np.testing.assert_array_equal(first.position, second.position)
    assert np.abs(first.position[AT + 1 :] - rollout.position[AT + 1 :]).max() > 1e-4


def test_springs_go_on_beside_where_nodes_are_seen(device: str) -> None:
    scene = cube_scene()
    restart = replace(another_state(scene), strain_frames=2, shifts_nodes=True)
    model, parameters = as_model(scene)
    rollout = Simulator(model, parameters, device=device).rollout(scene.control, restart)
    before = simulate(scene)[0]
    # The oracle goes on from the rollout's own nodes; what is seen is as far beside as it was.
    shift = restart.position - before[AT]
    after = continued_oracle(scene, replace(restart, position=before[AT].astype(np.float32)))
    np.testing.assert_allclose(rollout.position[: AT + 1], before[: AT + 1], atol=2e-7)
    np.testing.assert_allclose(rollout.position[AT + 1 :], after[1:] + shift, atol=1e-6)
    moved = Simulator(model, parameters, device).rollout(
        scene.control, replace(restart, shifts_nodes=False)
    )
    for wrong in (after[1:], moved.position[AT + 1 :], before[AT + 1 :] + shift):
        assert np.abs(rollout.position[AT + 1 :] - wrong).max() > 1e-4
    assert replace(restart, shifts_nodes=False).node_shift(before[AT]) is None


def test_a_weight_that_is_seen_beside_where_it_hangs_does_not_swing(device: str) -> None:
    model, parameters, control = hanging()
    beside = model.object_node + np.float32([0.1, 0.0, 0.02])
    restart = Restart(frame=AT, position=beside, velocity=np.zeros((1, 3), np.float32))
    simulator = Simulator(model, parameters, device)
    swings = simulator.rollout(control, restart).position
    still = simulator.rollout(control, replace(restart, shifts_nodes=True)).position
    np.testing.assert_allclose(still[AT + 1 :], beside[None].repeat(3, axis=0), atol=1e-6)
    # A turned spring pulls it back by m g x / L on its first way.
    length = np.hypot(0.1, HANGING - 0.02)
    pull = GRAVITY * 0.1 / length * parameters.frame_rate**-2
    assert beside[0, 0] - swings[AT + 1, 0, 0] == pytest.approx(pull, rel=0.02)


def test_every_strain_is_kept() -> None:
    scene = cube_scene()
    model, parameters = as_model(scene)
    restart, own = another_state(scene), simulate(scene)[0][AT]
    control = scene.control[AT]
    later = restart.continued(model, parameters, own[None], control[None])
    expected = spring_strains(model, own, control)
    assert np.abs(expected).max() > 0.05
    np.testing.assert_allclose(
        spring_strains(later, restart.position, control), expected, rtol=1e-6, atol=1e-6
    )
    assert np.abs(spring_strains(model, restart.position, control) - expected).max() > 0.05
    for name in ("stiffness", "damping", "spring_nodes"):
        assert getattr(later, name) is getattr(model, name)


def test_a_spring_is_averaged_over_the_frames_in_which_it_acts() -> None:
    still = np.zeros((1, 3), np.float32)
    model = SpringMassModel(
        object_node=still,
        initial_velocity=still,
        spring_nodes=np.array([[0, 1], [0, 2], [0, 3]], np.int32),
        rest_length=np.ones(3, np.float32),
        stiffness=np.ones(3, np.float32),
        damping=np.ones(3, np.float32),
        object_spring_count=0,
        control_count=3,
        # The second one pulls on the ways to frames 3 and 4 only, the third up to frame 3.
        attached=np.array([[0, NEVER], [2, NEVER], [0, 3]], np.int32),
    )
    stretch = np.array([[1.1, 1.1, 1.1], [1.2, 1.2, 1.2], [1.6, 1.6, 1.6], [1.8, 1.8, 1.8]])
    control = stretch[:, :, None] * np.eye(3)
    restart = Restart(frame=4, position=still, velocity=still, strain_frames=4)
    parameters = SimulationParameters(virtual_rest_length_floor=0.0)
    later = restart.continued(model, parameters, np.zeros((4, 1, 3)), control)
    mean = [np.mean([1.1, 1.2, 1.6, 1.8]), np.mean([1.6, 1.8]), 1.8]
    np.testing.assert_allclose(later.rest_length, 1.8 / np.array(mean), rtol=1e-6)


def test_strain_of_what_lies_on_the_ground_is_that_of_the_moment() -> None:
    # Four nodes in a row, of which the first two lie; springs between neighbors, then two virtual
    # ones, of a node that lies and of one that does not.
    row = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 1], [3, 0, 1]], np.float32)
    model = SpringMassModel(
        object_node=row,
        initial_velocity=np.zeros_like(row),
        spring_nodes=np.array([[0, 1], [1, 2], [2, 3], [0, 4], [3, 5]], np.int32),
        rest_length=np.ones(5, np.float32),
        stiffness=np.ones(5, np.float32),
        damping=np.ones(5, np.float32),
        object_spring_count=3,
        control_count=2,
    )
    control = np.array([[0, 1, 0], [3, 1, 1]], float)
    first = row * [1.0, 1, 1] + [0.5, 0, 0] * np.arange(4)[:, None]  # Stretched along the row.
    places, hands = np.stack([first, row]), np.stack([control, control * [1, 1.4, 1]])
    restart = Restart(
        frame=3,
        position=row,
        velocity=row,
        strain_frames=2,
        averages_in_air=True,
        shifts_nodes=True,
    )
    parameters = SimulationParameters(
        ground_height=0.0, rest_length_floor=0.0, virtual_rest_length_floor=0.0
    )
    strains = [spring_strains(model, *place) for place in zip(places, hands, strict=True)]
    assert np.abs(strains[1] - strains[0]).min() > 0.2
    kept = np.where([1, 0, 0, 1, 0], strains[1], np.mean(strains, axis=0))
    later = restart.continued(model, parameters, places, hands)
    np.testing.assert_allclose(spring_strains(later, row, hands[1]), kept, rtol=1e-6)
    # Where nothing lies, or where all springs are averaged.
    mean = np.mean(strains, axis=0)
    for other, ground in ((restart, None), (replace(restart, averages_in_air=False), 0.0)):
        later = other.continued(model, parameters.replace(ground_height=ground), places, hands)
        np.testing.assert_allclose(spring_strains(later, row, hands[1]), mean, rtol=1e-6)


def loose_nodes(node: np.ndarray) -> SpringMassModel:
    """Nodes at rest that nothing joins or holds."""
    return SpringMassModel(
        object_node=node,
        initial_velocity=np.zeros_like(node),
        spring_nodes=np.zeros((0, 2), np.int32),
        rest_length=np.zeros(0, np.float32),
        stiffness=np.zeros(0, np.float32),
        damping=np.zeros(0, np.float32),
        object_spring_count=0,
        control_count=0,
    )


def hanging() -> tuple[SpringMassModel, SimulationParameters, np.ndarray]:
    """1 kg that hangs at rest below a control node, and controls for six frames."""
    model = SpringMassModel(
        object_node=np.array([[0.0, 0.0, -HANGING]], np.float32),
        initial_velocity=np.zeros((1, 3), np.float32),
        spring_nodes=np.array([[0, 1]], np.int32),
        rest_length=np.ones(1, np.float32),
        stiffness=np.full(1, STIFFNESS, np.float32),
        damping=np.zeros(1, np.float32),
        object_spring_count=0,
        control_count=1,
    )
    parameters = SimulationParameters(
        drag=0.0,
        gravity=GRAVITY,
        ground_height=None,
        uses_sequence_ground=False,
        frame_rate=1000.0,
        substeps_per_frame=1,
    )
    return model, parameters, np.zeros((6, 1, 3), np.float32)


def test_a_spring_under_tension_restarts_without_a_kick(device: str) -> None:
    model, parameters, control = hanging()
    lower = model.object_node - np.float32([0.0, 0.0, 0.1])
    restart = Restart(frame=AT, position=lower, velocity=np.zeros((1, 3), np.float32))
    simulator = Simulator(model, parameters, device)
    rollout = simulator.rollout(control, restart)
    assert np.abs(rollout.position[: AT + 1] - model.object_node).max() < 1e-6
    assert np.abs(rollout.position[AT + 1 :] - lower).max() < 1e-6
    # With the old rest length 0.1 m more pull by 50 N/m · 0.1 m: 5 m/s² for a millisecond.
    simulator.reset(lower)
    simulator.step_frame(1, control[0], control[1])
    assert simulator.velocity.numpy()[0] == pytest.approx([0.0, 0.0, 5e-3], rel=1e-3, abs=1e-9)


def test_a_weight_that_swings_goes_on_with_what_it_bears_on_average(device: str) -> None:
    model, parameters, _ = hanging()
    period = 20
    # ω = √(k/m): a frame is a twentieth of the time in which it swings, and starts 0.1 m too low.
    rate = period * np.sqrt(STIFFNESS) / (2.0 * np.pi)
    parameters = parameters.replace(frame_rate=rate, substeps_per_frame=400)
    low = model.object_node - np.float32([0.0, 0.0, 0.1])
    model = replace(model, object_node=low)
    still = {"position": low, "velocity": np.zeros_like(low)}
    of_moment, of_mean = (
        Restart(frame=period, strain_frames=frames, **still) for frames in (1, period)
    )
    control = np.zeros((period + 6, 1, 3), np.float32)
    simulator = Simulator(model, parameters, device)
    kept, kicked = (simulator.rollout(control, each).position for each in (of_mean, of_moment))
    assert kept[period // 2, 0, 2] == pytest.approx(-HANGING + 0.1, abs=1e-3)
    np.testing.assert_allclose(kept[period + 1 :], low[None].repeat(5, axis=0), atol=1e-3)
    # With the strain of the last frame it is pulled by 5 N too much: it swings up by 0.1 (1 - cos).
    assert kicked[period + 5, 0, 2] - low[0, 2] == pytest.approx(0.1, abs=2e-3)


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["pulled", "pressed"])
def test_a_grip_slips_and_bears_what_it_is_strong_enough_for(device: str, side: float) -> None:
    model, parameters, _ = hanging()
    # The same weight also stands on a spring of 1 m, which it makes as much shorter.
    node = np.float32([[0.0, 0.0, -HANGING if side > 0 else 2.0 - HANGING]])
    model = replace(model, object_node=node)
    restart = Restart(frame=AT, position=node, velocity=np.zeros_like(node))
    control = np.zeros((100, 1, 3), np.float32)
    simulator = Simulator(model, parameters, device)

    def falls(strength: float) -> np.ndarray:
        rollout = simulator.rollout(control, replace(restart, grip_strength=strength))
        return (node[0, 2] - rollout.position[AT:, 0, 2]).astype(float)

    np.testing.assert_allclose(falls(10.0), 0.0, atol=2e-6)
    np.testing.assert_array_equal(falls(10.0), falls(0.0))
    # It bears all of the weight for one more millisecond, and then 4 N of 9.81.
    time = 1e-3 * np.maximum(np.arange(len(control) - AT) - 1, 0)
    expected = 0.5 * (GRAVITY - 4.0) * time * (time + 1e-3)
    assert expected[-1] > 0.02
    np.testing.assert_allclose(falls(4.0), expected, rtol=0.02, atol=1e-5)
    assert not np.allclose(falls(3.0), expected, rtol=0.1)


def test_after_a_restart_a_part_of_the_friction_is_left_and_before_it_all(device: str) -> None:
    node = np.zeros((1, 3), np.float32)
    model = replace(loose_nodes(node), initial_velocity=np.float32([[1.0, 0.0, 0.0]]))
    parameters = SimulationParameters(
        drag=0.0,
        restitution=0.0,
        friction=0.4,
        gravity=GRAVITY,
        ground_height=0.0,
        frame_rate=100.0,
        substeps_per_frame=100,
    )
    control = np.zeros((12, 0, 3), np.float32)
    simulator = Simulator(model, parameters, device)
    firm = simulator.rollout(control).position
    restart = Restart(
        frame=5, position=firm[5], velocity=model.initial_velocity, friction_share=0.25
    )
    smoother = simulator.rollout(control, restart).position
    again = simulator.rollout(control).position
    np.testing.assert_array_equal(again, firm)
    time = np.arange(7) / 100.0
    for way, friction, start in ((firm, 0.4, 0), (smoother, 0.1, 5)):
        expected = time - 0.5 * friction * GRAVITY * time**2
        moved = way[start : start + 7, 0, 0] - way[start, 0, 0]
        np.testing.assert_allclose(moved, expected, atol=1e-4)
    np.testing.assert_array_equal(smoother[:6], firm[:6])
    assert expected[-1] - (time[-1] - 0.5 * 0.4 * GRAVITY * time[-1] ** 2) > 4e-3


def test_frames_in_which_grips_slip_agree_with_the_oracle(device: str) -> None:
    scene = cube_scene()
    rigid = another_state(scene, 0)
    restart = replace(rigid, grip_strength=2.0)
    rollout = Simulator(*as_model(scene), device=device).rollout(scene.control, restart)
    expected, held = (continued_oracle(scene, each, 0) for each in (restart, rigid))
    np.testing.assert_allclose(rollout.position[1:], expected[1:], atol=2e-6)
    # They slip at the end of a frame: the first one is the same.
    np.testing.assert_allclose(held[1], expected[1], atol=1e-12)
    assert np.abs(held[2:] - expected[2:]).max(axis=(1, 2)).min() > 1e-4
    for other in (1.8, 2.2):
        wrong = continued_oracle(scene, replace(rigid, grip_strength=other), 0)
        assert np.abs(wrong - expected).max() > 2e-5


def test_rest_lengths_are_such_that_a_grip_bears_its_strength() -> None:
    node = np.zeros((2, 3), np.float32)
    model = SpringMassModel(
        object_node=node,
        initial_velocity=node,
        spring_nodes=np.array([[0, 1], [0, 2], [0, 3], [1, 2], [0, 4], [1, 5]], np.int32),
        rest_length=np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0], np.float32),
        stiffness=np.array([50.0, 25.0, 25.0, 25.0, 25.0, 25.0], np.float32),
        damping=np.ones(6, np.float32),
        object_spring_count=1,
        control_count=4,
        attached=np.array([[0, 99], [0, 99], [3, 99], [0, 99], [0, 99]], np.int32),
    )
    parameters = SimulationParameters(stiffness_scale=2.0)
    # Pulled by 10 N and pressed by 10; pulled by 4; and pulled by 10, but not attached yet.
    control = np.zeros((4, 3), np.float32)
    control[:, 0] = 1.2, 0.8, 1.08, 0.1
    restart = Restart(frame=0, position=node, velocity=node, grip_strength=5.0)
    place = np.float32([[0, 0, 0], [0, 0, 0]])
    now = np.ones(6, np.float32)
    later = restart.slipped(model, parameters, now, 1, place, control)
    tension = 50.0 * (np.abs(control[[0, 1, 2], 0]) / later[[1, 2, 4]] - 1.0)
    np.testing.assert_allclose(tension, [5.0, -5.0, 4.0], rtol=1e-5)
    assert later[[0, 3, 4]].tolist() == [1.0, 1.0, 1.0]
    # The last is pressed by 45 N: it may get no shorter than automatic substeps allow for.
    assert later[5] == pytest.approx(0.64)
    attached = restart.slipped(model, parameters, now, 4, place, control)
    assert attached[3] == pytest.approx(1.2 / 1.1)
    bound = replace(restart, grip_strength=0.0)
    assert bound.slipped(model, parameters, now, 4, place, control) is now


def test_what_follows_a_restart_is_the_same_bits_and_leaves_nothing_behind(device: str) -> None:
    scene = cube_scene()
    restart = another_state(scene)
    simulator = Simulator(*as_model(scene), device=device)
    plain = simulator.rollout(scene.control)
    first, second = (simulator.rollout(scene.control, restart) for _ in range(2))
    again = simulator.rollout(scene.control)
    for name in ("position", "velocity"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
        np.testing.assert_array_equal(getattr(again, name), getattr(plain, name))
        np.testing.assert_array_equal(
            getattr(first, name)[: AT + 1], getattr(plain, name)[: AT + 1]
        )
    assert np.abs(first.position[-1] - plain.position[-1]).max() > 1e-3
    shorter = simulator.rollout(scene.control[:AT], restart)
    np.testing.assert_array_equal(shorter.position, plain.position[:AT])


def test_rest_lengths_stay_above_their_bounds_and_coincident_nodes_keep_theirs() -> None:
    node = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0], [3, 0, 0]], np.float32)
    model = SpringMassModel(
        object_node=node,
        initial_velocity=np.zeros_like(node),
        spring_nodes=np.array([[0, 1], [1, 2], [2, 3], [3, 4]], np.int32),
        rest_length=np.array([1.0, 0.4, 0.5, 0.25], np.float32),
        stiffness=np.ones(4, np.float32),
        damping=np.ones(4, np.float32),
        object_spring_count=3,
        control_count=1,
    )
    parameters = SimulationParameters(rest_length_floor=0.1, virtual_rest_length_floor=0.2)
    control = np.array([[4.0, 0, 0]], np.float32)
    # The first and the last spring vanish, the second has no length, the third doubles.
    moved = np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [4, 0, 0]], np.float32)
    restart = Restart(frame=0, position=moved, velocity=np.zeros_like(moved))
    later = restart.continued(model, parameters, node[None], control[None])
    # A spring of 64 % of the length is 1.25² times as stiff, which automatic substeps allow for.
    np.testing.assert_allclose(later.rest_length, [0.64, 0.4, 1.0, 0.2], rtol=1e-6)
    bare = parameters.replace(rest_length_floor=0.0, virtual_rest_length_floor=0.0)
    later = restart.continued(model, bare, node[None], control[None])
    np.testing.assert_allclose(later.rest_length, [0.64, 0.4, 1.0, 0.16], rtol=1e-6)


def test_what_lies_on_the_ground_lies_where_it_is_seen_and_what_does_not_falls(device: str) -> None:
    node = np.array([[0, 0, 0.004], [0.1, 0, 0.0065], [0.2, 0, 0.02]], np.float32)
    model = replace(loose_nodes(node), clearance=np.float32([0.004, 0.004, 0.004]))
    parameters = SimulationParameters(restitution=0.0, frame_rate=30.0, ground_height=0.0)
    seen = node + np.float32([0.0, 0.0, 0.005])
    restart = Restart(frame=0, position=seen, velocity=np.zeros_like(node))
    later = restart.continued(model, parameters, node[None], np.zeros((1, 0, 3)))
    np.testing.assert_allclose(later.clearance, [0.009, 0.0115, 0.004], rtol=1e-6)
    simulator = Simulator(model, parameters, device)
    control = np.zeros((9, 0, 3), np.float32)
    height = simulator.rollout(control, restart).position[:, :, 2]
    np.testing.assert_allclose(height[1:, :2], np.tile(seen[:2, 2], (8, 1)), atol=1e-4)
    assert height[-1, 2] == pytest.approx(0.004, abs=1e-4)
    np.testing.assert_allclose(simulator.rollout(control).position[-1, :, 2], 0.004, atol=1e-4)
    # Shifted nodes lie where the rollout has them, which is as deep as before beside that.
    shifted = replace(restart, shifts_nodes=True)
    later = shifted.continued(model, parameters, node[None], np.zeros((1, 0, 3)))
    np.testing.assert_allclose(later.clearance, [0.004, 0.0065, 0.004], rtol=1e-6)
    height = simulator.rollout(control, shifted).position[:, :, 2]
    np.testing.assert_allclose(height[1:, :2], np.tile(seen[:2, 2], (8, 1)), atol=1e-4)
    assert height[-1, 2] == pytest.approx(0.009, abs=1e-4)
    without = restart.continued(
        model, parameters.replace(ground_height=None), node[None], np.zeros((1, 0, 3))
    )
    np.testing.assert_array_equal(without.clearance, model.clearance)


def test_a_restart_that_does_not_fit_is_refused() -> None:
    still = np.zeros((8, 3), np.float32)
    simulator = Simulator(*as_model(cube_scene()))
    with pytest.raises(ValueError, match="position has 7 nodes, but the object has 8"):
        next(
            simulator.frames(
                cube_scene().control, Restart(frame=1, position=still[1:], velocity=still[1:])
            )
        )
    wrong = still.copy()
    wrong[3, 1] = np.nan
    with pytest.raises(ValueError, match="velocity is not finite at node 3"):
        Restart(frame=1, position=still, velocity=wrong)
    with pytest.raises(ValueError, match="frame is -1"):
        Restart(frame=-1, position=still, velocity=still)
    with pytest.raises(ValueError, match=r"velocity has shape \(7, 3\)"):
        Restart(frame=1, position=still, velocity=still[1:])
    kept = Restart(frame=3, position=still + 1, velocity=still + 2)
    again = Restart.from_tensors(kept.to_tensors())
    assert (again.frame, again.position[0, 0], again.velocity[0, 0]) == (3, 1.0, 2.0)
    assert again.strain_frames == 1
    averaged = replace(kept, strain_frames=15, averages_in_air=True).to_tensors()
    assert Restart.from_tensors(averaged).strain_frames == 15
    assert Restart.from_tensors(averaged).averages_in_air
    del averaged["strain_frames"], averaged["averages_in_air"]
    assert Restart.from_tensors(averaged).strain_frames == 1
    assert not Restart.from_tensors(averaged).averages_in_air
    with pytest.raises(ValueError, match="strain_frames has 2 values; expected one"):
        Restart.from_tensors({**averaged, "strain_frames": np.ones(2, np.int32)})
    with pytest.raises(ValueError, match="strain_frames is 0; expected 1 or more"):
        replace(kept, strain_frames=0)
    with pytest.raises(ValueError, match="got frame, position"):
        Restart.from_tensors({"frame": np.zeros(1, np.int32), "position": still})
