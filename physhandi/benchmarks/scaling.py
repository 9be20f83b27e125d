"""Benchmark of the growth of a frame's time with nodes and springs."""

import time
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from physhandi.benchmarks.rollout import measure_rollout
from physhandi.benchmarks.scenes import SUBSTEPS, BenchmarkScene, check_positive, synthetic_block
from physhandi.benchmarks.timing import describe_machine
from physhandi.devices import start_warp

NODE_COUNTS = (500, 1000, 3000, 10_000, 50_000)
"""Object nodes of the table."""
SCALED_SPRINGS_AT_NODE = (9, 18, 57)
"""Springs that end at a node on average: a sparse net, our usual object and PhysTwin's t_block."""
_SECONDS = ("ms_per_frame", "baseline_ms_per_frame")


def benchmark_scaling(
    *,
    device: str = "cpu",
    node_counts: Sequence[int] = NODE_COUNTS,
    springs_at_node: Sequence[int] = SCALED_SPRINGS_AT_NODE,
    frame_count: int = 3,
    substeps_per_frame: int = SUBSTEPS,
    time_limit_s: float = 300.0,
) -> dict[str, Any]:
    """Time rollouts of made-up blocks of many sizes, beside the baseline, from small to large.

    Args:
        device: Warp device, for example ``"cuda:0"``.
        node_counts: Object nodes of the blocks.
        springs_at_node: Springs that end at a node on average.
        frame_count: Frames of a rollout; each is done twice and the second one counts.
        substeps_per_frame: Integration steps in a frame.
        time_limit_s: A block that would end later than this, judged by the one before it, is
            not begun [s].

    Returns:
        ``table``: one row a block. ``skipped``: blocks that were not begun. ``growth``: the
        exponent p of time ~ size^p, fitted to all blocks with the same springs at a node, to
        the last two of them, and to all blocks with the same nodes.

    Raises:
        UsageError: If a number is not positive.
    """
    check_positive(frames=frame_count, time_limit_s=time_limit_s)
    start_warp()
    begin = time.monotonic()
    rows: list[dict[str, Any]] = []
    skipped: list[dict[str, int]] = []
    seconds_a_spring = 0.0
    for nodes in sorted(node_counts):
        for around in sorted(springs_at_node):
            size = {"nodes": nodes, "springs_at_node": around}
            start = time.monotonic()
            if start - begin + seconds_a_spring * nodes * around > time_limit_s:
                skipped.append(size)
                continue
            scene = synthetic_block(
                nodes,
                frame_count=frame_count,
                springs_at_node=around,
                substeps_per_frame=substeps_per_frame,
            )
            measured = measure_rollout(scene, device, rounds=1)
            rows.append(size | {"springs": _size(scene)} | measured)
            seconds_a_spring = (time.monotonic() - start) / (nodes * around)
    return {
        "benchmark": "scaling",
        **describe_machine(device),
        "frames": frame_count,
        "substeps": substeps_per_frame,
        "table": rows,
        "skipped": skipped,
        "growth": [
            *_growth_over(rows, "nodes", "springs_at_node", springs_at_node),
            *_growth_over(rows, "springs", "nodes", node_counts),
        ],
    }


def _size(scene: BenchmarkScene) -> int:
    return len(scene.model.spring_nodes)


def _growth_over(
    rows: list[dict[str, Any]], size: str, fixed: str, values: Iterable[int]
) -> list[dict[str, Any]]:
    """Fit time ~ size^p to the rows that have the same value of another quantity."""
    growths = []
    for value in sorted(values):
        alike = [row for row in rows if row[fixed] == value]
        if len(alike) < 2:
            continue
        growth: dict[str, Any] = {"over": size, fixed: value, "blocks": len(alike)}
        for name in _SECONDS:
            growth[name.replace("ms_per_frame", "exponent")] = _exponent(alike, size, name)
            last = name.replace("ms_per_frame", "exponent_of_last_two")
            growth[last] = _exponent(alike[-2:], size, name)
        growths.append(growth)
    return growths


def _exponent(rows: list[dict[str, Any]], size: str, name: str) -> float:
    logarithms = np.log([[row[size], row[name]] for row in rows])
    return float(np.polyfit(logarithms[:, 0], logarithms[:, 1], 1)[0])
