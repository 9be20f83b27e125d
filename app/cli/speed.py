"""What `physhandi benchmark` does; returns plain data and never prints."""

from typing import Any

from app.cli.arguments import (
    BenchmarkBatch,
    BenchmarkGradient,
    BenchmarkLive,
    BenchmarkScaling,
    BenchmarkSubsteps,
    BenchmarkViewer,
)
from app.cli.commands import find_result
from physhandi.devices import pick_device
from physhandi.errors import UsageError


def measure(what: Any) -> dict[str, Any]:
    """Measure speed; see docs/benchmarks.

    Raises:
        UsageError: If a number makes no sense, or the device or a file is missing.
    """
    if isinstance(what, BenchmarkViewer):
        return _benchmark_viewer(what)
    device = pick_device(what.device)
    match what:
        case BenchmarkScaling():
            from physhandi.benchmarks.scaling import benchmark_scaling

            return benchmark_scaling(
                device=device,
                node_counts=what.nodes,
                springs_at_node=what.springs_at_node,
                frame_count=what.frames,
                time_limit_s=what.time_limit_s,
            )
        case BenchmarkSubsteps() | BenchmarkLive():
            return _benchmark_run(what, device)
        case _:
            return _benchmark_scene(what, device)


def _benchmark_scene(what: Any, device: str) -> dict[str, Any]:
    common: dict[str, Any] = {
        "device": device,
        "node_count": what.nodes,
        "frame_count": what.frames,
        "topology": what.topology,
    }
    match what:
        case BenchmarkBatch():
            from physhandi.benchmarks.batch import benchmark_batch

            return benchmark_batch(candidate_count=what.candidates, **common)
        case BenchmarkGradient():
            from physhandi.benchmarks.gradient import benchmark_gradient

            return benchmark_gradient(**common)
        case _:
            from physhandi.benchmarks.rollout import benchmark_rollout

            return benchmark_rollout(**common)


def _benchmark_viewer(what: BenchmarkViewer) -> dict[str, Any]:
    from app.benchmarks.parts import PARTS
    from app.benchmarks.viewer import measure_viewer

    run = find_result(what.run, what.data_dir)
    parts = what.parts or PARTS
    return measure_viewer(run, run.sequence_names[0], parts=parts, is_quick=what.quick)


def _benchmark_run(what: Any, device: str) -> dict[str, Any]:
    run = find_result(what.run, what.data_dir)
    sequence = what.sequence or run.sequence_names[0]
    if sequence not in run.sequence_names:
        raise UsageError(
            f"Run '{run.id}' has no sequence '{sequence}', but {', '.join(run.sequence_names)}."
        )
    if isinstance(what, BenchmarkLive):
        from app.benchmarks.latency import measure_latency

        return measure_latency(run, sequence, device=device)
    from physhandi.benchmarks.substeps import benchmark_substeps
    from physhandi.fitting import artefacts

    return benchmark_substeps(
        artefacts.load_model(run.out, sequence),
        artefacts.load_parameters(run.out),
        run.array(f"{artefacts.sequence_folder(sequence)}/control.npy"),
        name=f"{run.id}: {sequence}",
        device=device,
        substeps=what.substeps,
    )
