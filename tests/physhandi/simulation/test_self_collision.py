"""Collisions of object nodes against closed forms, a float64 oracle and brute force."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from reference.scenes import as_model, bare_scene, crossing_scene, cube_scene
from reference.spring_mass import simulate

from physhandi.errors import SimulationError
from physhandi.simulation import self_collision
from physhandi.simulation.simulator import Simulator


def run(scene, device):
    return Simulator(*as_model(scene), device=device).rollout(scene.control)


def meeting(offset, rate, **changes):
    """Let one node fly at another that rests, both 8 mm or less apart from the start."""
    node = np.array([[0.0, 0.0, 0.0], offset])
    return bare_scene(
        node, velocity=[[0.0, 0.0, 0.0], rate],
        **{"distance": 0.01, "blocks_rest": True, "substeps": 20} | changes,
    )  # fmt: skip


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_two_nodes_part_at_restitution_times_their_approach(device, restitution):
    scene = meeting([0.003, 0.0, 0.004], [-0.24, 0.0, -0.32], self_restitution=restitution)
    rollout = run(scene, device)
    along = np.array([0.6, 0.0, 0.8])
    velocity = rollout.velocity[1] @ along
    assert velocity[1] - velocity[0] == pytest.approx(restitution * 0.4, abs=1e-6)
    # Momentum stays, and the new velocities move the nodes for the whole frame.
    assert velocity.sum() == pytest.approx(-0.4, abs=1e-6)
    gap = (rollout.position[1, 1] - rollout.position[1, 0]) @ along
    assert gap == pytest.approx(0.005 + restitution * 0.4 / 30.0, abs=1e-6)


@pytest.mark.parametrize(
    ("slide", "left"), [(0.3, 0.24), (0.05, 0.0)], ids=["slides on", "is stopped"]
)
def test_friction_takes_its_share_of_sliding_past_each_other(device, slide, left):
    # Frictional impulse μ (1 + e) |v_n| = 0.4 · 1.5 · 0.1 = 0.06 m/s of relative speed.
    scene = meeting([0.005, 0, 0], [-0.1, 0, slide], self_restitution=0.5, self_friction=0.4)
    velocity = run(scene, device).velocity[1]
    np.testing.assert_allclose(velocity[1] - velocity[0], [0.05, 0.0, left], atol=1e-6)
    np.testing.assert_allclose(velocity.sum(axis=0), [-0.1, 0.0, slide], atol=1e-6)


@pytest.mark.parametrize(("speed", "collides"), [(0.024, False), (0.026, True)])
def test_an_approach_counts_from_a_hundred_square_millimetres_a_second(device, speed, collides):
    # x·v = -4 mm · speed, against -1e-4 m²/s: the offset is not normalised.
    scene = meeting([0.004, 0, 0], [-speed, 0, 0], substeps=1, frame_rate=1000.0)
    velocity = run(scene, device).velocity[1, 1, 0]
    # Restitution 0.7 of equal masses leaves the second node (1 - 1.7 / 2) of its speed.
    assert velocity == pytest.approx(-speed * (0.15 if collides else 1.0), rel=1e-4)


def test_several_collisions_of_a_node_are_averaged(device):
    # The middle node is hit at 0.1 m/s from the left and at 0.3 m/s from the right, e = 1.
    scene = bare_scene(
        [[0.0, 0, 0], [-0.005, 0, 0], [0.005, 0, 0]],
        velocity=[[0, 0, 0], [0.1, 0, 0], [-0.3, 0, 0]],
        distance=0.006, blocks_rest=True, self_restitution=1.0, substeps=1, frame_rate=1000.0,
    )  # fmt: skip
    velocity = run(scene, device).velocity[1, :, 0]
    # Alone each would hand over its velocity: (0.1 - 0.3) / 2; the others take the middle's.
    np.testing.assert_allclose(velocity, [-0.1, 0.0, 0.0], atol=1e-6)


def test_who_may_collide_is_decided_at_the_start_of_a_frame(device):
    # 14 mm apart, closing 10 mm a frame: nearer than 10 mm only within the first frame.
    scene = meeting([0.014, 0, 0], [-0.3, 0, 0], frames=3)
    velocity = run(scene, device).velocity[:, 1, 0]
    np.testing.assert_allclose(velocity, [-0.3, -0.3, -0.3 * 0.15], rtol=1e-5)


def test_nodes_that_are_near_at_rest_pass_through_unless_asked(device):
    scene = meeting([0.005, 0, 0], [-0.4, 0, 0])
    assert run(scene, device).velocity[1, 0, 0] < -0.3
    free = run(replace(scene, blocks_rest=False), device)
    np.testing.assert_allclose(free.velocity[1, :, 0], [0.0, -0.4], atol=1e-7)
    # Rest is the model's frame 0, not where a rollout starts.
    apart = replace(scene, node=np.array([[0.0, 0, 0], [0.02, 0, 0]]), blocks_rest=False)
    simulator = Simulator(*as_model(apart), device=device)
    simulator.reset(position=scene.node)
    simulator.step_frame(1, *np.zeros((2, 0, 3)))
    assert simulator.velocity.numpy()[0, 0] < -0.3


CROSSINGS = {
    "as it is": ({}, 10),
    "rough": ({"self_friction": 2.0}, 27),
    "smooth": ({"self_friction": 0.0}, 9),
    "dull": ({"self_restitution": 0.2}, 13),
    "odd substeps": ({"substeps": 41}, 11),
    "far": ({"distance": 0.03}, 22),
    "all pairs": ({"distance": 0.03, "blocks_rest": True}, 1472),
}


@pytest.mark.parametrize(("changes", "count"), CROSSINGS.values(), ids=CROSSINGS.keys())
def test_two_sheets_that_meet_agree_with_the_oracle(device, changes, count):
    scene, counts = crossing_scene(**changes), []
    position, velocity = simulate(scene, counts)
    assert sum(counts) == count
    without = simulate(replace(scene, distance=None))[0]
    assert np.abs(position - without).max() > 4e-3
    rollout = run(scene, device)
    np.testing.assert_allclose(rollout.position, position, atol=2e-7)
    np.testing.assert_allclose(rollout.velocity, velocity, atol=5e-6)


def test_the_same_input_gives_the_same_bits(device):
    scene = crossing_scene(distance=0.03, blocks_rest=True)
    simulator = Simulator(*as_model(scene), device=device)
    first, again, fresh = *(simulator.rollout(scene.control) for _ in "12"), run(scene, device)
    for other in (again, fresh):
        assert other.position.tobytes() == first.position.tobytes()
        assert other.velocity.tobytes() == first.velocity.tobytes()


def test_every_number_of_it_acts_without_another_capture(device):
    before = crossing_scene()
    simulator = Simulator(*as_model(before), device=device)
    simulator.rollout(before.control)
    graph = simulator._recordings[True, False].graph
    after = replace(
        before, distance=0.025, self_restitution=0.1, self_friction=1.2, blocks_rest=True
    )
    simulator.set_parameters(as_model(after)[1])
    np.testing.assert_allclose(
        simulator.rollout(after.control).position, simulate(after)[0], atol=2e-7
    )
    assert simulator._recordings[True, False].graph is graph
    assert np.abs(simulate(after)[0] - simulate(before)[0]).max() > 1e-3


def test_switched_off_it_leaves_no_trace(device):
    scene = crossing_scene()
    off = replace(scene, distance=None)
    simulator = Simulator(*as_model(scene), device=device)
    on = simulator.rollout(scene.control)
    simulator.set_parameters(as_model(off)[1])
    never = Simulator(*as_model(off), device=device)
    expected = never.rollout(off.control)
    assert simulator.rollout(off.control).position.tobytes() == expected.position.tobytes()
    assert never.collision is None
    assert never._recordings[True, False].graph is None
    simulator.set_parameters(as_model(scene)[1])
    assert simulator.rollout(scene.control).position.tobytes() == on.position.tobytes()
    assert on.position.tobytes() != expected.position.tobytes()


def test_where_nothing_meets_it_changes_nothing(device):
    scene = cube_scene()
    on = replace(scene, distance=0.001)
    np.testing.assert_allclose(run(on, device).position, run(scene, device).position, atol=2e-7)


def crowd(count=300):
    return np.random.default_rng(4).uniform(-0.05, 0.05, (count, 3)).astype(np.float32)


def brute_force(node, rest, distance, *, blocks_rest):
    gaps = [np.linalg.norm(x[:, None].astype(float) - x[None], axis=2) for x in (node, rest)]
    near = (gaps[0] < distance) & (blocks_rest | (gaps[1] >= distance))
    return [np.flatnonzero(row & (np.arange(len(row)) != i)) for i, row in enumerate(near)]


def candidate_lists(simulator):
    start, entry = (a.numpy() for a in (simulator.collision.start, simulator.collision.candidate))
    return [entry[a:b] for a, b in pairwise(start)]


@pytest.mark.parametrize("blocks_rest", [False, True])
@pytest.mark.parametrize("distance", [0.0, 0.004, 0.02, 0.5])
def test_candidates_are_those_of_brute_force_in_ascending_order(device, distance, blocks_rest):
    node, rest = crowd(), crowd()[::-1]
    scene = bare_scene(rest, distance=distance, blocks_rest=blocks_rest)
    simulator = Simulator(*as_model(scene), device=device)
    simulator.reset(position=node)
    simulator.find_candidates(simulator.position)
    expected = brute_force(node, rest, distance, blocks_rest=blocks_rest)
    for found, row in zip(candidate_lists(simulator), expected, strict=True):
        np.testing.assert_array_equal(found, row)
    assert sum(map(len, expected)) > 0 or distance in (0.0, 0.5)


def test_more_candidates_than_there_is_room_for_make_room(device, monkeypatch):
    scene = bare_scene(
        crowd(), velocity=10 * crowd()[::-1], frames=5, distance=0.02, blocks_rest=True, substeps=7
    )
    expected = run(scene, device)
    monkeypatch.setattr(self_collision, "FIRST_CAPACITY", 1)
    simulator = Simulator(*as_model(replace(scene, distance=0.004)), device=device)
    simulator.rollout(scene.control)
    graph = simulator._recordings[True, False].graph
    simulator.set_parameters(as_model(scene)[1])
    grown = simulator.rollout(scene.control)
    assert len(simulator.collision.candidate) > 300
    assert simulator._recordings[True, False].graph is not graph
    assert grown.position.tobytes() == expected.position.tobytes()
    assert np.abs(expected.position[4] - expected.position[0]).max() > 0.01


def test_too_many_candidates_are_refused_by_name(device, monkeypatch):
    scene = bare_scene(crowd(20), distance=0.5, blocks_rest=True)
    monkeypatch.setattr(self_collision, "MOST_CANDIDATES", 379)
    with pytest.raises(SimulationError, match=r"Node 0 has 19 .*collision_distance \(0.5 m\)"):
        run(scene, device)
    monkeypatch.setattr(self_collision, "MOST_CANDIDATES", 380)
    assert np.isfinite(run(scene, device).position).all()
