"""Imports what PhysTwin optimised for a case as a finished run, and compares the two simulators."""

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.attempt import Attempt
from physhandi.data.environment import ENVIRONMENT, describe_environment
from physhandi.data.importers.phystwin_experiment import (
    Checkpoint,
    Optimum,
    read_checkpoint,
    read_inference,
    read_optimum,
)
from physhandi.data.run import Run
from physhandi.data.sequence import Sequence
from physhandi.errors import ImportFailedError
from physhandi.fitting import artefacts
from physhandi.fitting.phystwin_material import phystwin_model, phystwin_parameters
from physhandi.fitting.profile import config_to_dict, load_profile
from physhandi.fitting.rollouts import simulate_sequence
from physhandi.metrics.report import measure_run
from physhandi.perception.lifting import observe_object
from physhandi.progress import NullProgress, Progress
from physhandi.simulation.model import SimulationParameters, SpringMassModel

STAGE = "import"
REPORT = "import.json"
"""Output that tells what was imported, what was changed, and how far the simulators differ."""
_SELF_COLLIDING = ("cloth", "package")


def import_phystwin_run(
    sequence: Sequence,
    optimal_params: Path,
    checkpoint: Path | None,
    out: Path,
    *,
    device: str,
    inference: Path | None = None,
    truncates_damping: bool | None = None,
    self_collision: bool | None = None,
    progress: Progress | None = None,
) -> Run:
    """Make a finished run of what PhysTwin optimised for a case, simulated by our simulator.

    Args:
        sequence: The case, as `import_phystwin` made it.
        optimal_params: ``experiments_optimization/{case}/optimal_params.pkl``.
        checkpoint: ``experiments/{case}/train/best_{epoch}.pth``; without one, all springs have the
            stiffness of the search.
        out: Where the run shall be.
        device: Warp device.
        inference: ``experiments/{case}/inference.pkl``, to compare our rollout with.
        truncates_damping: Whether dashpot and drag lose their decimals. PhysTwin's search simulated
            them with decimals; its second stage and its inference load them as whole numbers. Left
            out, they are truncated exactly if there is a checkpoint.
        self_collision: Whether nodes collide; left out, if the case's name has "cloth" or
            "package" in it, which is how PhysTwin chooses.
        progress: Told about every simulated frame; may ask to stop.

    Returns:
        The published run. ``import.json`` tells every number that is not used as it is stored, and
        the difference from `inference`.

    Raises:
        ImportFailedError: If a file is malformed, or does not belong to the sequence. Nothing is
            left behind then, as after any other error.
        RunError: If `out` exists already.
        SimulationDivergedError: If the motion runs away.
        CancelledError: If the user asked to stop.
    """
    watched = progress or NullProgress()
    node, control, case = _parts(sequence)
    optimum = read_optimum(optimal_params)
    stored = None if checkpoint is None else read_checkpoint(checkpoint)
    truncates = stored is not None if truncates_damping is None else truncates_damping
    collides = _collides(case) if self_collision is None else self_collision
    profile = load_profile("phystwin")
    parameters, notes = phystwin_parameters(
        profile.simulation,
        optimum,
        optimum.contact if stored is None else stored.contact,
        truncates_damping=truncates,
        self_collision=collides,
    )
    parameters = parameters.in_world(
        frame_rate=sequence.frame_rate,
        ground_height=sequence.ground_height,
        gravity=sequence.gravity,
    )
    model, more = phystwin_model(node, control[0], parameters, stored, source=checkpoint)
    expected = None
    if inference is not None:
        expected = read_inference(inference, (sequence.frame_count, len(node))) @ _up(sequence)
    files = {"optimal_params": optimal_params, "checkpoint": checkpoint, "inference": inference}
    report = {
        "case": case,
        "files": {name: _file(path) for name, path in files.items() if path is not None},
        "truncates_damping": truncates,
        "self_collision": collides,
        "changed": notes + more,
        "springs": _springs(model, optimum, stored),
    }
    run = Run.create(
        out,
        name=f"PhysTwin: {case}",
        kind="reconstruction",
        sequences=[str(sequence.folder)],
        config={
            "profile": config_to_dict(replace(profile, simulation=parameters)),
            "imported": report,
        },
    )
    try:
        with run.begin_attempt() as attempt:
            told = attempt.progress(watched)
            _fill(attempt, sequence, model, parameters, device=device, progress=told)
            _finish(attempt, sequence, report, expected)
            attempt.publish()
    except BaseException:
        run.delete()
        raise
    return Run.open(run.folder)


