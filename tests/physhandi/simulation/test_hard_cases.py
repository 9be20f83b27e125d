"""Objects at the limits, moved by every engine and differentiated by every adjoint."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from reference.blocks import PARAMETERS, recorded, thrown_block
from reference.gradients import directional_difference, gradients, loss_weights
from reference.scenes import as_model, loose_scene, star_scene, tiny_scene
from reference.spring_mass import simulate

from physhandi.errors import SimulationDivergedError
from physhandi.simulation import differentiable
from physhandi.simulation.engines import cuda
from physhandi.simulation.engines.batch import BatchSimulator
from physhandi.simulation.engines.cpu import CpuAdjoint, CpuEngine
from physhandi.simulation.engines.cuda import CudaAdjoint, CudaEngine
from physhandi.simulation.engines.graph_adjoint import GraphAdjoint
from physhandi.simulation.master_topology import MasterTopology
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator

WAYS = [
    "threaded on cpu",
    "recorded on cpu",
    *(
        pytest.param(f"{way} on cuda:0", marks=pytest.mark.gpu)
        for way in ("recorded", "frame", "large frame")
    ),
]
SCENES = {
    "a tenth of a millimetre": (tiny_scene, 2e-5, 2e-8),
    "500 springs at a node": (star_scene, 1e-4, 2e-6),
    "one node": (lambda: loose_scene(1), 5e-3, 2e-6),
    "no springs": (lambda: loose_scene(7), 5e-3, 2e-6),
}
"""Scene, how far nodes move in it at least [m], and what float32 may be off [m]."""


@pytest.fixture(params=WAYS)
def way(request, monkeypatch):
    """Say how to simulate and where; the large kernel is chosen for small objects too."""
    name, device = request.param.split(" on ")
    if device == "cpu" and not wp.is_cpu_available():
        pytest.skip("this Warp has no CPU device")
    if device != "cpu" and not wp.is_cuda_available():
        pytest.skip("needs a CUDA device")
    if name == "large frame":
        monkeypatch.setattr(cuda, "FORWARD_LOCALS", 0)
    return name, device


def simulator_of(way, model, parameters):
    name, device = way
    if name == "recorded":
        return recorded(model, device, parameters)
    simulator = Simulator(model, parameters, device=device)
    assert isinstance(simulator.engine, CpuEngine if name == "threaded" else CudaEngine)
    if name != "threaded":
        assert (simulator.engine.large is not None) == (name == "large frame")
    return simulator


@pytest.mark.parametrize("case", SCENES)
def test_every_way_moves_hard_objects_as_the_oracle_says(way, case):
    make, motion, error = SCENES[case]
    scene = make()
    position, velocity = simulate(scene)
    rollout = simulator_of(way, *as_model(scene)).rollout(scene.control)
    assert np.abs(position[-1] - position[0]).max() > motion
    if scene.ground is not None:
        assert velocity[0, :, 2].max() < 0 < velocity[1, :, 2].max()
    np.testing.assert_allclose(rollout.position, position, atol=error)


@pytest.mark.parametrize("adjoint", ["of the engine", "recorded"])
@pytest.mark.parametrize("case", SCENES)
def test_every_adjoint_agrees_with_central_differences_of_the_oracle(
    device, adjoint, case, monkeypatch
):
    if adjoint == "recorded":
        monkeypatch.setattr(CudaAdjoint, "of", lambda *_: None)
        monkeypatch.setattr(CpuAdjoint, "of", lambda *_: None)
    scene = SCENES[case][0]()
    scene = replace(scene, control=scene.control[:2], substeps=min(scene.substeps, 30))
    weights = loss_weights(scene)
    found = gradients(scene, device, weights)
    rng = np.random.default_rng(2)
    names = ("log_stiffness", "damping") if len(scene.springs) else ("restitution", "friction")
    for name in ("initial_velocity", *names):
        direction = rng.normal(size=found[name].shape)
        direction /= np.linalg.norm(direction)
        if name == "damping" and case == "a tenth of a millimetre":
            direction *= 0.01
        expected = directional_difference(scene, weights, name, direction)
        assert abs(expected) > 1e-8
        assert float((found[name] * direction).sum()) == pytest.approx(expected, rel=2e-3), name


@pytest.mark.parametrize("adjoint", ["of the engine", "recorded"])
def test_a_rollout_with_gradients_tells_where_it_diverges(device, adjoint, monkeypatch):
    import torch

    if adjoint == "recorded":
        monkeypatch.setattr(CudaAdjoint, "of", lambda *_: None)
        monkeypatch.setattr(CpuAdjoint, "of", lambda *_: None)
    model, control = thrown_block(5)
    stiff = replace(model, stiffness=(model.stiffness * 3e4).astype(np.float32))
    bridge = differentiable._bridge(stiff, PARAMETERS, device)
    assert isinstance(bridge.adjoint, GraphAdjoint) == (adjoint == "recorded")
    told = []
    with pytest.raises(SimulationDivergedError) as caught:
        recorded(stiff, device).rollout(control)
    told.append((caught.value.frame, caught.value.substep))
    log_stiffness = torch.log(torch.from_numpy(stiff.stiffness)).requires_grad_()
    with pytest.raises(SimulationDivergedError) as caught:
        differentiable.rollout(
            stiff,
            PARAMETERS,
            device=device,
            control=torch.from_numpy(control),
            log_stiffness=log_stiffness,
            damping=torch.from_numpy(stiff.damping),
        )
    told.append((caught.value.frame, caught.value.substep))
    assert told[0] == told[1]


BATCHES = {
    "a tenth of a millimetre": {"connection_radius": 1.6e-4, "stiffness": 1e-3, "damping": 0.01},
    "no springs": {"connection_radius": 1e-5},
    "one node": {"connection_radius": 1.6e-4},
}


@pytest.mark.parametrize("case", BATCHES)
def test_a_batch_moves_hard_objects_as_each_would_alone(device, case):
    rng = np.random.default_rng(3)
    axis = 1e-4 * np.arange(1 if case == "one node" else 4)
    node = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    node = (node + rng.normal(0, 5e-6, node.shape) + [0, 0, 0.002]).astype(np.float32)
    velocity = (rng.normal(0, 1e-3, node.shape) + np.array([0.02, 0.0, -0.1])).astype(np.float32)
    base = SimulationParameters(
        **BATCHES[case], max_neighbors=18, rest_length_floor=1e-5, substeps_per_frame=300
    )
    drawn = [base, base.replace(gravity=5.0, restitution=0.9, stiffness_scale=0.5)]
    still = np.zeros((4, 0, 3), np.float32)
    master = MasterTopology.of(node, still[0], drawn, initial_velocity=velocity)
    batch = BatchSimulator(master, drawn, device=device).rollout(still)
    assert np.all(batch.diverged_frame == -1)
    assert np.abs(batch.position[0, -1] - batch.position[1, -1]).max() > 1e-5
    for candidate, parameters in enumerate(drawn):
        model = master.model(parameters)
        assert (len(model.spring_nodes) > 100) == (case == "a tenth of a millimetre")
        wanted = recorded(model, device, parameters).rollout(still).position
        assert np.abs(wanted[-1] - wanted[0]).max() > 2e-4
        # Without the ground they would be more than 5 mm below it.
        assert wanted[-1, :, 2].min() > -1e-6
        np.testing.assert_allclose(batch.position[candidate], wanted, atol=2e-7)
