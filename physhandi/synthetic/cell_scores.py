"""What a cell is worth: its motion laid beside what the whole recording shows, and measured."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.atomic import write_array
from physhandi.data.run import Run
from physhandi.data.run_files import artefacts
from physhandi.data.sequence import Sequence
from physhandi.data.truth import read_truth
from physhandi.metrics.photometric import photometric_curves
from physhandi.metrics.report import measure_run


def measure_cell(
    run: Run | None, reference: Run, recording: Sequence
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Measure what a run predicted.

    The run brings its motion, hands and springs; observations are the reference's, whatever
    the run itself was given. Without a run the static object stands in.

    Args:
        run: What is scored.
        reference: The static object on the same recording.
        recording: The whole recording, with its truth.

    Returns:
        The report and the errors of the rollout frame by frame.
    """
    with tempfile.TemporaryDirectory() as folder:
        assemble(Path(folder), run, reference, recording)
        report, frames = measure_run(Path(folder), recording, with_baselines=False)
    curves: dict[str, Any] = frames.get("rollout", {})
    add_photometric(report, curves, run, reference, recording)
    return report, curves


def assemble(folder: Path, run: Run | None, reference: Run, recording: Sequence) -> None:
    """Lay out what is scored: the run's motion beside the reference's observations."""
    inside = f"sequences/{recording.name}"
    observed = (f"{inside}/observation/", f"{inside}/keypoint.npy")
    left_out = ("rollout.npy", "control.npy") if run is None else ()
    chosen = {r: path for r, path in artefacts(reference.out) if r.startswith(observed)} | {
        rel: path
        for rel, path in artefacts((reference if run is None else run).out)
        if not rel.startswith(observed) and not rel.endswith(left_out)
    }
    for rel, path in chosen.items():
        target = folder / rel
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(path.resolve())
    truth = read_truth(recording.folder).hand_vertex
    if run is not None and not any("_vertex.npy" in rel for rel in chosen):
        for side in recording.hands:  # An oracle moves the object with the true hand itself.
            if side in truth:
                write_array(folder / inside / f"hand_{side}_vertex.npy", truth[side])


def add_photometric(
    report: dict[str, Any],
    curves: dict[str, Any],
    run: Run | None,
    reference: Run,
    recording: Sequence,
) -> None:
    """Put IoU and PSNR beside the other figures of the rollout.

    Nodes are the run's own, however many they are, in the colors that frame 0 shows where it has
    them there. Frames that it lacks show its object as it was in frame 0.
    """
    rollout = _complete(run or reference, recording)
    found = photometric_curves(recording.views, rollout[:, : recording.surface_node_count])
    splits = {
        "reconstruction": recording.reconstruction_frames,
        "future": recording.future_frames,
    }
    for metric, curve in found.items():
        curves[metric] = [float(value) if np.isfinite(value) else None for value in curve]
        for split, scored in splits.items():
            known = [float(curve[f]) for f in scored if f > 0 and np.isfinite(curve[f])]
            if known and split in report:
                report[split]["rollout"][metric] = sum(known) / len(known)


def _complete(run: Run, recording: Sequence) -> Float[ndarray, "frame node 3"]:
    """Give a run's rollout in every frame; where it is missing or not finite, nothing moves."""
    inside = f"sequences/{recording.name}"
    rollout = run.array(f"{inside}/rollout.npy")
    known = f"{inside}/object_node.npy"
    still = run.array(known) if run.has(known) else rollout[0]
    complete = np.repeat(still[None].astype(rollout.dtype), recording.frame_count, axis=0)
    count = min(len(rollout), recording.frame_count)
    is_usable = np.isfinite(rollout[:count]).all(axis=(1, 2))
    complete[:count][is_usable] = rollout[:count][is_usable]
    return complete
