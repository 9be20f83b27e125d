"""PhysTwin's numbers in our terms: topology, order of the springs, and what its kernel clamps."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.inputs.phystwin_experiment import OPTIMUM, find_springs

from physhandi.data.importers.phystwin_experiment import Checkpoint, Contact, Optimum
from physhandi.errors import ImportFailedError
from physhandi.fitting.config import load_profile
from physhandi.fitting.phystwin_run import phystwin_model, phystwin_parameters, spring_numbers
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import build_model

CONTACT = Contact(restitution=0.5, friction=0.3, self_restitution=0.7, self_friction=0.3)
FOUND = Optimum(
    stiffness=9000.0,
    object_radius=0.021,
    object_max_neighbours=7,
    controller_radius=0.019,
    controller_max_neighbours=5,
    collision_distance=0.011,
    drag=2.99,
    damping=83.97,
    contact=CONTACT,
)


def parameters_of(optimum: dict[str, Any]) -> SimulationParameters:
    found = replace(FOUND, **{k: v for k, v in optimum.items() if hasattr(FOUND, k)})
    return phystwin_parameters(
        load_profile("phystwin").simulation,
        found,
        CONTACT,
        truncates_damping=True,
        self_collision=False,
    )[0]


def block(seed: int, count: int = 90) -> tuple[np.ndarray, np.ndarray]:
    """Points like voxels, shuffled, and controllers some of which touch them."""
    rng = np.random.default_rng(seed)
    node = rng.permutation(rng.uniform(0, 0.05, (count, 3))).astype(np.float32)
    control = rng.uniform(-0.01, 0.06, (6, 3)).astype(np.float32)
    return node.astype(float), control.astype(float)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("neighbours", [2, 7, 30, 200])
def test_springs_are_numbered_as_plain_loops_find_them(seed: int, neighbours: int) -> None:
    node, control = block(seed)
    optimum = OPTIMUM | {"object_max_neighbours": neighbours, "controller_max_neighbours": seed + 1}
    expected, object_count = find_springs(node, control, optimum)
    parameters = parameters_of(
        {
            "object_radius": float(optimum["object_radius"]),
            "object_max_neighbours": neighbours,
            "controller_radius": float(optimum["controller_radius"]),
            "controller_max_neighbours": seed + 1,
        }
    )
    model = build_model(node, control, parameters)
    assert (model.object_spring_count, len(model.spring_nodes)) == (object_count, len(expected))
    number, tie_count = spring_numbers(model, parameters, control)
    assert tie_count == 0
    found = [frozenset(pair) for pair in model.spring_nodes.tolist()]
    assert found == [frozenset(expected[index]) for index in number]
    # The order is not ours by chance.
    assert np.abs(number - np.arange(len(number))).max() > 5


def test_springs_are_numbered_as_open3d_finds_them() -> None:
    """PhysTwin's own search: Open3D's hybrid search, as it was recorded; its first hit is dropped.

    The searches went over nodes with radius 0.021 and 7 neighbors, over controls with 0.019 and 5.
    """
    recorded = json.loads((Path(__file__).parent / "open3d_neighbors.json").read_text())
    node, control = block(7)
    pairs: list[frozenset[int]] = []
    for i, hits in enumerate(recorded["node"]):
        pairs.extend(pair for j in hits[1:] if (pair := frozenset((i, j))) not in pairs)
    object_count = len(pairs)
    for c, hits in enumerate(recorded["control"]):
        pairs.extend(frozenset((len(node) + c, j)) for j in hits)
    parameters = parameters_of({})
    model = build_model(node, control, parameters)
    assert model.object_spring_count == object_count > 100
    number, tie_count = spring_numbers(model, parameters, control)
    assert tie_count == 0
    assert [frozenset(pair) for pair in model.spring_nodes.tolist()] == [pairs[n] for n in number]


def test_the_radius_is_strict_and_the_node_counts_itself() -> None:
    node = np.array([[0.0, 0, 0], [0.25, 0, 0], [0.625, 0, 0], [0.62505, 0, 0]])
    counts = {}
    for neighbours, radius in ((2, 0.3), (2, 0.25), (4, 0.7), (4, 0.2), (1, 0.7)):
        changes = {"object_max_neighbours": neighbours, "object_radius": radius}
        model = build_model(node, np.zeros((0, 3)), parameters_of(changes))
        counts[neighbours, radius] = model.object_spring_count
    # Nodes 2 and 3 are 0.05 mm apart: too near to each other to be joined.
    assert counts == {(2, 0.3): 1, (2, 0.25): 0, (4, 0.7): 5, (4, 0.2): 0, (1, 0.7): 0}


def test_neighbors_at_one_distance_are_told() -> None:
    node = np.array([[0.0, 0, 0], [0.0078125, 0, 0], [-0.0078125, 0, 0], [0, 0.013, 0]])
    control = np.array([[0.0, 0, 0.01]])
    parameters = parameters_of({"controller_radius": 0.0001})
    model = build_model(node, control, parameters)
    number, tie_count = spring_numbers(model, parameters, control)
    # Node 0 has nodes 1 and 2 at one distance, and so has node 3.
    assert tie_count == 2
    assert sorted(number) == list(range(6))
    stored = Checkpoint(stiffness=np.ones(6), object_spring_count=6, contact=CONTACT, epoch=0)
    notes = phystwin_model(node, control, parameters, stored)[1]
    assert notes[0].startswith("2 pairs of neighbors are at the same distance")


def test_search_results_become_parameters() -> None:
    parameters, notes = phystwin_parameters(
        load_profile("phystwin").simulation,
        FOUND,
        CONTACT,
        truncates_damping=False,
        self_collision=True,
    )
    assert notes == []
    assert (parameters.connection_radius, parameters.max_neighbors) == (0.021, 6)
    assert (parameters.virtual_connection_radius, parameters.virtual_max_neighbors) == (0.019, 5)
    assert parameters.stiffness == parameters.virtual_stiffness == 9000.0
    assert (parameters.damping, parameters.drag) == (83.97, 2.99)
    assert (parameters.restitution, parameters.friction) == (0.5, 0.3)
    assert (parameters.self_restitution, parameters.self_friction) == (0.7, 0.3)
    assert (parameters.self_collision, parameters.collision_distance) == (True, 0.011)
    assert parameters.collides_rest_neighbors
    assert not parameters.use_control_velocity
    assert (parameters.rest_length_floor, parameters.virtual_rest_length_floor) == (0.0, 0.0)
    assert parameters.dt == pytest.approx(5e-5, rel=1e-9)
    assert parameters.gravity == 9.8


def test_what_phystwin_truncates_or_clamps_is_told() -> None:
    contact = Contact(
        restitution=-0.0047, friction=2.0026, self_restitution=1.5, self_friction=-1.0
    )
    parameters, notes = phystwin_parameters(
        load_profile("phystwin").simulation,
        replace(FOUND, stiffness=2e5),
        contact,
        truncates_damping=True,
        self_collision=False,
    )
    assert (parameters.damping, parameters.drag) == (83.0, 2.0)
    assert (parameters.restitution, parameters.friction) == (0.0, 2.0)
    assert (parameters.self_restitution, parameters.self_friction) == (1.0, 0.0)
    assert parameters.stiffness == 1e5
    told = " ".join(notes)
    for text in (
        "collide_elas -0.0047 is simulated as 0",
        "collide_fric 2.0026 is simulated as 2",
        "dashpot_damping 83.97 is loaded (as a whole number) as 83",
        "drag_damping 2.99 is loaded (as a whole number) as 2",
        "global_spring_Y 200000 is simulated as 100000",
    ):
        assert text in told
    assert len(notes) == 7


def test_stiffness_is_dealt_to_its_spring_and_limited() -> None:
    node, control = block(3)
    springs, object_count = find_springs(node, control, OPTIMUM)
    stiffness = 1000.0 + np.arange(len(springs))
    stiffness[2], stiffness[5] = 3e5, 0.0
    stored = Checkpoint(
        stiffness=stiffness, object_spring_count=object_count, contact=CONTACT, epoch=0
    )
    parameters = parameters_of(
        {
            "object_radius": float(OPTIMUM["object_radius"]),
            "controller_radius": float(OPTIMUM["controller_radius"]),
        }
    )
    model, notes = phystwin_model(node, control, parameters, stored)
    assert notes == ["1 springs stiffer than 100000 N are simulated with that."]
    value = {frozenset(p): s for p, s in zip(springs, stiffness, strict=True)}
    for pair, got, damping in zip(model.spring_nodes, model.stiffness, model.damping, strict=True):
        expected = value[frozenset(pair.tolist())]
        assert got == np.float32(min(expected, 1e5))
        assert damping == (83.0 if expected > 0 else 0.0)
    wrong = replace(stored, stiffness=stiffness[:-1])
    count = len(springs)
    message = f"has {count - 1} springs, {object_count} .* give {count}, {object_count}"
    with pytest.raises(ImportFailedError, match=message):
        phystwin_model(node, control, parameters, wrong)
