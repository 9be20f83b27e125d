"""What is on the screen now, for everything that saves it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from app.viewer.content import Content
from app.viewer.figure import Side
from app.viewer.layers import Layers
from app.viewer.take import Take
from physhandi.data.exporters.scene_data import HandSurface, SceneData, read_skins
from physhandi.data.run import Run
from physhandi.errors import MissingInputError


@dataclass(frozen=True, kw_only=True, eq=False)
class Snapshot:
    """What is on the screen now."""

    content: Content
    """What is shown."""
    frame: int
    """The frame."""
    take: Take | None
    """The object's rollout."""
    take_frame: int
    """Frame of the rollout."""
    sides: Mapping[str, Side] | None = None
    """Both halves of the figure, if the figure is shown."""
    picture: Callable[[viser.ClientHandle], dict[str, Any]] | None = None
    """Finds the camera of the figure's picture, if the figure is shown."""
    run: Run | None = None
    """The run, if it is one that is shown."""
    layers: Layers | None = None
    """Which layers are shown, if that is to be told."""
    link: str = ""
    """Address on this server that shows the same; empty if there is none."""


def scene_data(snapshot: Snapshot) -> SceneData:
    """Collect the motion that a snapshot belongs to: the rollout's frames that are ready.

    Args:
        snapshot: What is on the screen.

    Raises:
        MissingInputError: If it is a recording, in which nothing was reconstructed.
    """
    content, take, run = snapshot.content, snapshot.take, snapshot.run
    if take is None and not content.hands:
        raise MissingInputError("There is no rollout to save; this is a recording only.")
    count = content.frame_count if take is None else take.ready
    nothing = np.zeros((count, 0, 3), np.float32)
    control = content.control if take is None else take.control
    return SceneData(
        sequence=content.sequence_name,
        frame_rate=content.frame_rate,
        length_unit=content.length_unit,
        rollout=nothing if take is None else np.asarray(take.position[:count]),
        control=nothing if control is None else np.asarray(control[:count]),
        spring_nodes=np.zeros((0, 2), np.int32) if take is None else take.model.spring_nodes,
        object_spring_count=0 if take is None else take.model.object_spring_count,
        hands={
            hand.side: HandSurface(vertex=hand.vertex[:count], face=hand.face)
            for hand in content.hands
        },
        joints={hand.side: hand.joint[:count] for hand in content.hands if hand.joint is not None},
        run="" if run is None else run.id,
        model={} if take is None else take.model.to_tensors(),
        skins={} if run is None else read_skins(run, content.sequence_name),
    )
