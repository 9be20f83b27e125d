"""Simulate a fitted object again: with other parameters, or in another sequence."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from physhandi.data.attempt import Attempt
from physhandi.data.run import RunFolder
from physhandi.data.sequence import Sequence
from physhandi.errors import RunError
from physhandi.fitting import artefacts
from physhandi.fitting.config import PipelineConfig
from physhandi.fitting.hand_reconstruction import reconstruct_hands
from physhandi.fitting.object_problem import initial_velocity
from physhandi.fitting.object_reconstruction import check_springs
from physhandi.fitting.rollouts import control_trajectory_of, object_nodes_of, simulate_sequence
from physhandi.perception.lifting import observe_object
from physhandi.progress import Progress
from physhandi.simulation.parameters import changed_parameters
from physhandi.simulation.stability import with_stable_substeps
from physhandi.simulation.topology import retopologize


def simulate_again(
    source: RunFolder,
    sequence: Sequence,
    changes: Mapping[str, Any],
    output: Attempt,
    progress: Progress,
    *,
    device: str,
) -> None:
    """Roll a fitted object out in a sequence and store the motion.

    Springs that the new topology shares with the fitted one keep their fitted stiffness and damping
    relative to the global values.

    Args:
        source: A finished run with an object.
        sequence: One of the run's sequences, or another one of the same object.
        changes: New values of simulation parameters; `substeps_per_frame` may be ``auto``, and
            the number that was chosen is stored with the other parameters.
        output: Where the motion goes.
        progress: Told about every frame.
        device: Warp device.

    Raises:
        RunError: If the run is not finished, is damaged, or holds no fitted object.
        UsageError: If a parameter is unknown or out of bounds, or leaves no spring.
        SimulationDivergedError: If the motion runs away.
    """
    source.verify(allows_more=True)
    if not (source.out / "object/material.safetensors").is_file():
        raise RunError(
            f"Run '{source.id}' holds no fitted object, so there is nothing to simulate."
        )
    fitted = artefacts.load_parameters(source.out)
    parameters, is_automatic = changed_parameters(fitted, changes)
    first = source.sequence_names[0]
    is_known = sequence.name in source.sequence_names
    name = sequence.name if is_known else first
    model = artefacts.load_model(source.out, name)
    rest_node = artefacts.load_rest_node(source.out)
    artefacts.save_sequence_meta(output, sequence)
    if is_known:
        control = _copy_known(source, sequence.name, output)
        attachment = artefacts.load_attachment(source.out, sequence.name)
        artefacts.copy_hand_observation(source, sequence.name, output)
    else:
        control, node, velocity = _prepare(
            source, sequence, output, (model.object_node, rest_node), progress
        )
        attachment = control[0]
        model = replace(model, object_node=node, initial_velocity=velocity)
    model = retopologize(model, parameters, attachment, fitted=fitted, rest_node=rest_node)
    if is_automatic:
        in_world = parameters.in_world(
            frame_rate=sequence.frame_rate,
            ground_height=sequence.ground_height,
            gravity=sequence.gravity,
        )
        substeps = with_stable_substeps(in_world, model, control[0]).substeps_per_frame
        parameters = parameters.replace(substeps_per_frame=substeps)
    check_springs(sequence.name, model, parameters, attachment, rest_node)
    folder = artefacts.sequence_folder(sequence.name)
    output.save_array(f"{folder}/control.npy", control)
    if not np.array_equal(attachment, control[0]):
        output.save_array(f"{folder}/attachment.npy", attachment)
    artefacts.save_model(output, sequence.name, model)
    artefacts.save_object(output, parameters, model, rest_node)
    simulate_sequence(output, sequence, device=device, progress=progress)


def _copy_known(source: RunFolder, name: str, output: Attempt) -> np.ndarray:
    """Take over what the source run already found out about one of its sequences."""
    artefacts.save_observation(output, name, artefacts.load_observation(source.out, name))
    artefacts.save_motions(output, name, artefacts.load_motions(source.out, name))
    artefacts.copy_hand_vertices(source, name, output)
    return artefacts.load_control(source.out, name)


def _prepare(
    source: RunFolder,
    sequence: Sequence,
    output: Attempt,
    template: tuple[np.ndarray, np.ndarray],
    progress: Progress,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reconstruct the hands of another sequence and lay the known object into it."""
    while source.kind == "simulation":
        source = RunFolder.open(Path(source.config["source"]))
    config = PipelineConfig.from_dict(source.config["profile"])
    motions = ()
    if sequence.hands:
        fit = reconstruct_hands(sequence, config.hand, progress)
        motions = fit.motions
        artefacts.save_motions(output, sequence.name, motions)
        artefacts.save_hand_vertices(output, sequence.name)
        artefacts.save_hand_observation(output, sequence.name, fit.keypoint)
        artefacts.save_hand_points(output, sequence, progress)
    observation = observe_object(sequence, progress)
    artefacts.save_observation(output, sequence.name, observation)
    node, _ = object_nodes_of(sequence, observation, config.node_spacing, template)
    velocity = np.zeros_like(node)
    if not config.object_.starts_at_rest:
        velocity = initial_velocity(observation, node, sequence.frame_rate)
    return control_trajectory_of(sequence, motions, config), node, velocity
