"""Benchmark of fewer substeps: the difference of the motion from that with 667."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.benchmarks.scenes import SUBSTEPS, BenchmarkScene
from physhandi.benchmarks.timing import describe_scene, time_in_turns
from physhandi.devices import start_warp
from physhandi.errors import UsageError
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import with_stable_substeps

SCATTER = (SUBSTEPS - 1, SUBSTEPS + 33)
"""Numbers of substeps as good as the reference: how far they are from it is chance (contacts
that close a substep earlier or later), which no choice of substeps can undercut."""
_ROUNDS = 2


def benchmark_substeps(
    model: SpringMassModel,
    parameters: SimulationParameters,
    control: Float[ndarray, "frame control 3"],
    *,
    name: str,
    device: str = "cpu",
    substeps: Sequence[int] = (),
) -> dict[str, Any]:
    """Compare automatic substeps, and other numbers of them, with the reference of 667.

    Args:
        model: Springs and nodes.
        parameters: What to simulate with; its own number of substeps is measured too.
        control: Positions of the control nodes [m]; at least two frames.
        name: What the object is called.
        device: Warp device, for example ``"cuda:0"``.
        substeps: More numbers of substeps to measure.

    Returns:
        For automatic substeps: the time and the reference's, the mean over the nodes of the
        distance from the reference's motion, averaged over frames and in the worst frame, and
        the largest of any node [m]; the same for all numbers in ``table``.

    Raises:
        UsageError: If there is no frame to simulate.
        SimulationDivergedError: If a motion runs away.
    """
    start_warp()
    if len(control) < 2:
        raise UsageError(f"{name} has {len(control)} frames; substeps need at least two.")
    automatic = with_stable_substeps(parameters, model, control[0]).substeps_per_frame
    counts = {automatic, parameters.substeps_per_frame, SUBSTEPS, *SCATTER, *substeps}
    works, motions = {}, {}
    for count in sorted(counts):
        simulator = Simulator(model, parameters.replace(substeps_per_frame=count), device)
        works[str(count)] = _keep(simulator, control, motions, count)
    times = time_in_turns(works, device, _ROUNDS)
    reference = motions[SUBSTEPS]
    table = [
        {
            "substeps": count,
            "ms_per_frame": 1e3 * times[str(count)] / (len(control) - 1),
            **_distance(motions[count], reference),
        }
        for count in sorted(counts)
    ]
    chosen = next(row for row in table if row["substeps"] == automatic)
    rated = next(row for row in table if row["substeps"] == SUBSTEPS)
    scene = BenchmarkScene(
        name=name,
        model=model,
        parameters=parameters.replace(substeps_per_frame=automatic),
        control=np.asarray(control, dtype=np.float32),
    )
    return {
        "benchmark": "substeps",
        **describe_scene(scene, device),
        "reference_substeps": SUBSTEPS,
        **chosen,
        "baseline_ms_per_frame": rated["ms_per_frame"],
        "speedup": rated["ms_per_frame"] / chosen["ms_per_frame"],
        "motion_m": float(np.linalg.norm(reference - reference[0], axis=-1).max()),
        "scatter_of_reference": [row for row in table if row["substeps"] in SCATTER],
        "table": table,
    }


def _keep(simulator: Simulator, control: ndarray, motions: dict[int, ndarray], count: int) -> Any:
    def work() -> None:
        motions[count] = simulator.rollout(control).position

    return work


def _distance(position: ndarray, reference: ndarray) -> dict[str, float]:
    distance = np.linalg.norm(position.astype(np.float64) - reference, axis=-1)
    return {
        "mean_difference_m": float(distance.mean()),
        "worst_frame_mean_difference_m": float(distance.mean(axis=1).max()),
        "max_abs_difference_m": float(np.max(np.abs(position - reference))),
    }
