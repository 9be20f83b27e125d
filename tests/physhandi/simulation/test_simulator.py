"""The simulator against a float64 oracle, closed forms and laws."""

import math
from dataclasses import replace

import numpy as np
import pytest
from reference.scenes import as_model, bare_scene, cube_scene
from reference.spring_mass import simulate

from physhandi.errors import SimulationDivergedError
from physhandi.simulation.simulator import Simulator


def run(scene, device):
    return Simulator(*as_model(scene), device=device).rollout(scene.control)


def pair(stretch=0.1, stiffness=50.0, damping=0.0, **changes):
    """Describe two unit masses on a spring of 1 m along an oblique direction."""
    direction = np.array([2.0, -1.0, 2.0]) / 3.0
    node = np.stack([-direction, direction]) * (1.0 + stretch) / 2.0
    return bare_scene(
        node, springs=[(0, 1)], rest=[1.0], stiffness=[stiffness], damping=[damping], **changes
    )


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"moves": False},
        {"ground": None},
        {"ground": 0.003, "restitution": 0.9, "friction": 0.0},
        {"ground": 0.002, "restitution": 0.0, "friction": 2.0},
        {"clearance": np.linspace(-0.001, 0.006, 8)},
        {"drag": 0.0, "gravity": -3.0},
        {"drag": 40.0, "frame_rate": 60.0, "substeps": 33},
    ],
    ids=str,
)
def test_rollouts_agree_with_the_oracle(device, changes):
    scene = cube_scene(**changes)
    position, velocity = simulate(scene)
    rollout = run(scene, device)
    assert np.abs(position[-1] - position[0]).max() > 0.01
    np.testing.assert_allclose(rollout.position, position, atol=2e-7)
    np.testing.assert_allclose(rollout.velocity, velocity, atol=5e-6)


def test_the_oracle_scene_touches_the_ground_and_its_switches_matter():
    position, _ = simulate(cube_scene())
    assert position[..., 2].min() < 1e-4
    for change in (
        {"moves": False},
        {"ground": None},
        {"friction": 0.0},
        {"restitution": 0.9},
        {"clearance": np.linspace(-0.001, 0.006, 8)},
    ):
        assert np.abs(simulate(cube_scene(**change))[0] - position).max() > 1e-4, change


def test_a_stretched_spring_pulls_with_stiffness_times_strain(device):
    # One substep of 1 ms: v = F dt, F = 50 N · 0.1 = 5 N on unit mass.
    scene = pair(stretch=0.1, frame_rate=1000.0, substeps=1)
    velocity = run(scene, device).velocity[1]
    expected = 5.0 * 1e-3 * np.array([2.0, -1.0, 2.0]) / 3.0
    np.testing.assert_allclose(velocity[0], expected, rtol=1e-4)
    np.testing.assert_allclose(velocity[1], -expected, rtol=1e-4)


def test_two_masses_oscillate_at_the_frequency_of_their_spring(device):
    # Reduced mass 1/2 kg, k = Y / r = 50 N/m: ω = √(2 k) = 10 rad/s.
    scene = pair(stretch=0.01, stiffness=50.0, frames=61, frame_rate=60.0, substeps=100)
    position = run(scene, device).position.astype(np.float64)
    stretch = np.linalg.norm(position[:, 1] - position[:, 0], axis=1) - 1.0
    expected = 0.01 * np.cos(10.0 * np.arange(61) / 60.0)
    np.testing.assert_allclose(stretch, expected, atol=5e-5)


def test_a_dashpot_damps_at_its_rate(device):
    # Relative motion: ẍ + 2 c ẋ + 2 k x = 0, so the envelope decays as exp(-c t).
    scene = pair(stretch=0.01, damping=1.0, frames=61, frame_rate=60.0, substeps=200)
    position = run(scene, device).position.astype(np.float64)
    stretch = np.linalg.norm(position[:, 1] - position[:, 0], axis=1) - 1.0
    t, omega = np.arange(61) / 60.0, math.sqrt(100.0 - 1.0)
    expected = 0.01 * np.exp(-t) * (np.cos(omega * t) + np.sin(omega * t) / omega)
    np.testing.assert_allclose(stretch, expected, atol=5e-5)


