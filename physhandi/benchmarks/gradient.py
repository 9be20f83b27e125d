"""Benchmark of a simulated frame with its gradient, beside PhysTwin's method in the same run."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from physhandi.benchmarks.phystwin_like import PhysTwinLike
from physhandi.benchmarks.scenes import SUBSTEPS, BenchmarkScene, scene_of
from physhandi.benchmarks.timing import (
    describe_difference,
    describe_scene,
    describe_times,
    describe_traffic,
    time_in_turns,
)
from physhandi.devices import start_warp
from physhandi.simulation import differentiable
from physhandi.simulation.engines.tape import frame_bytes, memory_budget, stored_frames

GRADIENT_COST = (56, 168, 48)
"""Bytes of a substep forward with 36 B a node written down, and back: springs 20 + 36 (read, and
two gradients added to), object nodes 84 + 84, control nodes 2 x 24. Frames that are simulated
twice, because memory does not hold their substeps, are counted once."""
_ROUNDS = 3


def benchmark_gradient(
    *,
    device: str = "cpu",
    node_count: int = 1000,
    frame_count: int = 10,
    substeps_per_frame: int = SUBSTEPS,
    topology: str | Path | None = None,
) -> dict[str, Any]:
    """Time rollouts with gradients of ours and of the baseline in turns; the median counts.

    Ours differentiates the heights of all nodes in all frames through the whole horizon, with
    respect to the stiffness of each spring, through PyTorch. The baseline does it frame by
    frame, as PhysTwin.

    Args:
        device: Warp device, for example ``"cuda:0"``.
        node_count: Object nodes of the made-up block, with 18 springs at each.
        frame_count: Frames of a rollout.
        substeps_per_frame: Integration steps in a frame.
        topology: An `.npz` with `position`, `spring_nodes`, `rest_length` and `stiffness` to
            measure instead.

    Returns:
        Times, the difference of the two motions, the difference of the two gradients when ours
        is cut after each frame too, relative to the gradient's length, the memory traffic, and of
        how many frames the substeps were kept in how much memory.

    Raises:
        UsageError: If a number is not positive or the file is missing or incomplete.
    """
    start_warp()
    scene = scene_of(topology, node_count, frame_count, substeps_per_frame)
    about = describe_scene(scene, device)
    baseline = PhysTwinLike(scene.model, scene.parameters, device)
    layout = differentiable.tape_layout(scene.model, scene.parameters, device)
    memory = memory_budget(device)
    stored = stored_frames(layout, frame_count, memory)
    works = {
        "ours": lambda: _gradient(scene, device, memory, window=None),
        "baseline": lambda: baseline.rollout_with_gradient(scene.control),
    }
    times = time_in_turns(works, device, _ROUNDS)
    ours, other = (times[name] / frame_count for name in works)
    position, gradient = _gradient(scene, device, memory, window=1)
    expected = np.array(baseline.log_stiffness.grad.numpy(), dtype=np.float64)
    size = float(np.linalg.norm(expected))
    difference = float(np.linalg.norm(gradient - expected))
    return {
        "benchmark": "gradient",
        **about,
        **describe_times(ours, other),
        **describe_difference(position, baseline.position.numpy(), scene.model.object_node),
        "gradient_norm": size,
        "gradient_relative_difference": difference / max(size, 1e-30),
        "stored_frames": stored,
        "trajectory_bytes": stored * frame_bytes(layout),
        **describe_traffic(scene, GRADIENT_COST, ours, device),
    }


def _gradient(
    scene: BenchmarkScene, device: str, memory: int, window: int | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return where our rollout ends [m], and its gradient in the logarithm of stiffness."""
    log_stiffness = torch.from_numpy(np.log(scene.model.stiffness)).to(_torch_device(device))
    log_stiffness.requires_grad_()
    control = torch.from_numpy(scene.control).to(log_stiffness.device)
    position, _ = differentiable.rollout(
        scene.model,
        scene.parameters,
        control,
        log_stiffness=log_stiffness,
        device=device,
        window=window,
        memory=memory,
    )
    (gradient,) = torch.autograd.grad(position[1:, :, 2].sum(), log_stiffness)
    return position[-1].detach().cpu().numpy(), gradient.double().cpu().numpy()


def _torch_device(device: str) -> torch.device:
    return torch.device(wp.device_to_torch(wp.get_device(device)))
