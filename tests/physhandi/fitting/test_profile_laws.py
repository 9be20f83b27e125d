"""The laws of `phystwin` and `paper` against float64 NumPy, with their numbers written out.

`test_phystwin_parity` compares with recordings of PhysTwin itself, which lie beside the
repository; this tells of a changed law or switch without them. There are no stored bits: they
depend on the vector units of the processor.
"""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from reference.spring_mass import Scene, simulate

from physhandi.data.observation import ObjectObservation
from physhandi.fitting.config import PipelineConfig, load_profile
from physhandi.fitting.object_problem import (
    ObjectProblem,
    build_problem,
    build_problem_model,
    mean_loss,
    simulate_problem,
)
from physhandi.fitting.object_reconstruction import motion_target
from physhandi.simulation.engines.batch import BatchSimulator
from physhandi.simulation.master_topology import MasterTopology

FRAMES, NODES = 3, 70
TOLERANCE = 5e-6
"""Of positions [m]; rounding of bounces reaches 1e-6, little changes of the law much more."""
PROFILES = pytest.mark.parametrize("name", ["phystwin", "paper"])
# exp(-3 · 5e-5) as the GPU's float32 has it, one unit below the nearest.
PHYSTWIN_DRAG = -math.log(float(np.nextafter(np.float32(math.exp(-1.5e-4)), np.float32(0)))) / 5e-5
LAW = {
    "phystwin": {
        "reach": (0.02, 29, 0.04, 50),
        "floor": 1e-6,
        "gravity": 9.8,
        "drag": PHYSTWIN_DRAG,
        "frame": 667 * 5e-5,
        "moves": False,
    },
    "paper": {
        "reach": (0.02, 29, 0.002, 3),
        "floor": 1e-3,
        "gravity": 9.81,
        "drag": 3.0,
        "frame": 1.0 / 30.0,
        "moves": True,
    },
}
"""Object radius and neighbors, control radius and neighbors [m], shortest virtual spring [m],
gravity [m/s²], drag [1/s], duration of a frame [s], whether dashpots see the controls move."""


def recorded() -> tuple[np.ndarray, np.ndarray, ObjectObservation, np.ndarray]:
    """A lump of nodes above the ground, controls that drag it, and half-seen tracks of it."""
    random = np.random.default_rng(7)
    node = random.uniform([0.0, 0.0, 0.001], [0.14, 0.04, 0.03], (NODES, 3))
    node = node.astype(np.float32).astype(np.float64)
    # Held at one end: who holds all of it tells nothing of drag and friction.
    control = node[np.argsort(node[:, 0])[:4]] + random.normal(0.0, 4e-4, (4, 3)) + [0.0, 0.0, 1e-3]
    way = np.linspace(0.0, 1.0, FRAMES)[:, None, None] * [0.03, -0.015, -0.008]
    control = (control + way).astype(np.float32).astype(np.float64)
    point = node + way + random.normal(0.0, 3e-3, (FRAMES, NODES, 3))
    is_visible = random.uniform(size=(FRAMES, NODES)) < [[1.0], [0.9], [0.6]]
    is_valid = is_visible & (random.uniform(size=(FRAMES, NODES)) < 0.8)
    is_valid[0] = False
    observation = ObjectObservation(
        point=point.astype(np.float32),
        is_visible=is_visible,
        is_motion_valid=is_valid,
        node_of_track=np.arange(NODES, dtype=np.int32),
    )
    velocity = np.random.default_rng(1).normal([0.1, 0.0, -0.25], 0.005, (NODES, 3))
    return node, control, observation, velocity.astype(np.float32)


def problem_of(config: PipelineConfig) -> ObjectProblem:
    node, control, observation, velocity = recorded()
    problem = build_problem(
        name="lump",
        observation=observation,
        object_node=node,
        rest_node=node,
        control=control,
        hand_face=np.zeros((0, 3), np.int32),
        frame_count=FRAMES,
        frame_rate=30.0,
        ground_height=0.0,
        gravity=9.81,
        chamfer_points="tracks",
        cloud_points=config.object_.cloud_points,
        starts_at_rest=config.object_.starts_at_rest,
    )
    # At rest nothing would meet the ground in so few frames.
    return replace(problem, initial_velocity=velocity)


def springs_by_loops(name: str) -> tuple[list[tuple[int, int]], list[float], int]:
    """Springs, their rest lengths, and how many join two object nodes."""
    node, control, _, _ = recorded()
    radius, most, held_radius, held_most = LAW[name]["reach"]
    pairs = set()
    for own in range(NODES):
        distance = np.linalg.norm(node - node[own], axis=1)
        for other in np.argsort(distance)[1 : most + 1]:
            if 1e-4 < distance[other] < radius:
                pairs.add((min(own, int(other)), max(own, int(other))))
    held = set()
    for grip, place in enumerate(control[0]):
        distance = np.linalg.norm(node - place, axis=1)
        held |= {
            (int(other), NODES + grip)
            for other in np.argsort(distance)[:held_most]
            if distance[other] < held_radius
        }
    springs = sorted(pairs) + sorted(held)
    every = np.concatenate([node, control[0]])
    length = [float(np.linalg.norm(every[a] - every[b])) for a, b in springs]
    floor = LAW[name]["floor"]
    held_length = [max(distance, floor) for distance in length[len(pairs) :]]
    return springs, length[: len(pairs)] + held_length, len(pairs)