def test_free_fall_follows_the_parabola(device):
    scene = bare_scene(
        [[0.1, 0.2, 0.3]], velocity=[[1.0, 0.0, 2.0]], frames=16, gravity=9.81, substeps=500
    )
    t = np.arange(16) / 30.0
    position = run(scene, device).position[:, 0]
    np.testing.assert_allclose(position[:, 0], 0.1 + t, atol=5e-5)
    # Semi-implicit Euler lags by g dt t / 2.
    expected = 0.3 + 2.0 * t - 9.81 / 2.0 * t * (t + 1.0 / 15000.0)
    np.testing.assert_allclose(position[:, 2], expected, atol=5e-5)


def test_drag_decays_velocity_and_gives_a_terminal_speed(device):
    scene = bare_scene(
        [[0.0, 0.0, 0.0]], velocity=[[2.0, 0.0, 0.0]], frames=91, gravity=9.81, drag=3.0
    )
    velocity = run(scene, device).velocity[:, 0]
    t = np.arange(91) / 30.0
    np.testing.assert_allclose(velocity[:, 0], 2.0 * np.exp(-3.0 * t), rtol=2e-5, atol=1e-5)
    np.testing.assert_allclose(velocity[:, 2], -9.81 / 3.0 * (1.0 - np.exp(-3.0 * t)), rtol=2e-4)


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_a_bounce_returns_the_square_of_restitution_of_its_height(device, restitution):
    scene = bare_scene(
        [[0.0, 0.0, 0.2]], frames=61, frame_rate=120.0, substeps=200, gravity=9.81,
        ground=0.05, restitution=restitution, friction=0.0,
    )  # fmt: skip
    height = run(scene, device).position[:, 0, 2] - 0.05
    landing = math.sqrt(2.0 * 0.15 / 9.81) * 120.0
    after = height[math.ceil(landing) : math.ceil(landing * (1.0 + 2.0 * restitution)) + 1]
    assert height.min() > -1e-6
    assert after.max() == pytest.approx(0.15 * restitution**2, abs=4e-4)


def test_friction_takes_its_share_of_sliding_at_the_impact(device):
    # Frictional impulse μ (1 + e) |v_n| = 0.4 · 1.5 · 1 = 0.6 m/s, against the sliding direction.
    scene = bare_scene(
        [[0.0, 0.0, 1e-4], [0.0, 1.0, 1e-4]], velocity=[[0.0, 3.0, -1.0], [0.3, 0.4, -1.0]],
        ground=0.0, restitution=0.5, friction=0.4,
    )  # fmt: skip
    velocity = run(scene, device).velocity[1]
    np.testing.assert_allclose(velocity[0], [0.0, 2.4, 0.5], atol=1e-6)
    np.testing.assert_allclose(velocity[1], [0.0, 0.0, 0.5], atol=1e-6)


def test_nodes_fall_onto_their_clearances(device):
    # The ground is at 10 mm, so that they come to lie at 10, 15 and 40 mm.
    scene = bare_scene(
        [[0.0, 0.0, 0.06], [0.1, 0.0, 0.06], [0.2, 0.0, 0.06]], frames=8, gravity=9.81,
        substeps=200, ground=0.01, clearance=np.array([0.0, 0.005, 0.03]), restitution=0.0,
    )  # fmt: skip
    position = run(scene, device).position[:, :, 2]
    fall = 0.06 - 9.81 / 2.0 * (np.arange(8) / 30.0) ** 2
    landed = fall[:, None] < [0.01, 0.015, 0.04]
    assert landed.any(axis=0).all()
    assert not landed[1].any()
    expected = np.where(landed, [0.01, 0.015, 0.04], fall[:, None])
    np.testing.assert_allclose(position, expected, atol=1e-4)
    np.testing.assert_allclose(position[-1], [0.01, 0.015, 0.04], atol=1e-6)


