"""What benchmarks simulate has the sizes that were asked for."""

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from physhandi.benchmarks.scenes import recorded_object, scene_of, synthetic_block
from physhandi.errors import UsageError
from physhandi.simulation.simulator import Simulator


@pytest.mark.parametrize(("nodes", "around"), [(1, 18), (2, 9), (100, 9), (333, 18), (333, 57)])
def test_a_block_has_the_nodes_and_springs_that_were_asked_for(nodes, around):
    scene = synthetic_block(nodes, frame_count=3, springs_at_node=around)
    assert scene.model.node_count == nodes
    pairs = nodes * (nodes - 1) // 2
    assert scene.model.object_spring_count == min(pairs, round(nodes * around / 2))
    assert scene.model.virtual_spring_count >= min(nodes, 9)
    assert scene.model.object_node[:, 2].min() == 0.0
    distance = pdist(scene.model.object_node)
    assert distance.min(initial=1.0) > 0.007
    joined = np.sort(distance)[: scene.model.object_spring_count]
    np.testing.assert_allclose(
        np.sort(scene.model.rest_length[: scene.model.object_spring_count]), joined, rtol=1e-5
    )
    rise = np.broadcast_to([0.0, 0.0, 6e-3], scene.control[0].shape)
    np.testing.assert_allclose(scene.control[3] - scene.control[0], rise, atol=1e-7)
    assert scene.frame_count == 3


def test_the_block_is_lifted(device):
    scene = synthetic_block(30, frame_count=4, substeps_per_frame=100)
    motion = Simulator(scene.model, scene.parameters, device=device).rollout(scene.control).position
    held = scene.model.spring_nodes[scene.model.object_spring_count :].min(axis=1)
    rise = (motion[-1] - motion[0])[held, 2]
    assert 2e-3 < rise.mean() < 14e-3
    assert scene.model.damping.min() == scene.model.damping.max() == 10.0


@pytest.fixture
def thing(tmp_path):
    """A made-up chain of 40 nodes in a file."""
    node = np.random.default_rng(0).uniform(0, 0.05, (40, 3)).astype(np.float32)
    springs = np.stack([np.arange(39), np.arange(1, 40)], axis=1)
    length = np.linalg.norm(np.diff(node, axis=0), axis=1).astype(np.float32)
    length[3] = 1e-5
    arrays = {"position": node, "spring_nodes": springs, "rest_length": length}
    np.savez(tmp_path / "thing.npz", **arrays, stiffness=np.full(39, 100.0, dtype=np.float32))
    return tmp_path / "thing.npz"


def test_a_recorded_object_keeps_its_springs_and_is_held_at_its_highest_nodes(thing):
    scene = scene_of(thing, 1000, 2)
    model = scene.model
    assert (scene.name, model.node_count, model.object_spring_count) == ("thing", 40, 39)
    assert model.rest_length[3] == np.float32(1e-3)
    with np.load(thing) as data:
        np.testing.assert_allclose(model.rest_length[4:39], data["rest_length"][4:], rtol=1e-6)
        node = data["position"]
    height = node[:, 2] - node[:, 2].min()
    np.testing.assert_allclose(
        np.sort(scene.control[0, :, 2]), np.sort(height)[-30:] + 0.01, atol=1e-6
    )
    assert model.control_count == 30
    assert model.virtual_spring_count >= 30


def test_a_missing_or_incomplete_object_is_named(tmp_path):
    with pytest.raises(UsageError, match=r"no object file .*gone\.npz"):
        scene_of(tmp_path / "gone.npz", 10, 1)
    np.savez(tmp_path / "part.npz", position=np.zeros((2, 3)))
    with pytest.raises(UsageError, match="lacks the arrays spring_nodes, rest_length, stiffness"):
        recorded_object(tmp_path / "part.npz", frame_count=1)


@pytest.mark.parametrize("name", ["nodes", "frames", "substeps"])
def test_a_number_that_makes_no_sense_is_named(name):
    numbers = {"nodes": 10, "frames": 1, "substeps": 10} | {name: 0}
    with pytest.raises(UsageError, match=f"{name} of a benchmark is 0"):
        scene_of(None, *numbers.values())
