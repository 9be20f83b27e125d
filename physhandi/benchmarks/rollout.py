"""How long a simulated frame takes, beside a simulator built as PhysTwin's is, in one run."""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
import warp as wp

from physhandi.benchmarks.phystwin_like import PhysTwinLike
from physhandi.errors import UsageError
from physhandi.simulation import differentiable
from physhandi.simulation.model import SimulationParameters, SpringMassModel
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import stable_substeps
from physhandi.simulation.topology import build_model

_SPACING = 0.01
_STIFFNESS = 1e3


def benchmark_rollout(
    *,
    device: str = "cpu",
    node_count: int = 1000,
    frame_count: int = 5,
    substeps_per_frame: int = 667,
    model_path: str | Path | None = None,
    includes_backward: bool = True,
) -> dict[str, Any]:
    """Time forward and forward-and-backward frames of a synthetic block and of a given object.

    Args:
        device: Warp device, for example ``"cuda:0"``.
        node_count: Object nodes of the synthetic block, about 18 springs each; the nearest
            cube that has at least as many is taken.
        frame_count: Timed frames; the median counts.
        substeps_per_frame: Integration steps in a frame.
        model_path: An `.npz` with `position`, `spring_nodes`, `rest_length` and `stiffness`,
            measured in addition.
        includes_backward: Whether to time gradients too.

    Returns:
        Milliseconds a frame of both simulators and their ratios (above 1: ours is faster),
        with Warp's version and the device's name, ready for JSON.

    Raises:
        UsageError: If a number is not positive or the file is missing or incomplete.
    """
    if min(node_count, frame_count, substeps_per_frame) < 1:
        raise UsageError("Nodes, frames and substeps of a benchmark must be positive.")
    parameters = SimulationParameters(
        connection_radius=1.8 * _SPACING,
        max_neighbors=18,
        stiffness=_STIFFNESS,
        virtual_stiffness=_STIFFNESS,
        damping=10.0,
        use_control_velocity=False,
        substeps_per_frame=substeps_per_frame,
    )
    scenes = {"synthetic": _synthetic_block(node_count, parameters)}
    if model_path is not None:
        scenes[Path(model_path).stem] = _recorded_object(Path(model_path), parameters)
    measured = {
        name: _measure(model, control, parameters, device, frame_count, includes_backward)
        for name, (model, control) in scenes.items()
    }
    return {
        "benchmark": "rollout",
        "device": device,
        "device_name": wp.get_device(device).name,
        "warp": wp.__version__,
        "substeps_per_frame": substeps_per_frame,
        "frames": frame_count,
        "scenes": measured,
    }


def _measure(  # noqa: PLR0917  (private, and all of it is needed)
    model: SpringMassModel,
    control: np.ndarray,
    parameters: SimulationParameters,
    device: str,
    frame_count: int,
    includes_backward: bool,
) -> dict[str, Any]:
    """Time one scene, ours and the baseline in turns."""
    simulator = Simulator(model, parameters, device)
    baseline = PhysTwinLike(model, parameters, device)
    graph = baseline.capture_forward(control[0], control[1])
    result: dict[str, Any] = {
        "nodes": model.node_count,
        "springs": len(model.spring_nodes),
        "virtual_springs": model.virtual_spring_count,
        "stable_substeps": stable_substeps(model, parameters, control[0]),
        "forward": _compare(
            lambda: simulator.step_frame(1, control[0], control[1]),
            lambda: wp.capture_launch(graph),
            device,
            frame_count,
        ),
    }
    if includes_backward:
        path = torch.from_numpy(control[:2].astype(np.float32))
        log_stiffness = torch.from_numpy(np.log(model.stiffness)).requires_grad_()

        def step() -> None:
            position, _ = differentiable.rollout(
                model, parameters, path, log_stiffness=log_stiffness, device=device
            )
            position[-1, :, 2].sum().backward()

        both = baseline.capture_backward(control[0], control[1])
        result["forward_and_backward"] = _compare(
            step, lambda: wp.capture_launch(both), device, frame_count
        )
    return result


def _compare(
    ours: Callable[[], None], baseline: Callable[[], None], device: str, count: int
) -> dict[str, float]:
    """Return the median time of each in milliseconds, and how many times faster ours is."""
    times: dict[str, list[float]] = {"ours": [], "phystwin_like": []}
    for is_timed in (False, *[True] * count):
        for name, work in (("ours", ours), ("phystwin_like", baseline)):
            wp.synchronize_device(device)
            start = time.perf_counter()
            work()
            wp.synchronize_device(device)
            if is_timed:
                times[name].append(1e3 * (time.perf_counter() - start))
    own, other = median(times["ours"]), median(times["phystwin_like"])
    return {
        "ours_ms": round(own, 3),
        "phystwin_like_ms": round(other, 3),
        "ratio": round(other / own, 3),
    }


def _synthetic_block(
    node_count: int, parameters: SimulationParameters
) -> tuple[SpringMassModel, np.ndarray]:
    """Build a cube of nodes whose top is pulled up by nine control nodes."""
    side = max(2, math.ceil(node_count ** (1 / 3) - 1e-9))
    axis = _SPACING * np.arange(side)
    node = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    top = node[node[:, 2] == axis[-1]]
    control = top[np.linspace(0, len(top) - 1, min(9, len(top))).astype(int)]
    control = control + np.array([0.0, 0.0, 0.4 * _SPACING])
    return build_model(node, control, parameters), _lifted(control)


def _recorded_object(
    path: Path, parameters: SimulationParameters
) -> tuple[SpringMassModel, np.ndarray]:
    """Read springs from a file, floor their rest length, and hold the top nodes."""
    names = ("position", "spring_nodes", "rest_length", "stiffness")
    if not path.is_file():
        raise UsageError(f"There is no object file {path} to measure.")
    with np.load(path) as data:
        missing = [name for name in names if name not in data]
        if missing:
            raise UsageError(f"{path} lacks the arrays {', '.join(missing)}.")
        node, springs, rest_length, stiffness = (np.asarray(data[name]) for name in names)
    node = (node - [0.0, 0.0, node[:, 2].min()]).astype(np.float32)
    highest = np.argsort(node[:, 2], kind="stable")[-30:]
    control = node[highest] + np.array([0.0, 0.0, 0.01])
    few = replace(
        parameters, max_neighbors=0, virtual_connection_radius=0.04, virtual_max_neighbors=50
    )
    held = build_model(node, control, few)
    count = held.virtual_spring_count
    floor = np.float32(parameters.rest_length_floor)
    model = SpringMassModel(
        object_node=node,
        initial_velocity=held.initial_velocity,
        spring_nodes=np.concatenate([springs.astype(np.int32), held.spring_nodes]),
        rest_length=np.concatenate([np.maximum(rest_length, floor), held.rest_length]),
        stiffness=np.concatenate(
            [stiffness, np.full(count, np.median(stiffness), dtype=np.float32)]
        ),
        damping=np.full(len(springs) + count, 100.0, dtype=np.float32),
        object_spring_count=len(springs),
        control_count=len(control),
    )
    return model, _lifted(control)


def _lifted(control: np.ndarray) -> np.ndarray:
    """Return two frames in which control nodes rise by 2 mm."""
    return np.stack([control, control + np.array([0.0, 0.0, 2e-3])]).astype(np.float32)