def test_a_node_slides_at_its_clearance_until_friction_stops_it(device):
    # Each substep's impact takes μ (1 + e) g dt of its speed: it stops after v² / (2 μ (1 + e) g).
    scene = bare_scene(
        [[0.0, 0.0, 0.025]], velocity=[[0.3, 0.4, 0.0]], frames=8, gravity=9.81,
        ground=0.005, clearance=np.array([0.02]), restitution=0.0, friction=0.4,
    )  # fmt: skip
    position = run(scene, device).position[:, 0]
    time = np.minimum(np.arange(8) / 30.0, 0.5 / (0.4 * 9.81))
    way = 0.5 * time - 0.4 * 9.81 / 2.0 * time**2
    assert way[-1] == pytest.approx(0.5**2 / (2.0 * 0.4 * 9.81))
    np.testing.assert_allclose(position[:, :2], way[:, None] * [0.6, 0.8], atol=1e-4)
    np.testing.assert_allclose(position[:, 2], 0.025, atol=1e-6)


def test_a_clearance_of_all_nodes_is_a_higher_ground(device):
    scene = cube_scene(ground=0.003)
    wanted = run(scene, device)
    lifted = run(replace(scene, ground=-0.001, clearance=np.full(8, 0.004)), device)
    assert wanted.position[..., 2].min() < 0.0031
    np.testing.assert_allclose(lifted.position, wanted.position, atol=2e-7)


def test_a_control_node_drags_its_object_node_through_spring_and_dashpot(device):
    # One substep of 1 s: the spring sees the control at the END of the substep.
    scene = bare_scene(
        [[0.0, 0.0, 0.0]], springs=[(0, 1)], rest=[1.0], stiffness=[2.0], damping=[0.25]
    )
    control = np.array([[[1.0, 0.0, 0.0]], [[1.5, 0.0, 0.0]]])
    scene = replace(scene, control=control, frame_rate=1.0, substeps=1)
    # F = 2 (1.5 - 1) + 0.25 · 0.5 with the control's velocity, without it the first term only.
    assert run(scene, device).velocity[1, 0, 0] == pytest.approx(1.125, rel=1e-6)
    assert run(replace(scene, moves=False), device).velocity[1, 0, 0] == pytest.approx(
        1.0, rel=1e-6
    )


def test_springs_conserve_momentum_while_they_move_the_nodes(device):
    scene = cube_scene(gravity=0.0, drag=0.0, ground=None)
    is_object = np.all(scene.springs < 8, axis=1)
    keep = {
        name: getattr(scene, name)[is_object]
        for name in ("springs", "rest", "stiffness", "damping")
    }
    scene = replace(scene, control=np.zeros((6, 0, 3)), **keep)
    velocity = run(scene, device).velocity.astype(np.float64)
    momentum = velocity.sum(axis=1)
    np.testing.assert_allclose(
        momentum, np.broadcast_to(scene.velocity.sum(axis=0), (6, 3)), atol=2e-6
    )
    assert np.linalg.norm(momentum[0]) > 3.0
    assert np.abs(velocity[-1] - velocity[0]).max() > 0.05


def test_the_same_input_gives_the_same_bits(device):
    scene = cube_scene()
    simulator = Simulator(*as_model(scene), device=device)
    first, again, fresh = (
        simulator.rollout(scene.control),
        simulator.rollout(scene.control),
        run(scene, device),
    )
    for other in (again, fresh):
        assert other.position.tobytes() == first.position.tobytes()
        assert other.velocity.tobytes() == first.velocity.tobytes()


def test_frames_stream_what_a_rollout_returns(device):
    scene = cube_scene()
    simulator = Simulator(*as_model(scene), device=device)
    rollout = simulator.rollout(scene.control)
    frames = list(simulator.frames(scene.control))
    assert [frame for frame, _, _ in frames] == [0, 1, 2, 3]
    np.testing.assert_array_equal(frames[0][1], scene.node.astype(np.float32))
    np.testing.assert_array_equal(
        np.stack([position for _, position, _ in frames]), rollout.position
    )
    np.testing.assert_array_equal(
        np.stack([velocity for _, _, velocity in frames]), rollout.velocity
    )


def test_tunables_act_without_another_capture(device):
    before = cube_scene()
    after = replace(
        before, drag=8.0, restitution=0.1, friction=0.9, ground=0.002, gravity=4.0, moves=False
    )
    model, parameters = as_model(before)
    simulator = Simulator(model, parameters, device=device)
    simulator.rollout(before.control)
    graph = simulator._recordings[False, False].graph
    simulator.set_parameters(as_model(after)[1].replace(stiffness_scale=2.0))
    simulator.set_material(stiffness=model.stiffness / 3.0, damping=model.damping * 2.0)
    changed = simulator.rollout(after.control)
    oracle = replace(after, stiffness=after.stiffness * 2.0 / 3.0, damping=after.damping * 2.0)
    np.testing.assert_allclose(changed.position, simulate(oracle)[0], atol=2e-7)
    assert simulator._recordings[False, False].graph is graph