def _parts(sequence: Sequence) -> tuple[ndarray, ndarray, str]:
    """Give object nodes, controls and the case's name."""
    if sequence.provenance.get("importer") != "phystwin":
        raise ImportFailedError(
            f"Sequence '{sequence.name}' is not an imported PhysTwin case, so PhysTwin's results "
            "cannot be laid on its nodes. Import the case first."
        )
    if sequence.object_node is None or sequence.control is None:
        raise ImportFailedError(
            f"Sequence '{sequence.name}' has no object nodes or controls: its case had no "
            "final_data.pkl. Import a case that has one."
        )
    return sequence.object_node, sequence.control, str(sequence.provenance.get("case", ""))


def _collides(case: str) -> bool:
    return any(word in case for word in _SELF_COLLIDING)


def _up(sequence: Sequence) -> Float[ndarray, "3 3"]:
    """Turn the case's world as the importer did."""
    is_down = sequence.provenance.get("z_axis_pointed") == "down"
    return np.diag([1.0, -1.0, -1.0]) if is_down else np.eye(3)


def _file(path: Path) -> dict[str, str]:
    with path.open("rb") as stream:
        return {"name": path.name, "sha256": hashlib.file_digest(stream, "sha256").hexdigest()}


def _springs(
    model: SpringMassModel, optimum: Optimum, checkpoint: Checkpoint | None
) -> dict[str, Any]:
    return {
        "object": model.object_spring_count,
        "virtual": model.virtual_spring_count,
        "global_stiffness": optimum.stiffness,
        "epoch": None if checkpoint is None else checkpoint.epoch,
    }


def _fill(
    attempt: Attempt,
    sequence: Sequence,
    model: SpringMassModel,
    parameters: SimulationParameters,
    *,
    device: str,
    progress: Progress,
) -> None:
    """Store what a fit would have stored, and simulate all frames."""
    folder = artefacts.sequence_folder(sequence.name)
    environment = describe_environment(device, wp.get_device(device).name)
    attempt.save_json(ENVIRONMENT, environment)
    artefacts.save_sequence_meta(attempt, sequence)
    artefacts.save_observation(attempt, sequence.name, observe_object(sequence, progress))
    attempt.save_array(f"{folder}/object_node.npy", model.object_node)
    attempt.save_array(f"{folder}/control.npy", np.asarray(sequence.control, np.float32))
    attempt.save_array("object/rest_node.npy", model.object_node)
    artefacts.save_model(attempt, sequence.name, model)
    artefacts.save_object(attempt, parameters, model, model.object_node)
    simulate_sequence(attempt, sequence, device=device, progress=progress)


def _finish(
    attempt: Attempt,
    sequence: Sequence,
    report: Mapping[str, Any],
    expected: Float[ndarray, "frame node 3"] | None,
) -> None:
    """Compare and measure."""
    folder = artefacts.sequence_folder(sequence.name)
    comparison: dict[str, Any] = {}
    if expected is not None:
        rollout = np.load(attempt.out / folder / "rollout.npy", allow_pickle=False)
        comparison = compare_rollouts(rollout, expected)
    attempt.save_json(REPORT, {**report, "inference": comparison or None})
    metrics, errors = measure_run(attempt.out, sequence)
    attempt.save_json("metrics.json", {sequence.name: metrics})
    attempt.save_json(f"{folder}/frame_errors.json", errors)
    attempt.finish_stage(STAGE, {"curve": [], **comparison})


def compare_rollouts(
    rollout: Float[ndarray, "frame node 3"], expected: Float[ndarray, "frame node 3"]
) -> dict[str, Any]:
    """Tell how far two rollouts of the same nodes are from each other.

    Returns:
        ``max_difference`` and ``mean_difference`` of all nodes and frames [m], the frame and node
        of the former, and ``largest_motion`` of any node of `expected`, to compare them with [m].
    """
    distance = np.linalg.norm(rollout.astype(np.float64) - expected, axis=-1)
    frame, node = np.unravel_index(int(distance.argmax()), distance.shape)
    return {
        "max_difference": float(distance.max()),
        "mean_difference": float(distance.mean()),
        "frame": int(frame),
        "node": int(node),
        "largest_motion": float(np.linalg.norm(expected - expected[0], axis=-1).max()),
    }