@cache
def expected_motion(name: str) -> tuple[np.ndarray, np.ndarray]:
    """What `oracle` tells of a law as it is, which tests do not change."""
    return oracle(name)


def oracle(name: str, **changes: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities by the laws of physics.md, sections 3.1 and 3.2."""
    node, control, _, velocity = recorded()
    springs, rest, _ = springs_by_loops(name)
    law = LAW[name]
    return simulate(
        replace(
            Scene(
                node=node,
                velocity=velocity.astype(np.float64),
                springs=np.array(springs),
                rest=np.array(rest),
                stiffness=np.full(len(springs), 3e4),
                damping=np.full(len(springs), 100.0),
                control=control,
                drag=law["drag"],
                restitution=0.5,
                friction=0.3,
                ground=0.0,
                gravity=law["gravity"],
                frame_rate=1.0 / law["frame"],
                substeps=667,
                moves=law["moves"],
            ),
            **changes,
        )
    )


def loss_by_loops(name: str, position: np.ndarray, velocity: np.ndarray | None = None) -> float:
    """Mean loss of frames 1, 2, …: PhysTwin divides by the counts of frame 1, and by 6 its tracks.

    With velocities, the acceleration term is added, which PhysTwin's search alone has.
    """
    _, _, observation, _ = recorded()
    is_phystwin = name == "phystwin"
    total = 0.0
    for frame in range(1, FRAMES):
        counted = 1 if is_phystwin else frame
        seen = observation.point[frame, observation.is_visible[frame]].astype(np.float64)
        near = sum(((position[frame] - point) ** 2).sum(axis=1).min() for point in seen)
        total += near / observation.is_visible[counted].sum()
        valid = observation.is_motion_valid[frame]
        off = (position[frame, valid] - observation.point[frame, valid]) ** 2
        weight = 1.0 / 6.0 if is_phystwin else 1.0
        total += weight * off.sum() / observation.is_motion_valid[counted].sum()
        if velocity is not None and is_phystwin and frame > 1:
            jerk = velocity[frame] - 2.0 * velocity[frame - 1] + velocity[frame - 2]
            size = np.abs(jerk)
            total += 0.01 * np.where(size < 1.0, 0.5 * size**2, size - 0.5).mean()
    return total / (FRAMES - 1)


@PROFILES
def test_springs_and_motion_are_those_of_plain_loops(device: str, name: str) -> None:
    config = load_profile(name)
    problem = problem_of(config)
    model = build_problem_model(problem, config.simulation)
    springs, rest, own = springs_by_loops(name)
    assert list(map(tuple, model.spring_nodes.tolist())) == springs
    assert model.object_spring_count == own
    np.testing.assert_allclose(model.rest_length, rest, rtol=1e-5)
    position, _ = expected_motion(name)
    node, _ = simulate_problem(problem, model, config.simulation, device)
    assert np.abs(position[-1] - position[0]).max() > 0.01
    np.testing.assert_allclose(node.numpy(), position, atol=TOLERANCE)


@PROFILES
def test_every_number_of_the_law_matters(name: str) -> None:
    position, _ = expected_motion(name)
    law = LAW[name]
    others = {
        "gravity": 9.81 if name == "phystwin" else 9.8,
        "moves": not law["moves"],
        "frame_rate": 30.0 if name == "phystwin" else 1.0 / 0.03335,
    }
    moved = {field: oracle(name, **{field: value})[0] for field, value in others.items()}
    drag, friction = np.array([2.9, law["drag"]]), np.array([0.3, 0.31])
    moved["drag"], moved["friction"] = oracle(name, drag=drag, friction=friction)[0]
    for field, other in moved.items():
        assert np.abs(other - position).max() > 3 * TOLERANCE, field


@PROFILES
def test_losses_are_those_of_plain_loops(device: str, name: str) -> None:
    config = load_profile(name)
    object_ = config.object_.replace(chamfer_points="tracks")
    problem = problem_of(config)
    model = build_problem_model(problem, config.simulation)
    position, velocity = expected_motion(name)
    expected = loss_by_loops(name, position)
    total = mean_loss([problem], {"lump": model}, config.simulation, object_, device)
    assert total == pytest.approx(expected, rel=1e-3)
    # The search's loss, by the batch that moves its candidates.
    control = problem.control
    world = config.simulation.in_world(frame_rate=30.0, ground_height=0.0, gravity=9.81)
    master = MasterTopology.of(
        problem.object_node, control[0], [world], initial_velocity=problem.initial_velocity
    )
    target = motion_target(problem, object_)
    found = BatchSimulator(master, [world], device).losses(control, target).loss[0]
    searched = loss_by_loops(name, position, velocity)
    assert found == pytest.approx(searched, rel=1e-3)