def test_only_what_moves_the_nodes_is_laid_out(device):
    scene = cube_scene()
    model, parameters = as_model(scene)
    plain = Simulator(model, parameters, device=device)
    colliding = Simulator(model, parameters.replace(self_collision=True), device=device)
    for simulator in (plain, colliding):
        assert not {"engine", "sums"} & set(vars(simulator))
        simulator.rollout(scene.control)
    assert {"engine", "sums"} & set(vars(plain)) == {"engine"}
    assert {"engine", "sums"} & set(vars(colliding)) == {"sums"}
    # What is laid out later sees the same state.
    wanted = plain.rollout(scene.control).position
    colliding.set_parameters(parameters)
    assert np.array_equal(colliding.rollout(scene.control).position, wanted)


def test_a_substep_of_another_length_needs_another_simulator(device):
    model, parameters = as_model(cube_scene())
    simulator = Simulator(model, parameters, device=device)
    with pytest.raises(ValueError, match="substeps_per_frame are fixed"):
        simulator.set_parameters(parameters.replace(substeps_per_frame=41))


@pytest.mark.parametrize(
    ("changes", "first", "second"),
    [
        (
            {"stiffness": [5e4, 5e4, 5e4]},
            r"stiffness \(up to 5e\+04 N\)",
            r"substeps_per_frame \(4\)",
        ),
        (
            {"rest": [1.0, 1e-5, 1.0]},
            r"rest_length_floor \(spring 1 is only 1e-05 m",
            "substeps_per_frame",
        ),
        ({"damping": [900.0, 900.0, 900.0]}, r"damping \(up to 900 N·s/m\)", "substeps_per_frame"),
    ],
    ids=["stiffness", "rest length", "damping"],
)
def test_divergence_names_frame_substep_node_and_who_is_to_blame(device, changes, first, second):
    node = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [5.0, 5.0, 5.0]]
    springs = {"springs": [(0, 1), (0, 2), (1, 2)], "rest": [1.1, 1.0, 1.1], "stiffness": [9.0] * 3}
    scene = bare_scene(
        node, **({**springs, "damping": [0.0] * 3, "frames": 90, "substeps": 4} | changes)
    )
    with np.errstate(all="ignore"):
        _, velocity = simulate(replace(scene, velocity=scene.velocity + 1e-3))
        speed = np.linalg.norm(velocity, axis=2)
    assert not np.all(speed <= 50.0), "the oracle diverges too"
    scene = replace(scene, velocity=scene.velocity + 1e-3)
    with pytest.raises(SimulationDivergedError, match=first) as caught:
        run(scene, device)
    error = caught.value
    assert error.frame == int(np.argmax(~np.all(speed <= 50.0, axis=1)))
    assert 0 <= error.substep < 4
    assert error.node in (0, 1, 2)
    assert f"frame {error.frame}, substep {error.substep}: node {error.node}" in str(error)
    with pytest.raises(SimulationDivergedError, match=second):
        run(scene, device)


def test_a_simulator_recovers_after_a_divergence(device):
    scene = cube_scene()
    model, parameters = as_model(scene)
    simulator = Simulator(model, parameters, device=device)
    simulator.set_material(stiffness=model.stiffness * 1e6)
    with pytest.raises(SimulationDivergedError):
        simulator.rollout(scene.control)
    simulator.set_material(stiffness=model.stiffness)
    np.testing.assert_array_equal(
        simulator.rollout(scene.control).position, run(scene, device).position
    )


def test_a_control_trajectory_that_does_not_fit_is_refused(device):
    scene = cube_scene()
    simulator = Simulator(*as_model(scene), device=device)
    with pytest.raises(ValueError, match=r"\(4, 3, 3\); expected \(frames, 4, 3\)"):
        simulator.rollout(scene.control[:, :3])
    scene.control[2, 1, 0] = np.nan
    with pytest.raises(ValueError, match="not finite at frame 2, node 1"):
        simulator.rollout(scene.control)
