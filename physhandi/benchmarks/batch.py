"""Benchmark of a batch: frames a second of simulating and scoring many candidates."""

from collections.abc import Sequence as Many
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from physhandi.benchmarks.phystwin_like import PhysTwinLike
from physhandi.benchmarks.scenes import SUBSTEPS, BenchmarkScene, check_positive, scene_of
from physhandi.benchmarks.timing import (
    describe_difference,
    describe_scene,
    describe_times,
    describe_traffic,
    time_in_turns,
)
from physhandi.devices import start_warp
from physhandi.simulation.engines.batch import (
    BatchSimulator,
    MotionTarget,
    losses_at_once,
    shared_out,
)
from physhandi.simulation.master_topology import MasterTopology
from physhandi.simulation.parameters import SimulationParameters

_COST = (0, 48, 0)
"""Bytes of a substep and candidate: position and velocity of each node in and out. What the
candidates share, springs and control nodes, is not counted."""
_ROUNDS = 2
_POINTS, _TRACKS = 300, 100


def benchmark_batch(
    *,
    device: str = "cpu",
    more_devices: Many[str] = (),
    node_count: int = 1000,
    frame_count: int = 10,
    candidate_count: int = 64,
    substeps_per_frame: int = SUBSTEPS,
    topology: str | Path | None = None,
) -> dict[str, Any]:
    """Time one generation of a search; the baseline simulates one candidate of middling size.

    Candidates differ in stiffness, damping, drag, ground contact and connection radii, hence
    also in their springs. Ours also compares every frame of every candidate with made-up points
    and tracks, on the device; the baseline compares nothing. The median round counts; what the
    batch prepares comes before.

    Args:
        device: Warp device, for example ``"cuda:0"``.
        more_devices: Further GPUs, which share the batch with it in another measurement.
        node_count: Object nodes of the made-up block, with at most 18 springs at each.
        frame_count: Frames of a rollout.
        candidate_count: Candidates of the batch.
        substeps_per_frame: Integration steps in a frame.
        topology: An `.npz` as of `recorded_object` to measure instead. Its nodes are taken, and
            springs join as many of its nearest pairs as it has springs: candidates are made of
            radii, so none has exactly the springs of the file.

    Returns:
        Times a frame of a candidate, and the largest difference of the stiffest and the widest
        candidate from the baseline's motion of the same, ready for JSON. With several devices also
        ``shared``: ``devices``, ``ms_per_frame`` of a candidate, the ``speedup`` over one device,
        and the largest relative difference of a loss (``largest_loss_difference``).

    Raises:
        UsageError: If a number is not positive or the file is missing or incomplete.
    """
    check_positive(candidates=candidate_count)
    start_warp()
    scene = scene_of(topology, node_count, frame_count, substeps_per_frame)
    candidates = _candidates(scene.parameters, candidate_count)
    master = MasterTopology.of(scene.model.object_node, scene.control[0], candidates)
    models = [master.model(parameters) for parameters in candidates]
    springs = [len(model.spring_nodes) for model in models]
    widest = replace(scene, model=models[0], parameters=candidates[0])
    about = describe_scene(widest, device)
    simulator = BatchSimulator(master, candidates, device)
    middling = int(np.argsort(springs)[len(springs) // 2])
    stiffest = int(np.argmax([parameters.stiffness for parameters in candidates]))
    baselines = {
        index: PhysTwinLike(models[index], candidates[index], device)
        for index in {0, middling, stiffest}
    }
    target = _target(scene)
    devices = (device, *more_devices)
    parts = shared_out(range(candidate_count), len(devices))
    simulators = [
        BatchSimulator(master, [candidates[index] for index in part], one)
        for part, one in zip(parts, devices, strict=False)
    ]
    works = {
        "ours": lambda: simulator.losses(scene.control, target),
        "baseline": lambda: baselines[middling].rollout(scene.control),
    }
    if more_devices:
        works["shared"] = lambda: losses_at_once(simulators, scene.control, target)
    times = time_in_turns(works, device, _ROUNDS)
    ours = times["ours"] / (frame_count * candidate_count)
    rollout = simulator.rollout(scene.control)
    differences = []
    for index in (0, stiffest):
        baselines[index].rollout(scene.control)
        differences.append(
            describe_difference(
                rollout.position[index, -1],
                baselines[index].position.numpy(),
                scene.model.object_node,
            )
        )
    shared: dict[str, Any] = {}
    if more_devices:
        alone = simulator.losses(scene.control, target).loss
        together = losses_at_once(simulators, scene.control, target).loss
        shared["shared"] = {
            "devices": len(simulators),
            "ms_per_frame": 1e3 * times["shared"] / (frame_count * candidate_count),
            "speedup": times["ours"] / times["shared"],
            "largest_loss_difference": float(np.max(np.abs(together / alone - 1.0))),
        }
    return {
        "benchmark": "batch",
        **about,
        "candidates": candidate_count,
        "observed_points": target.cloud.shape[1],
        "observed_tracks": target.track.shape[1],
        "median_springs": int(median(springs)),
        "diverged": int(np.sum(rollout.diverged_frame >= 0)),
        **describe_times(ours, times["baseline"] / frame_count),
        **{name: max(d[name] for d in differences) for name in differences[0]},
        **describe_traffic(widest, _COST, ours, device),
        **shared,
    }


def _target(scene: BenchmarkScene) -> MotionTarget:
    """Generate a typical number of observed points and tracks near the initial nodes."""
    node, frames = scene.model.object_node, len(scene.control)
    rng = np.random.default_rng(1)
    points, tracks = (rng.integers(0, len(node), count) for count in (_POINTS, _TRACKS))
    cloud = node[points] + rng.normal(0.0, 0.003, (frames, _POINTS, 3))
    return MotionTarget(
        cloud=cloud,
        cloud_weight=np.full((frames, _POINTS), 1.0 / _POINTS),
        surface_count=None,
        track=np.repeat(node[tracks][None], frames, axis=0),
        track_weight=np.full((frames, _TRACKS), 1.0 / _TRACKS),
        carrier=tracks[:, None],
        carrier_weight=np.ones((_TRACKS, 1)),
        track_offset=np.zeros((_TRACKS, 3)),
    )


def _candidates(reference: SimulationParameters, count: int) -> list[SimulationParameters]:
    """Vary every searched parameter; the first candidate is the reference itself."""
    rng = np.random.default_rng(0)
    return [
        reference,
        *(
            reference.replace(
                connection_radius=reference.connection_radius * rng.uniform(0.8, 1.0),
                virtual_connection_radius=reference.virtual_connection_radius
                * rng.uniform(0.8, 1.0),
                stiffness=reference.stiffness * 2.0 ** rng.uniform(-1.0, 1.0),
                virtual_stiffness=reference.virtual_stiffness * 2.0 ** rng.uniform(-1.0, 1.0),
                damping=reference.damping * rng.uniform(0.5, 1.0),
                drag=rng.uniform(0.0, 6.0),
                restitution=rng.uniform(0.0, 1.0),
                friction=rng.uniform(0.0, 1.0),
            )
            for _ in range(count - 1)
        ),
    ]
