"""Imports PhysTwin's optimised result of a case as a finished run, and compares the simulators."""

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.data.attempt import Attempt
from physhandi.data.environment import ENVIRONMENT, describe_environment
from physhandi.data.importers.phystwin_experiment import (
    Checkpoint,
    Contact,
    Optimum,
    read_inference,
    read_optimum,
    read_phystwin_checkpoint,
)
from physhandi.data.layout import METRICS_FILE, REST_NODE_FILE, SequenceFiles
from physhandi.data.run import RunFolder
from physhandi.data.sequence import Sequence
from physhandi.devices import describe_device
from physhandi.errors import ImportFailedError
from physhandi.fitting import artefacts
from physhandi.fitting.checks.fit_warnings import with_warnings
from physhandi.fitting.config import load_profile
from physhandi.metrics.report import measure_run
from physhandi.perception.lifting import observe_object
from physhandi.progress import NullProgress, Progress
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import MINIMUM_LENGTH, build_model

STIFFEST = 1e5
"""Stiffness to which PhysTwin's simulator clamps [N]."""
_LIMITS = {
    "restitution": ("collide_elas", 1.0),
    "friction": ("collide_fric", 2.0),
    "self_restitution": ("collide_object_elas", 1.0),
    "self_friction": ("collide_object_fric", 2.0),
}
_STAGE = "import"
REPORT = "import.json"
"""Report on imported files, changed values, and the difference between the simulators."""
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
) -> RunFolder:
    """Make a finished run of PhysTwin's result for a case, simulated by our simulator.

    Args:
        sequence: The case, as `import_phystwin` made it.
        optimal_params: ``experiments_optimization/{case}/optimal_params.pkl``.
        checkpoint: ``experiments/{case}/train/best_{epoch}.pth``; without one, all springs have the
            stiffness of the search.
        out: Folder of the new run.
        device: Warp device.
        inference: ``experiments/{case}/inference.pkl``, to compare our rollout with.
        truncates_damping: Whether dashpot and drag lose their decimals. PhysTwin's search simulated
            them with decimals; its second stage and its inference load them as whole numbers. Left
            out, they are truncated exactly if there is a checkpoint.
        self_collision: Whether nodes collide; left out, if the case's name has "cloth" or
            "package" in it, which is how PhysTwin chooses.
        progress: Receives a report for every simulated frame; may cancel.

    Returns:
        The published run. ``import.json`` lists every number that is not used as stored, and the
        difference from `inference`.

    Raises:
        ImportFailedError: If a file is malformed, or does not belong to the sequence. Nothing is
            left behind then, as after any other error.
        RunError: If `out` exists already.
        SimulationDivergedError: If the simulation diverges.
        CancelledError: If the user asked to stop.
    """
    watched = progress or NullProgress()
    node, control, case = _parts(sequence)
    optimum = read_optimum(optimal_params)
    stored = None if checkpoint is None else read_phystwin_checkpoint(checkpoint)
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
    run = RunFolder.create(
        out,
        name=f"PhysTwin: {case}",
        kind="reconstruction",
        sequences=[str(sequence.folder)],
        config={
            "profile": profile.replace(simulation=parameters).to_dict(),
            "imported": report,
        },
    )
    try:
        with run.begin_attempt() as attempt:
            attempt_progress = attempt.progress(watched)
            _fill(attempt, sequence, model, parameters, device=device, progress=attempt_progress)
            _finish(attempt, sequence, report, expected)
            attempt.publish()
    except BaseException:
        run.delete()
        raise
    return RunFolder.open(run.folder)


def _parts(sequence: Sequence) -> tuple[ndarray, ndarray, str]:
    """Get the object nodes [m], the controls [m] and the case's name."""
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
    """Rotation by which the importer made the case's world z-up."""
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
    """Store the artefacts of a fit, and simulate all frames."""
    files = SequenceFiles(sequence.name)
    environment = describe_environment(device, describe_device(device))
    attempt.save_json(ENVIRONMENT, environment)
    artefacts.save_sequence_meta(attempt, sequence)
    artefacts.save_observation(attempt, sequence.name, observe_object(sequence, progress))
    attempt.save_array(files.object_node, model.object_node)
    attempt.save_array(files.control, np.asarray(sequence.control, np.float32))
    attempt.save_array(REST_NODE_FILE, model.object_node)
    artefacts.save_model(attempt, sequence.name, model)
    artefacts.save_object(attempt, parameters, model, model.object_node)
    frames = []
    control = np.asarray(sequence.control, np.float32)
    for frame, position, _ in Simulator(model, parameters, device=device).frames(control):
        progress.check_cancelled()
        frames.append(position)
        progress.report("rollout", frame + 1, len(control))
    attempt.save_array(files.rollout, np.stack(frames))


