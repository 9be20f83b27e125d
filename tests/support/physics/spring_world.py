"""Two springs whose every value is known: what colors and readings are tested with."""

import numpy as np

from app.viewer.content.content import Content
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters


def two_springs(frames: int = 4) -> ObjectRollout:
    """Node 1 runs away from node 0 at 3 m/s; a control stands above node 0."""
    model = SpringMassModel(
        object_node=np.array([[0, 0, 0], [1, 0, 0], [5, 5, 5]], np.float32),
        initial_velocity=np.zeros((3, 3), np.float32),
        spring_nodes=np.array([[0, 1], [3, 0]], np.int32),
        rest_length=np.array([1.0, 0.5], np.float32),
        stiffness=np.array([10.0, 40.0], np.float32),
        damping=np.array([2.0, 0.0], np.float32),
        object_spring_count=1,
        control_count=1,
    )
    position = np.repeat(model.object_node[None], frames, axis=0)
    position[:, 1, 0] += 0.1 * np.arange(frames)
    control = np.full((frames, 1, 3), [0.0, 0.0, 1.0], np.float32)
    parameters = SimulationParameters(stiffness_scale=2.0, frame_rate=30.0)
    return ObjectRollout(
        model=model, parameters=parameters, control=control, position=position, ready=frames
    )


def content_of(rollout: ObjectRollout, **fields) -> Content:
    return Content(
        title="t",
        sequence_name="s",
        frame_count=rollout.frame_count,
        frame_rate=30.0,
        reconstruction_count=rollout.frame_count,
        length_unit="m",
        ground_height=0.0,
        control=rollout.control,
        fitted=rollout,
        **fields,
    )
