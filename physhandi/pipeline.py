"""The paper on one page: hands, then the object that they move, then how well it went.

Each stage reads what earlier stages stored and stores what it found, and keeps its state while it
works, so that an interrupted run goes on where it was.
"""

import hashlib
import math
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Many
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.appearance.lpips import user_lpips
from physhandi.appearance.scoring import add_picture_scores, picture_curves
from physhandi.data.attempt import Attempt, ResultStore
from physhandi.data.checkpoint import Checkpointer
from physhandi.data.environment import ENVIRONMENT, describe_environment
from physhandi.data.files import json_line
from physhandi.data.layout import (
    MATERIAL_FILE,
    METRICS_FILE,
    PARAMETERS_FILE,
    REST_NODE_FILE,
    SEARCH_FILE,
    SHAPE_FILE,
    SPLATS_FILE,
    STEADINESS_FILE,
    SequenceFiles,
)
from physhandi.data.observation import ObjectObservation
from physhandi.data.run import RunFolder
from physhandi.data.run_folder import read_mapping
from physhandi.data.sequence import Sequence
from physhandi.devices import describe_device
from physhandi.errors import MissingInputError, RunError
from physhandi.fitted_object import ROLLOUT, FittedObject
from physhandi.fitting import artefacts
from physhandi.fitting.appearance_fit import fit_appearance as fit_appearance
from physhandi.fitting.checks.fit_warnings import with_warnings
from physhandi.fitting.checks.readiness import colored_views as colored_views
from physhandi.fitting.checks.readiness import (
    is_moved_by_hands,
    missing_for_hands,
    nothing_to_fit,
    readiness,
)
from physhandi.fitting.config import (
    APPEARANCE,
    EVALUATION,
    HANDS,
    OBSERVATION,
    REFINEMENT,
    SEARCH,
    SIMULATION,
    SPRINGS,
    ObjectFitConfig,
    PipelineConfig,
    apply_overrides,
    load_profile,
)
from physhandi.fitting.config import STAGES as STAGES
from physhandi.fitting.contact_detection import find_contacts
from physhandi.fitting.hand_reconstruction import reconstruct_hands
from physhandi.fitting.object_problem import ObjectProblem, build_problem
from physhandi.fitting.object_reconstruction import search_object
from physhandi.fitting.observed.state_estimate import observed_state
from physhandi.fitting.observed.track_registration import with_late_tracks
from physhandi.fitting.placement import (
    bends_as_rod,
    control_trajectory_of,
    hand_faces,
    object_nodes_of,
    refine_sequence,
    store_refined,
)
from physhandi.fitting.rest_state import resting_clearance
from physhandi.fitting.rope.fit import fit_rope, start_rope
from physhandi.fitting.spring_optimisation import NUDGE, STEADY, fit_steady_springs
from physhandi.fitting.steered_run import (
    contacts_from,
    contacts_in,
    record_take,
    store_hands,
    with_points,
)
from physhandi.fitting.stored_edits import EDITS_FILE, read_edits
from physhandi.fitting.stored_take import StoredTake
from physhandi.metrics.report import measure_run, score_run
from physhandi.object_rollout import ObjectRollout
from physhandi.perception.lifting import observe_object
from physhandi.progress import NullProgress, Progress
from physhandi.simulation.edits import Edits
from physhandi.simulation.parameters import changed_parameters
from physhandi.simulation.restart import start_to_tensors

Rule = Callable[
    [Float[ndarray, "node 3"], Float[ndarray, "frame control 3"]], Float[ndarray, "frame node 3"]
]
"""Moves the object's nodes of frame 0 with the control nodes of all frames [m]."""

Keeper = Callable[[], Checkpointer]
"""Gives what keeps the states of the stage that begins."""

Problems = Callable[[], list[ObjectProblem]]
"""Gives what the object is fitted to, one for each sequence."""


