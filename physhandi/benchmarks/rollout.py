"""Benchmark of a simulated frame, beside a simulator like PhysTwin's in the same run."""

from pathlib import Path
from typing import Any

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
from physhandi.simulation.simulator import Simulator

FORWARD_COST = (20, 48, 24)
"""Bytes of a substep. Spring: two ends, rest length, stiffness, damping. Object node: position
and velocity in and out. Control node: where the frame starts and ends."""
_ROUNDS = 3


def benchmark_rollout(
    *,
    device: str = "cpu",
    node_count: int = 1000,
    frame_count: int = 10,
    substeps_per_frame: int = SUBSTEPS,
    topology: str | Path | None = None,
) -> dict[str, Any]:
    """Time rollouts of ours and of the baseline in turns; the median counts.

    Ours includes what a rollout cannot do without: the check for divergence after each frame.
    Captures and compilation come before.

    Args:
        device: Warp device, for example ``"cuda:0"``.
        node_count: Object nodes of the made-up block, with 18 springs at each.
        frame_count: Frames of a rollout.
        substeps_per_frame: Integration steps in a frame.
        topology: An `.npz` with `position`, `spring_nodes`, `rest_length` and `stiffness` to
            measure instead.

    Returns:
        Times, the difference of the two motions and the memory traffic, ready for JSON.

    Raises:
        UsageError: If a number is not positive or the file is missing or incomplete.
    """
    start_warp()
    scene = scene_of(topology, node_count, frame_count, substeps_per_frame)
    about = describe_scene(scene, device)
    measured = measure_rollout(scene, device, rounds=_ROUNDS)
    seconds = 1e-3 * measured["ms_per_frame"]
    return {
        "benchmark": "rollout",
        **about,
        **measured,
        **describe_traffic(scene, FORWARD_COST, seconds, device),
    }


def measure_rollout(scene: BenchmarkScene, device: str, *, rounds: int) -> dict[str, float]:
    """Time the rollout of a scene with both simulators, and compare where they end."""
    simulator = Simulator(scene.model, scene.parameters, device)
    baseline = PhysTwinLike(scene.model, scene.parameters, device)
    control = scene.control

    def ours() -> None:
        simulator.reset()
        for frame in range(1, len(control)):
            simulator.step_frame(frame, control[frame - 1], control[frame])

    works = {"ours": ours, "baseline": lambda: baseline.rollout(control)}
    times = time_in_turns(works, device, rounds)
    return {
        **describe_times(*(times[name] / scene.frame_count for name in works)),
        **describe_difference(
            simulator.position.numpy(), baseline.position.numpy(), scene.model.object_node
        ),
    }
