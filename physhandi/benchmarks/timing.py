"""Timing, memory traffic and machine description for all benchmarks."""

import os
import time
from collections.abc import Callable, Mapping
from statistics import median
from typing import Any

import numpy as np
import warp as wp

from physhandi.benchmarks.scenes import BenchmarkScene
from physhandi.data.environment import describe_environment
from physhandi.devices import describe_device
from physhandi.simulation.stability import stable_substeps

_COPY_SIZE = {"cpu": 1 << 27, "cuda": 1 << 29}
_COPIES = 5


def time_in_turns(
    works: Mapping[str, Callable[[], object]], device: str, rounds: int
) -> dict[str, float]:
    """Time several works that compete, one after the other in each round.

    Args:
        works: What to time; each is done once more before, untimed.
        device: Warp device, which is waited for.
        rounds: How often.

    Returns:
        The median time of each [s].
    """
    times: dict[str, list[float]] = {name: [] for name in works}
    for is_timed in (False, *[True] * rounds):
        for name, work in works.items():
            wp.synchronize_device(device)
            start = time.perf_counter()
            work()
            wp.synchronize_device(device)
            seconds = time.perf_counter() - start
            if is_timed:
                times[name].append(seconds)
    return {name: median(durations) for name, durations in times.items()}


def copy_bandwidth(device: str) -> float:
    """Measure how fast the device copies memory that no cache holds, read plus written [B/s].

    A CPU copies with one thread.
    """
    kind = "cuda" if wp.get_device(device).is_cuda else "cpu"
    source = wp.zeros(_COPY_SIZE[kind], dtype=wp.uint8, device=device)
    target = wp.zeros_like(source)
    fastest = np.inf
    for _ in range(_COPIES):
        wp.synchronize_device(device)
        start = time.perf_counter()
        wp.copy(target, source)
        wp.synchronize_device(device)
        fastest = min(fastest, time.perf_counter() - start)
    return 2 * _COPY_SIZE[kind] / fastest


def describe_machine(device: str) -> dict[str, Any]:
    """Describe device, versions and load of the machine."""
    environment = describe_environment(device, describe_device(device))
    return {
        "device": device,
        "device_name": environment["device_name"],
        "warp": wp.__version__,
        "commit": environment["commit"],
        "load_average": os.getloadavg()[0],
    }


def describe_scene(scene: BenchmarkScene, device: str) -> dict[str, Any]:
    """Describe scene and machine."""
    model = scene.model
    return {
        **describe_machine(device),
        "scene": scene.name,
        "nodes": model.node_count,
        "springs": len(model.spring_nodes),
        "virtual_springs": model.virtual_spring_count,
        "frames": scene.frame_count,
        "substeps": scene.parameters.substeps_per_frame,
        "stable_substeps": stable_substeps(model, scene.parameters, scene.control[0]),
    }


def describe_times(ours: float, baseline: float) -> dict[str, float]:
    """Compare seconds a frame of our simulator and of the baseline."""
    return {
        "ms_per_frame": 1e3 * ours,
        "frames_per_s": 1.0 / ours,
        "baseline_ms_per_frame": 1e3 * baseline,
        "speedup": baseline / ours,
    }


def describe_traffic(
    scene: BenchmarkScene, cost: tuple[int, int, int], seconds: float, device: str
) -> Any:
    """Compare the memory that a frame must move with what the device can copy meanwhile.

    Args:
        scene: What was simulated.
        cost: Bytes a substep per spring, object node and control node, if every array is moved
            once a substep. What stays in registers or caches is counted all the same, so that
            the fraction may exceed 1.
        seconds: Time of a frame [s].
        device: Warp device.
    """
    model, substeps = scene.model, scene.parameters.substeps_per_frame
    springs, nodes, controls = cost
    moved = substeps * (
        springs * len(model.spring_nodes)
        + nodes * model.node_count
        + controls * model.control_count
    )
    bandwidth = copy_bandwidth(device)
    return {
        "bytes_per_frame": moved,
        "bytes_formula": f"substeps x ({springs} B x springs + {nodes} B x nodes + "
        f"{controls} B x control nodes): every array once a substep, nothing kept on the chip",
        "gigabytes_per_s": 1e-9 * moved / seconds,
        "copy_gigabytes_per_s": 1e-9 * bandwidth,
        "bandwidth_fraction": moved / seconds / bandwidth,
    }


def describe_difference(
    ours: np.ndarray, baseline: np.ndarray, start: np.ndarray
) -> dict[str, float]:
    """Compute the final difference between the simulators, and the object's motion [m]."""
    return {
        "max_abs_difference_m": float(np.max(np.abs(ours - baseline), initial=0.0)),
        "motion_m": float(np.max(np.abs(ours - start), initial=0.0)),
    }
