"""The benchmark measures two simulators that agree with each other."""

import json

import numpy as np
import pytest
from reference.scenes import as_model, cube_scene

from physhandi.benchmarks.phystwin_like import PhysTwinLike
from physhandi.benchmarks.rollout import benchmark_rollout
from physhandi.errors import UsageError
from physhandi.simulation.simulator import Simulator


def test_the_baseline_simulates_the_same_motion(device):
    import warp as wp

    scene = cube_scene(moves=False, damping=np.full(33, 2.0))
    model, parameters = as_model(scene)
    baseline = PhysTwinLike(model, parameters, device)
    wp.capture_launch(baseline.capture_forward(scene.control[0], scene.control[1]))
    expected = Simulator(model, parameters, device=device).rollout(scene.control[:2])
    assert np.abs(expected.position[1] - expected.position[0]).max() > 0.005
    np.testing.assert_allclose(baseline.position.numpy(), expected.position[1], atol=1e-6)


def test_the_result_is_json_with_times_and_ratios(device, tmp_path):
    node = np.random.default_rng(0).uniform(0, 0.05, (40, 3)).astype(np.float32)
    springs = np.stack([np.arange(39), np.arange(1, 40)], axis=1)
    length = np.linalg.norm(np.diff(node, axis=0), axis=1).astype(np.float32)
    arrays = {"position": node, "spring_nodes": springs, "rest_length": length}
    np.savez(tmp_path / "thing.npz", **arrays, stiffness=np.full(39, 100.0, dtype=np.float32))
    result = benchmark_rollout(
        device=device,
        node_count=60,
        frame_count=1,
        substeps_per_frame=400,
        model_path=tmp_path / "thing.npz",
    )
    assert json.loads(json.dumps(result)) == result
    assert result["scenes"]["synthetic"]["nodes"] == 64
    assert result["scenes"]["thing"]["springs"] > 39
    for scene in result["scenes"].values():
        for part in ("forward", "forward_and_backward"):
            assert scene[part]["ours_ms"] > 0.0
            assert scene[part]["ratio"] > 0.0


def test_a_missing_or_incomplete_object_is_named(device, tmp_path):
    small = {"device": device, "node_count": 8, "frame_count": 1, "substeps_per_frame": 2}
    with pytest.raises(UsageError, match=r"no object file .*gone\.npz"):
        benchmark_rollout(**small, model_path=tmp_path / "gone.npz")
    np.savez(tmp_path / "part.npz", position=np.zeros((2, 3)))
    with pytest.raises(UsageError, match="lacks the arrays spring_nodes, rest_length, stiffness"):
        benchmark_rollout(**small, model_path=tmp_path / "part.npz")
    with pytest.raises(UsageError, match="must be positive"):
        benchmark_rollout(**(small | {"frame_count": 0}))