def settings_of(profile: str, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Give the settings of a profile with some of them changed, in plain data.

    Raises:
        UsageError: If there is no such profile, or a setting is unknown or out of bounds.
    """
    return apply_overrides(load_profile(profile), overrides).to_dict()


def run_reconstruction(
    sequences: Many[Sequence],
    config: PipelineConfig,
    attempt: Attempt,
    progress: Progress,
    *,
    device: str = "cpu",
    more_devices: Many[str] = (),
) -> dict[str, Any]:
    """Reconstruct hands and one object from one or several sequences (paper, sections 3.2-3.4).

    Args:
        sequences: Recordings of the same object; the first one defines its nodes.
        config: Settings of all stages.
        attempt: Where results go; finished stages in it are not computed again.
        progress: Told about every iteration.
        device: Warp device.
        more_devices: Further GPUs that share the candidates of the search with it.

    Returns:
        The measures of each sequence by its name, as ``metrics.json`` holds them.

    Raises:
        MissingInputError: If the sequences have neither hands nor an object to fit.
        FitError: If an optimisation has no usable result.
        CancelledError: If the user asked to stop.
        UsageError: If the weights for LPIPS that the user names cannot be used.
    """
    if config.appearance.enabled:
        user_lpips()  # Says what is wrong with the weights before the fit, not after it.
    config = config.replace(object_=config.object_.on(device))
    devices = (device, *more_devices)
    keeper = partial(attempt.checkpointer, _origin_of(sequences, config, devices))
    has_object = _prepare(sequences, config, attempt, progress, keeper)
    if has_object:
        # Built once, by the first stage that is not finished yet.
        problems = cache(lambda: _problems(sequences, config, attempt))
        is_rod = bends_as_rod(sequences, config)
        _stage_search(problems, config, attempt, progress, devices, is_rod=is_rod, keeper=keeper)
        _stage_springs(problems, config, attempt, progress, device, is_rod=is_rod, keeper=keeper)
        _stage_refinement(
            sequences, problems, config, attempt, progress, device=device, keeper=keeper
        )
    if config.appearance.enabled:
        _stage_appearance(sequences, config, attempt, progress, device=device, keeper=keeper)
    return _stage_evaluation(sequences, config, attempt, progress, device, has_object=has_object)


def _origin_of(
    sequences: Many[Sequence], config: PipelineConfig, devices: tuple[str, ...]
) -> dict[str, str]:
    """Name what a fit depends on: a checkpoint of another one says nothing about this one."""
    made_with = describe_environment(devices[0], describe_device(devices[0]))
    program = {key: made_with[key] for key in ("commit", "packages", "python", "system")}
    recordings = [sequence.content_fingerprint() for sequence in sequences]
    parts = {
        "program": program,
        "settings": config.to_dict(),
        "recordings": recordings,
        "device": [*devices, made_with["device_name"]],
    }
    return {
        name: hashlib.sha256(json_line(part).encode()).hexdigest() for name, part in parts.items()
    }


def predict(
    sequence: Sequence, config: PipelineConfig, rule: Rule, attempt: Attempt, progress: Progress
) -> None:
    """Reconstruct the hands alone, move the object by a rule, and measure: what fits must beat.

    Args:
        sequence: The recording.
        config: Settings of the hands and of the nodes.
        rule: Moves the nodes.
        attempt: Where results go; finished stages in it are not computed again.
        progress: Told about every iteration.

    Raises:
        MissingInputError: If the sequence has no object, or nothing that moves it.
        CancelledError: If the user asked to stop.
    """
    keeper = partial(attempt.checkpointer, _origin_of([sequence], config, ("cpu",)))
    if not _prepare([sequence], config, attempt, progress, keeper):
        raise MissingInputError(nothing_to_fit([sequence]))
    if attempt.stage_done(EVALUATION):
        return
    artefacts.save_hand_vertices(attempt, sequence.name)
    files = SequenceFiles(sequence.name)
    node = artefacts.load_array(attempt.out / files.object_node)
    rollout = rule(node, artefacts.load_control(attempt.out, sequence.name))
    attempt.save_array(files.rollout, np.asarray(rollout, np.float32))
    attempt.save_json(METRICS_FILE, {sequence.name: _measure(sequence, attempt, progress)})
    _finish(attempt, EVALUATION, [], [], [])


def run_simulation(
    source: RunFolder,
    sequences: Many[Sequence],
    changes: Mapping[str, Any],
    attempt: Attempt,
    progress: Progress,
    *,
    device: str = "cpu",
    stored: StoredTake | None = None,
    edits: Edits | None = None,
) -> dict[str, Any]:
    """Simulate a fitted object with changed parameters, or in other recordings, and measure it.

    A recording is one of the run's if its content is the same, whatever it is called; in others the
    hands are reconstructed and the object is laid into frame 0. All are simulated with as many
    substeps as the one that needs most.

    Args:
        source: Finished run that the object was fitted in.
        sequences: Where to simulate it.
        changes: New values of simulation parameters; ``substeps_per_frame`` may be ``auto``.
        attempt: Where results go; what is chosen is stored with the other parameters.
        progress: Told about every frame.
        device: Warp device.
        stored: A take that the one recording was made of, which says everything else.
        edits: What is done to single springs and nodes, in the place of the run's own edits; None
            for these.

    Returns:
        The measures of each sequence by its name, as ``metrics.json`` holds them.

    Raises:
        RunError: If the run is not finished or damaged.
        MissingInputError: If it holds no fitted object, or a recording lacks what moves it.
        UsageError: If a parameter is unknown or out of bounds, or leaves no spring, or an edit
            cannot be made.
        SimulationDivergedError: If the motion runs away.
    """
    if not attempt.stage_done(SIMULATION):
        if stored is None:
            _stage_simulation(source, sequences, (changes, edits), attempt, progress, device=device)
        else:
            _stage_take(source, sequences[0], stored, attempt, progress)
    metrics = {
        sequence.name: _measure(sequence, attempt, progress, device=device)
        for sequence in sequences
    }
    attempt.save_json(METRICS_FILE, metrics)
    return metrics


def _stage_simulation(
    source: RunFolder,
    sequences: Many[Sequence],
    wanted: tuple[Mapping[str, Any], Edits | None],
    attempt: Attempt,
    progress: Progress,
    *,
    device: str,
) -> None:
    changes, edits = wanted
    source.verify(allows_more=True)
    if not source.has(MATERIAL_FILE):
        raise RunError(
            f"Run '{source.id}' holds no fitted object, so there is nothing to simulate."
        )
    fitted = artefacts.load_parameters(source.out)
    parameters, _ = changed_parameters(fitted, changes)
    objects = [_object_in(source, sequence, attempt, progress) for sequence in sequences]
    rollouts = [object_.changed(changes, edits) for object_ in objects]
    substeps = max(rollout.parameters.substeps_per_frame for rollout in rollouts)
    parameters = parameters.replace(substeps_per_frame=substeps)
    if substeps != fitted.substeps_per_frame:
        count = len(rollouts[0].control)
        progress.report(SIMULATION, 0, count, message=f"{substeps} substeps a frame")
    rest_node = artefacts.load_rest_node(source.out)
    artefacts.save_object(attempt, parameters, rollouts[0].model, rest_node)
    _copy_look(source, attempt)
    for object_, rollout in zip(objects, rollouts, strict=True):
        rollout.parameters = rollout.parameters.replace(substeps_per_frame=substeps)
        artefacts.save_model(attempt, object_.sequence, rollout.model)
        files = SequenceFiles(object_.sequence)
        attempt.save_array(files.control, np.asarray(rollout.control))
        if rollout.restart is not None:
            attempt.save_tensors(files.restart, rollout.restart.to_tensors())
        if rollout.unedited is not None:
            artefacts.save_edits(attempt, object_.sequence, rollout.edits, rollout.unedited)
        _store_rollout(attempt, object_, rollout, device, progress)
    _finish(attempt, SIMULATION, [], [], [])


def _stage_take(
    source: RunFolder,
    sequence: Sequence,
    stored: StoredTake,
    attempt: Attempt,
    progress: Progress,
) -> None:
    """Store what somebody has steered, and its recording shows, as any other simulation."""
    name, take, files = sequence.name, stored.take, SequenceFiles(sequence.name)
    marker = sequence.marker
    if marker is None or marker.shape[:2] != (take.frame_count, take.model.node_count):
        raise MissingInputError(
            f"Sequence '{name}' does not have a marker at every node of what was steered; remove "
            "it, and it is made anew."
        )
    fitted = FittedObject.of(source, stored.sequence)
    rest_node = artefacts.load_rest_node(source.out)
    continued = contacts_from(fitted.contacts, stored.frame)
    contacts = contacts_in(take.model) if take.is_regripped else continued
    attachment = with_points(artefacts.load_attachment(source.out, stored.sequence), take.model)
    artefacts.save_sequence_meta(attempt, sequence)
    artefacts.save_observation(attempt, name, observe_object(sequence, progress))
    artefacts.save_object(attempt, take.parameters, take.model, rest_node)
    artefacts.save_model(attempt, name, take.model)
    store_hands(source, stored, name, attempt)
    _copy_look(source, attempt)
    if contacts is not None:
        attempt.save_tensors(files.contacts, contacts.to_tensors())
    attempt.save_array(files.attachment, attachment)
    attempt.save_array(files.control, take.controls())
    attempt.save_tensors(files.start, start_to_tensors(take.start))
    # Its markers are the object's nodes, simulated when it was made.
    attempt.save_array(files.rollout, marker)
    _finish(attempt, SIMULATION, [], [], [])


def _copy_look(source: RunFolder, attempt: Attempt) -> None:
    """Copy what is known of the object besides its springs: its kind, and its splats."""
    if source.has(SHAPE_FILE):
        attempt.save_yaml(SHAPE_FILE, source.yaml(SHAPE_FILE))
    if source.has(SPLATS_FILE):
        attempt.save_tensors(SPLATS_FILE, source.tensors(SPLATS_FILE))


def _object_in(
    source: RunFolder, sequence: Sequence, attempt: Attempt, progress: Progress
) -> FittedObject:
    """Lay a stored object into a recording, and store what the recording shows."""
    name = sequence.name
    artefacts.save_sequence_meta(attempt, sequence)
    files = SequenceFiles(name)
    if source.holds(sequence):
        artefacts.save_observation(attempt, name, artefacts.load_observation(source.out, name))
        artefacts.save_motions(attempt, name, artefacts.load_motions(source.out, name))
        artefacts.copy_hand_vertices(source, name, attempt)
        artefacts.copy_hand_observation(source, name, attempt)
        object_ = FittedObject.of(source, name)
        if source.has(files.attachment):
            attempt.save_array(files.attachment, artefacts.load_attachment(source.out, name))
        if object_.contacts is not None:
            attempt.save_tensors(files.contacts, object_.contacts.to_tensors())
        if object_.fitted.start is not None:
            attempt.save_tensors(files.start, start_to_tensors(object_.fitted.start))
    else:
        object_ = FittedObject.of(source).placed_in(sequence, progress)
        placed = object_.placement
        if placed is None:
            raise RunError(f"Run '{source.id}' holds '{name}', but did so differently just now.")
        artefacts.save_observation(attempt, name, placed.observation)
        if placed.hands is not None:
            artefacts.save_motions(attempt, name, placed.hands.motions)
            artefacts.save_hand_vertices(attempt, name)
            artefacts.save_hand_observation(attempt, name, placed.hands.keypoint)
            artefacts.save_hand_points(attempt, sequence, progress)
    return object_


def _store_restart(
    attempt: Attempt, sequence: Sequence, device: str, config: PipelineConfig
) -> None:
    """Estimate the object's state in the last fitted frame, from which prediction starts."""
    fitted = _stored_object(attempt, sequence)
    try:
        restart = observed_state(
            fitted.model,
            fitted.parameters,
            fitted.fitted.control,
            _followed(attempt, sequence, fitted.model.object_node, config.object_),
            sequence.reconstruction_frames[-1],
            device=device,
            strain_time=config.prediction.strain_time,
            grip_strength=config.prediction.grip_strength,
            keeps_sliding=config.prediction.keeps_sliding,
        )
    except MissingInputError as error:
        raise MissingInputError(f"Sequence '{sequence.name}': {error}") from error
    attempt.save_tensors(SequenceFiles(sequence.name).restart, restart.to_tensors())


def predict_again(
    attempt: Attempt, sequence: Sequence, progress: Progress, *, device: str = "cpu"
) -> None:
    """Give a run that does not restart a restart, simulate it anew and measure it.

    Args:
        attempt: Holds what the run has stored.
        sequence: Recording that the run was fitted to.
        progress: Told about every frame.
        device: Warp device.

    Raises:
        MissingInputError: If no track is seen in the last frame that was fitted.
        RunError: If the run holds no fitted object.
        SimulationDivergedError: If the motion runs away.
    """
    _store_restart(attempt, sequence, device, PipelineConfig())
    fitted = _stored_object(attempt, sequence)
    _store_rollout(attempt, fitted, fitted.begin(fitted.parameters), device, progress)
    measured = _measure(sequence, attempt, progress, device=device)
    attempt.save_json(METRICS_FILE, {sequence.name: measured})


def _stored_object(attempt: Attempt, sequence: Sequence) -> FittedObject:
    """Read the object that earlier stages stored, in the world of a sequence."""
    parameters = artefacts.load_parameters(attempt.out).in_world(
        frame_rate=sequence.frame_rate,
        ground_height=sequence.ground_height,
        gravity=sequence.gravity,
    )
    model = artefacts.load_model(attempt.out, sequence.name)
    control = artefacts.load_control(attempt.out, sequence.name)
    restart = artefacts.load_restart(attempt.out, sequence.name)
    empty = ObjectRollout.empty(model, parameters, control, restart)
    return FittedObject(empty, sequence=sequence.name)


def _store_rollout(
    attempt: Attempt,
    object_: FittedObject,
    rollout: ObjectRollout,
    device: str,
    progress: Progress,
) -> None:
    for frame, _, _ in object_.fill(rollout, device):
        progress.check_cancelled()
        progress.report(ROLLOUT, frame + 1, rollout.frame_count)
    attempt.save_array(SequenceFiles(object_.sequence).rollout, np.asarray(rollout.position))


def evaluate(
    run: RunFolder,
    sequences: Many[Sequence],
    progress: Progress | None = None,
    *,
    draws: bool = True,
    device: str = "cpu",
) -> dict[str, Any]:
    """Measure a finished run against its sequences again.

    Args:
        run: The run.
        sequences: Its recordings.
        progress: Told about every frame that is drawn.
        draws: Whether pictures are compared too, if the run holds splats.
        device: Warp device that draws.

    Raises:
        UsageError: If the weights for LPIPS that the user names cannot be used.
    """
    scores = {}
    for sequence in sequences:
        points = None
        if not run.has(SequenceFiles(sequence.name).observation("hand_point")):
            points = artefacts.lifted_hand_points(sequence)
        measured = score_run(run.out, sequence, hand_points=points)
        if draws:
            _compare_pictures(measured, run.out, sequence, progress or NullProgress(), device)
        scores[sequence.name] = with_warnings(run.out, sequence, measured)
    return scores


def _prepare(
    sequences: Many[Sequence],
    config: PipelineConfig,
    attempt: Attempt,
    progress: Progress,
    keeper: Keeper,
) -> bool:
    """Reconstruct hands and collect what was seen; tell whether there is an object to fit."""
    stages = readiness(sequences, config)
    if not stages[EVALUATION].is_ready:
        raise MissingInputError(nothing_to_fit(sequences))
    for sequence in sequences:
        moves_by_points = sequence.control is not None or config.control_nodes != "all"
        if config.simulation.hand_pushes and moves_by_points:
            raise MissingInputError(
                f"Sequence '{sequence.name}' has no hand whose surface could push: single points "
                "move its object (control.npy, or control_nodes). Switch simulation.hand_pushes "
                "off."
            )
    for sequence in sequences:
        artefacts.save_sequence_meta(attempt, sequence)
    _stage_hands(sequences, config, attempt, progress, keeper)
    if stages[OBSERVATION].is_ready:
        _stage_observation(sequences, config, attempt, progress)
    return stages[OBSERVATION].is_ready


def _stage_hands(
    sequences: Many[Sequence],
    config: PipelineConfig,
    attempt: Attempt,
    progress: Progress,
    keeper: Keeper,
) -> None:
    """Stage 1: a hand mesh for every frame, from keypoints and depth of all views."""
    if attempt.stage_done(HANDS):
        return
    before, after, curve = [], [], []
    left_out: list[str] = []
    checkpointer = keeper()
    for sequence in sequences:
        if missing_for_hands(sequence):
            continue
        fit = reconstruct_hands(sequence, config.hand, progress, checkpointer=checkpointer)
        artefacts.save_motions(attempt, sequence.name, fit.motions)
        artefacts.save_hand_observation(attempt, sequence.name, fit.keypoint)
        artefacts.save_hand_points(attempt, sequence, progress)
        before.append(fit.loss_before)
        after.append(fit.loss_after)
        left_out += [f"Left out. {reason}" for reason in fit.left_out.values()]
        curve = curve or [[float(iteration), loss] for iteration, loss in fit.curve]
    _finish(attempt, HANDS, before, after, curve, note=" ".join(left_out))


def _stage_observation(
    sequences: Many[Sequence], config: PipelineConfig, attempt: Attempt, progress: Progress
) -> None:
    """From pixels or markers to points of the object, and nodes to simulate."""
    if attempt.stage_done(OBSERVATION):
        return
    template = None
    note = ""
    for number, sequence in enumerate(sequences):
        observation = observe_object(sequence, progress)
        node, rest_node, shape = object_nodes_of(sequence, observation, config, template)
        template = (node, rest_node) if template is None else template
        motions = artefacts.load_motions(attempt.out, sequence.name)
        is_rod = bends_as_rod(sequences, config)
        control = control_trajectory_of(sequence, motions, config, is_rod=is_rod)
        files = SequenceFiles(sequence.name)
        artefacts.save_observation(attempt, sequence.name, observation)
        attempt.save_array(files.object_node, node.astype(np.float32))
        attempt.save_array(files.control, control.astype(np.float32))
        if number == 0:
            attempt.save_array(REST_NODE_FILE, rest_node.astype(np.float32))
        if shape is not None:
            attempt.save_yaml(SHAPE_FILE, shape.to_dict())
            note = str(shape)
        progress.report(OBSERVATION, number + 1, len(sequences), message=note)
    _finish(attempt, OBSERVATION, [], [], [], note=note)


def _problems(
    sequences: Many[Sequence], config: PipelineConfig, attempt: Attempt
) -> list[ObjectProblem]:
    rest_node = artefacts.load_array(attempt.out / REST_NODE_FILE)
    follows_contact = config.object_.contact_over_time and not bends_as_rod(sequences, config)
    kind, thickness = None, 0.0
    if config.object_.rests_where_seen or follows_contact:
        kind, thickness = artefacts.load_shape(attempt.out)
    clearance = None
    problems = []
    for sequence in sequences:
        files = SequenceFiles(sequence.name)
        object_node = artefacts.load_array(attempt.out / files.object_node)
        if clearance is None and kind is not None and config.object_.rests_where_seen:
            # It is the object's, which the first sequence defines.
            clearance = resting_clearance(
                object_node, sequence.ground_height, kind, thickness=thickness
            )
        observation = _followed(attempt, sequence, object_node, config.object_)
        control = artefacts.load_control(attempt.out, sequence.name)
        motions = artefacts.load_motions(attempt.out, sequence.name)
        hand_face = hand_faces(motions, control.shape[1])
        contacts = None
        if follows_contact:
            ground = None
            if sequence.ground_height is not None:
                lift = np.zeros(len(object_node)) if clearance is None else clearance
                ground = sequence.ground_height + lift
            contacts = find_contacts(
                observation,
                object_node,
                control,
                frame_count=len(sequence.reconstruction_frames),
                frame_rate=sequence.frame_rate,
                kind=kind,
                most_grips=config.object_.most_grips,
                ground=ground,
                gravity=sequence.gravity,
            )
        problems.append(
            build_problem(
                name=sequence.name,
                observation=observation,
                object_node=object_node,
                rest_node=rest_node,
                control=control,
                hand_face=hand_face,
                contacts=contacts,
                frame_count=len(sequence.reconstruction_frames),
                frame_rate=sequence.frame_rate,
                ground_height=sequence.ground_height,
                gravity=sequence.gravity,
                clearance=clearance,
                surface_count=sequence.surface_node_count,
                chamfer_points=config.object_.chamfer_points,
                cloud_points=config.object_.cloud_points,
                starts_at_rest=config.object_.starts_at_rest,
            )
        )
    return problems


def _followed(
    attempt: Attempt, sequence: Sequence, node: Float[ndarray, "node 3"], config: ObjectFitConfig
) -> ObjectObservation:
    """Read what was seen of the object, with its late tracks where a fit takes them."""
    observation = artefacts.load_observation(attempt.out, sequence.name)
    if not config.follows_late_tracks:
        return observation
    return with_late_tracks(observation, node, len(sequence.reconstruction_frames))


def _stage_search(
    problems: Problems,
    config: PipelineConfig,
    attempt: Attempt,
    progress: Progress,
    devices: tuple[str, ...],
    *,
    is_rod: bool,
    keeper: Keeper,
) -> None:
    """Stage 2, zeroth-order: topology and the other global parameters."""
    if attempt.stage_done(SEARCH):
        return
    settings = config.simulation, config.object_
    if is_rod:
        result = start_rope(problems(), *settings, progress)
    else:
        result = search_object(
            problems(),
            *settings,
            progress,
            device=devices[0],
            more_devices=devices[1:],
            checkpointer=keeper(),
        )
    attempt.save_yaml(PARAMETERS_FILE, result.parameters.to_dict())
    searched = {name: variable.to_dict() for name, variable in result.intervals.items()}
    about_search = {
        "intervals": searched,
        "widened": list(result.widened),
        "runners_up": [parameters.to_dict() for parameters in result.runners_up],
    }
    attempt.save_yaml(SEARCH_FILE, about_search)
    losses = [result.loss_before], [result.loss_after]
    _finish(attempt, SEARCH, *losses, result.curve, note=result.note)


def _stage_springs(
    problems: Problems,
    config: PipelineConfig,
    attempt: Attempt,
    progress: Progress,
    device: str,
    *,
    is_rod: bool,
    keeper: Keeper,
) -> None:
    """Stage 2, first-order: a stiffness and a damping for each spring; or how a rope bends."""
    if attempt.stage_done(SPRINGS):
        return
    parameters = artefacts.load_parameters(attempt.out)
    if is_rod:
        result = fit_rope(problems(), parameters, config.object_, progress, checkpointer=keeper())
    else:
        result = fit_steady_springs(
            problems(),
            [parameters, *artefacts.load_runners_up(attempt.out)],
            config.object_,
            progress,
            device=device,
            checkpointer=keeper(),
        )
        sway = result.sway if math.isfinite(result.sway) else None
        attempt.save_yaml(STEADINESS_FILE, {"nudge": NUDGE, "limit": STEADY, "sway": sway})
    for problem in problems():
        artefacts.save_model(attempt, problem.name, result.models[problem.name])
        if problem.contacts is not None:
            files = SequenceFiles(problem.name)
            attempt.save_tensors(files.contacts, problem.contacts.to_tensors())
    first = problems()[0]
    artefacts.save_object(attempt, result.parameters, result.models[first.name], first.rest_node)
    losses = [result.loss_before], [result.loss_after]
    _finish(attempt, SPRINGS, *losses, result.curve, note=result.note)


def _stage_refinement(
    sequences: Many[Sequence],
    problems: Problems,
    config: PipelineConfig,
    attempt: Attempt,
    progress: Progress,
    *,
    device: str,
    keeper: Keeper,
) -> None:
    """Stage 3: hands whose object moves as it was seen to; point controllers are as they are."""
    if attempt.stage_done(REFINEMENT):
        return
    held = [sequence for sequence in sequences if is_moved_by_hands(sequence)]
    before, after, curve = [], [], []
    if readiness(sequences, config)[REFINEMENT].is_ready:
        by_name = {problem.name: problem for problem in problems()}
        shown = [by_name[sequence.name] for sequence in held]
        checkpointer = keeper()
        results = [
            refine_sequence(
                attempt,
                sequence,
                problem,
                config,
                progress,
                device=device,
                checkpointer=checkpointer,
            )
            for sequence, problem in zip(held, shown, strict=True)
        ]
        # Earlier stages' files are replaced, so an interruption before this must leave them all.
        for sequence, problem, result in zip(held, shown, results, strict=True):
            store_refined(attempt, sequence, problem, result)
        before = [result.loss_before for result in results]
        after = [result.loss_after for result in results]
        curve = results[0].curve
    _finish(attempt, REFINEMENT, before, after, curve)


def _stage_appearance(
    sequences: Many[Sequence],
    config: PipelineConfig,
    attempt: Attempt,
    progress: Progress,
    *,
    device: str,
    keeper: Keeper,
) -> None:
    """What the object looks like: splats, fitted to frame 0 of the first sequence."""
    if attempt.stage_done(APPEARANCE):
        return
    stage = readiness(sequences, config)[APPEARANCE]
    if not stage.is_ready:
        _finish(attempt, APPEARANCE, [], [], [], note=f"Left out: {stage.why}.")
        return
    fitted = fit_appearance(
        attempt.out,
        sequences[0],
        config.appearance,
        progress,
        device=device,
        checkpointer=keeper(),
    )
    attempt.save_tensors(SPLATS_FILE, fitted.splats.to_tensors())
    curve = [[float(iteration), float(loss)] for iteration, loss in enumerate(fitted.curve)]
    # Each update looks at one view, so losses are means over all of them.
    count = len(colored_views(sequences[0]))
    before, after = fitted.curve[:count].mean(), fitted.curve[-count:].mean()
    _finish(attempt, APPEARANCE, [float(before)], [float(after)], curve)


def _stage_evaluation(
    sequences: Many[Sequence],
    config: PipelineConfig,
    attempt: Attempt,
    progress: Progress,
    device: str,
    *,
    has_object: bool,
) -> dict[str, Any]:
    """Roll out all frames, the held-out ones included, and measure."""
    if attempt.stage_done(EVALUATION):
        return read_mapping(attempt.out / METRICS_FILE)
    metrics = {}
    for number, sequence in enumerate(sequences):
        artefacts.save_hand_vertices(attempt, sequence.name)
        if has_object:
            if config.prediction.restarts and sequence.future_frames:
                try:
                    _store_restart(attempt, sequence, device, config)
                except MissingInputError as error:
                    message = f"Predicted without a restart. {error}"
                    progress.report(EVALUATION, number, len(sequences), message=message)
            fitted = _stored_object(attempt, sequence)
            _store_rollout(attempt, fitted, fitted.begin(fitted.parameters), device, progress)
        metrics[sequence.name] = _measure(sequence, attempt, progress, device=device)
        progress.report(EVALUATION, number + 1, len(sequences))
    attempt.save_json(METRICS_FILE, metrics)
    _finish(attempt, EVALUATION, [], [], [])
    return metrics


def _measure(
    sequence: Sequence, attempt: Attempt, progress: Progress, *, device: str = "cpu"
) -> dict[str, Any]:
    """Score one sequence, and store the error of every frame for charts."""
    scores, frames = measure_run(attempt.out, sequence)
    _compare_pictures(scores, attempt.out, sequence, progress, device)
    attempt.save_json(SequenceFiles(sequence.name).frame_errors, frames)
    return with_warnings(attempt.out, sequence, scores)


def _compare_pictures(
    scores: dict[str, Any], out: Path, sequence: Sequence, progress: Progress, device: str
) -> None:
    """Add what pictures of the rollout score, if it is known what the object looks like."""
    splats = artefacts.load_splats(out)
    if splats is None:
        return
    rollout = artefacts.load_array(out / SequenceFiles(sequence.name).rollout)
    curves = picture_curves(
        sequence,
        rollout,
        splats,
        progress,
        stage=EVALUATION,
        device=device,
        perceptual=user_lpips(device),
    )
    splits = {
        "reconstruction": sequence.reconstruction_frames,
        "future": sequence.future_frames,
    }
    add_picture_scores(scores, curves, splits)


def _finish(
    attempt: Attempt,
    stage: str,
    before: list[float],
    after: list[float],
    curve: list[list[float]],
    *,
    note: str = "",
) -> None:
    summary: dict[str, Any] = {"curve": curve} | ({"note": note} if note else {})
    if before:
        summary |= {"before": float(np.mean(before)), "after": float(np.mean(after))}
    attempt.finish_stage(stage, summary)


def run_job(
    run: RunFolder,
    progress: Progress | None = None,
    *,
    device: str = "cpu",
    more_devices: Many[str] = (),
    store: ResultStore | None = None,
) -> None:
    """Execute what a run folder asks for, and publish the result.

    Args:
        run: The run; its configuration says what to do.
        progress: Also told what the run's own event log is told.
        device: Warp device.
        more_devices: Further GPUs that share the search of a reconstruction with it.
        store: Where the result is published, too.

    Raises:
        PhysHandiError: If the work failed; the run folder then says why.
    """
    with run.begin_attempt() as attempt:
        watched = attempt.progress(progress)
        environment = describe_environment(device, describe_device(device))
        attempt.save_json(ENVIRONMENT, environment)
        stored = StoredTake.load(run)
        if stored is not None:
            source = RunFolder.open(Path(run.asked("source", str)))
            record_take(source, stored, Path(run.sequences[0]), watched, device=device)
        sequences = [Sequence.load(Path(path)) for path in run.sequences]
        for sequence in sequences:
            sequence.validate(reads_color=False)
        if run.kind == "simulation":
            source = RunFolder.open(Path(run.asked("source", str)))
            changes = run.asked("parameters", dict[str, Any])
            edits = read_edits(run.folder / EDITS_FILE) if "edits" in run.config else None
            run_simulation(
                source,
                sequences,
                changes,
                attempt,
                watched,
                device=device,
                stored=stored,
                edits=edits,
            )
        else:
            config = PipelineConfig.from_dict(run.asked("profile", dict[str, Any]))
            run_reconstruction(
                sequences, config, attempt, watched, device=device, more_devices=more_devices
            )
        attempt.publish(store)