def _finish(
    attempt: Attempt,
    sequence: Sequence,
    report: Mapping[str, Any],
    expected: Float[ndarray, "frame node 3"] | None,
) -> None:
    """Compare with PhysTwin's rollout, measure the run, and finish the stage."""
    files = SequenceFiles(sequence.name)
    comparison: dict[str, Any] = {}
    if expected is not None:
        rollout = np.load(attempt.out / files.rollout, allow_pickle=False)
        comparison = compare_rollouts(rollout, expected)
    attempt.save_json(REPORT, {**report, "inference": comparison or None})
    metrics, errors = measure_run(attempt.out, sequence)
    metrics = with_warnings(attempt.out, sequence, metrics)
    attempt.save_json(METRICS_FILE, {sequence.name: metrics})
    attempt.save_json(files.frame_errors, errors)
    attempt.finish_stage(_STAGE, {"curve": [], **comparison})


def compare_rollouts(
    rollout: Float[ndarray, "frame node 3"], expected: Float[ndarray, "frame node 3"]
) -> dict[str, Any]:
    """Measure the difference between two rollouts of the same nodes.

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


def phystwin_parameters(
    base: SimulationParameters,
    optimum: Optimum,
    contact: Contact,
    *,
    truncates_damping: bool,
    self_collision: bool,
) -> tuple[SimulationParameters, list[str]]:
    """Convert PhysTwin's result to the parameters that its simulator effectively uses.

    Args:
        base: PhysTwin's fixed choices (profile ``phystwin``).
        optimum: Result of its search.
        contact: Collision coefficients of the search, or of the checkpoint.
        truncates_damping: Whether dashpot and drag lose their decimals, as PhysTwin's second stage
            and its inference do when they load the search's result.
        self_collision: Whether nodes collide.

    Returns:
        The parameters, and a sentence for each number that differs from the stored one.
    """
    notes: list[str] = []
    stiffness = min(optimum.stiffness, STIFFEST)
    if stiffness != optimum.stiffness:
        notes.append(_changed("global_spring_Y", optimum.stiffness, stiffness, "simulated"))
    bounced: dict[str, float] = {}
    for name, (field, most) in _LIMITS.items():
        value = getattr(contact, name)
        bounced[name] = min(max(value, 0.0), most)
        if bounced[name] != value:
            notes.append(_changed(field, value, bounced[name], "simulated"))
    damping, drag = optimum.damping, optimum.drag
    if truncates_damping:
        damping, drag = float(int(damping)), float(int(drag))
        for field, value, used in (
            ("dashpot_damping", optimum.damping, damping),
            ("drag_damping", optimum.drag, drag),
        ):
            if used != value:
                notes.append(_changed(field, value, used, "loaded (as a whole number)"))
    parameters = base.replace(
        connection_radius=optimum.object_radius,
        # PhysTwin counts the node itself.
        max_neighbors=optimum.object_max_neighbours - 1,
        virtual_connection_radius=optimum.controller_radius,
        virtual_max_neighbors=optimum.controller_max_neighbours,
        stiffness=stiffness,
        virtual_stiffness=stiffness,
        damping=damping,
        drag=drag,
        self_collision=self_collision,
        collision_distance=optimum.collision_distance,
        **bounced,
    )
    return parameters, notes


def phystwin_model(
    object_node: Float[ndarray, "node 3"],
    control_0: Float[ndarray, "control 3"],
    parameters: SimulationParameters,
    checkpoint: Checkpoint | None = None,
    *,
    source: Path | None = None,
) -> tuple[SpringMassModel, list[str]]:
    """Build PhysTwin's springs with the stiffnesses of a checkpoint.

    Args:
        object_node: Object nodes at frame 0, in PhysTwin's order [m].
        control_0: Controller points at frame 0 [m].
        parameters: What `phystwin_parameters` returned.
        checkpoint: Stiffnesses; without one, all springs get the global one.
        source: File of the checkpoint, for messages.

    Returns:
        The model at rest, and sentences about stiffnesses that differ from the stored ones.

    Raises:
        ImportFailedError: If the checkpoint has another number of springs than the topology.
    """
    model = build_model(object_node, control_0, parameters)
    if checkpoint is None:
        return model, []
    built = (model.object_spring_count, len(model.spring_nodes))
    stored = (checkpoint.object_spring_count, len(checkpoint.stiffness))
    if built != stored:
        raise ImportFailedError(
            f"{source}: has {stored[1]} springs, {stored[0]} of them between object nodes, but "
            f"final_data.pkl and optimal_params.pkl give {built[1]}, {built[0]} of them between "
            "object nodes. Give the files of one and the same experiment."
        )
    number, tie_count = spring_numbers(model, parameters, control_0)
    stiffness = checkpoint.stiffness[number]
    too_stiff = int((stiffness > STIFFEST).sum())
    notes = [f"{too_stiff} springs stiffer than {STIFFEST:g} N are simulated with that."]
    notes = notes if too_stiff else []
    if tie_count:
        notes.append(
            f"{tie_count} pairs of neighbors are at the same distance from a node. Which of them "
            "PhysTwin found first is not defined, so their stiffnesses may be exchanged."
        )
    # PhysTwin leaves a spring without stiffness out, its dashpot included.
    damping = np.where(stiffness > 0.0, model.damping, 0.0)
    fitted = replace(
        model,
        stiffness=np.minimum(stiffness, STIFFEST).astype(np.float32),
        damping=damping.astype(np.float32),
    )
    return fitted, notes


def spring_numbers(
    model: SpringMassModel,
    parameters: SimulationParameters,
    control_0: Float[ndarray, "control 3"],
) -> tuple[Int[ndarray, " spring"], int]:
    """Find the number of each of a model's springs in PhysTwin's list.

    PhysTwin walks over the nodes; each searches its neighbours by ascending distance, drops the
    first hit (itself) and adds every pair that is not there yet. Then the controllers add all their
    hits, one controller after the other.

    Args:
        model: A model that `build_model` made from `parameters`.
        parameters: Radii and neighbor limits.
        control_0: Controller points at frame 0 [m].

    Returns:
        A permutation of the springs' numbers, and how many pairs of neighbors have no defined order
        because they are at exactly the same distance.
    """
    node = model.object_node.astype(np.float64)
    tree, count = KDTree(node), len(node)
    distance, hit = _search(tree, node, parameters.max_neighbors + 1)
    hit, distance = hit[:, 1:], distance[:, 1:]
    own = np.broadcast_to(np.arange(count)[:, None], hit.shape)
    joined = (distance < parameters.connection_radius) & (distance > MINIMUM_LENGTH) & (hit != own)
    first, second = own[joined], hit[joined]  # row by row: in the order of the walk
    key = np.minimum(first, second) * count + np.maximum(first, second)
    # The model's springs ascend as the unique keys do.
    discovery = np.unique(key, return_index=True)[1]
    tie_count = _ties(distance, joined)
    control_point = np.asarray(control_0, np.float64)
    distance, hit = _search(tree, control_point, parameters.virtual_max_neighbors)
    is_joined = distance < parameters.virtual_connection_radius
    control = np.broadcast_to(np.arange(len(control_0))[:, None], hit.shape)
    order = np.argsort(hit[is_joined] * len(control_0) + control[is_joined])
    number = np.concatenate([np.argsort(np.argsort(discovery)), len(discovery) + order])
    return number, tie_count + _ties(distance, is_joined)


def _ties(distance: ndarray, is_kept: ndarray) -> int:
    """Count neighbors in a row that are at the same distance."""
    is_same = (distance[:, 1:] == distance[:, :-1]) & is_kept[:, 1:] & is_kept[:, :-1]
    return int(is_same.sum())


def _search(tree: KDTree, query: ndarray, most: int) -> tuple[ndarray, ndarray]:
    """Find the nearest nodes: distance [m] and index, ascending, a row for each query."""
    count = min(most, tree.n)
    distance, hit = tree.query(query, k=count)
    shape = (len(query), count)
    return np.reshape(distance, shape), np.reshape(hit, shape)


def _changed(field: str, stored: float, used: float, how: str) -> str:
    return f"{field} {stored:.6g} is {how} as {used:g}, as PhysTwin does."
