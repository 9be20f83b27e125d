"""The losses of many candidates, added up where their states are."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float, Int
from numpy import ndarray

from physhandi.simulation.kernels.batch_losses import (
    NODES,
    POINTS,
    add_losses,
    sum_accelerations,
    sum_chamfer,
    sum_tracks,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionTarget:
    """What was observed of an object, and how much each observation counts.

    The loss of a frame is the weighted sum over points of the squared distance to the nearest
    surface node (Chamfer, one way), plus the weighted sum over tracks of the squared distance
    to where the nodes carried them, plus the weighted acceleration term (physics.md §4.1).
    The loss of a motion is the mean over the frames after frame 0.
    """

    cloud: Float[ndarray, "frame point 3"]
    """Observed points; what counts nothing must still be finite [m]."""
    cloud_weight: Float[ndarray, "frame point"]
    """How much each point counts; 0 for none."""
    surface_count: int | None
    """Points see only so many of the first nodes; all if None."""
    track: Float[ndarray, "frame track 3"]
    """Observed tracks; what counts nothing must still be finite [m]."""
    track_weight: Float[ndarray, "frame track"]
    """How much each track counts; 0 for none."""
    carrier: Int[ndarray, "track carrier"]
    """Nodes that carry each track."""
    carrier_weight: Float[ndarray, "track carrier"]
    """How much each of them counts; rows sum to one."""
    track_offset: Float[ndarray, "track 3"]
    """Position of a track less the weighted mean of its carriers [m]."""
    acceleration_weight: float = 0.0
    """Weight of PhysTwin's acceleration term."""

    @property
    def frame_count(self) -> int:
        """Number of frames, frame 0 included."""
        return len(self.cloud)


class LossSum:
    """Adds up the losses of candidates whose states lie side by side on a device."""

    def __init__(
        self,
        target: MotionTarget,
        node_number: Int[ndarray, " node"],
        *,
        lanes: int,
        width: int,
        device: Any,
    ) -> None:
        """Place the observations on the device.

        Args:
            target: What was observed.
            node_number: Place in the states of each of the model's nodes.
            lanes: Candidates in the states, those included that only fill a group.
            width: Candidates of a group; see `kernels.batch`.
            device: Warp device.
        """
        self._device, self._lanes = device, lanes
        self._share = 1.0 / max(target.frame_count - 1, 1)
        self._acceleration_weight = target.acceleration_weight
        nodes = len(node_number)
        self._layout = [width, nodes]
        surface = node_number[: target.surface_count]
        points = 0 if len(surface) == 0 else target.cloud.shape[1]
        chunks = -(-points // POINTS)
        more = ((0, 0), (0, chunks * POINTS - points))
        cloud = np.pad(target.cloud[:, :points], (*more, (0, 0)))
        weight = np.pad(target.cloud_weight[:, :points], more)
        self._cloud = [
            self._array(surface, wp.int32),
            self._array(cloud, wp.vec3),
            self._array(weight, wp.float32),
        ]
        self._track = [
            self._array(target.track, wp.vec3),
            self._array(target.track_weight, wp.float32),
            self._array(node_number[target.carrier], wp.int32),
            self._array(target.carrier_weight, wp.float32),
            self._array(target.track_offset, wp.vec3),
        ]
        tracks = target.track.shape[1]
        rest = -(-nodes // NODES) if self._acceleration_weight > 0.0 else 0
        self._parts = wp.zeros((chunks + tracks + rest, lanes), dtype=wp.float32, device=device)
        self._rows = np.cumsum([0, chunks, tracks, rest])
        size = lanes * nodes * 6 if rest else 0
        self._past = [wp.zeros(size, dtype=wp.float32, device=device) for _ in range(2)]
        self.loss = wp.zeros(lanes, dtype=wp.float32, device=device)
        """Loss of each candidate so far [m²]; infinite once it diverged."""

    def add(self, frame: int, state: wp.array, diverged_frame: wp.array) -> None:
        """Compare the states at the end of a frame with what was observed in it.

        Args:
            frame: Its number; frame 0 only tells the velocities that others differ from.
            state: Positions and velocities of all candidates.
            diverged_frame: Frame in which each candidate diverged; -1 where none was.
        """
        if frame > 0:
            self._launch(sum_chamfer, 0, [frame, *self._layout, *self._cloud, state])
            self._launch(sum_tracks, 1, [frame, *self._layout, *self._track, state])
            if frame > 1:
                inputs = [self._acceleration_weight, *self._layout, *self._past, state]
                self._launch(sum_accelerations, 2, inputs)
            wp.launch(
                add_losses,
                dim=self._lanes,
                inputs=[self._share, self._parts, diverged_frame],
                outputs=[self.loss],
                device=self._device,
            )
        if len(self._past[0]):
            self._past = self._past[::-1]
            wp.copy(self._past[1], state)

    def _launch(self, kernel: Any, term: int, inputs: list[Any]) -> None:
        begin, end = (int(row) for row in self._rows[term : term + 2])
        if begin < end:
            wp.launch(
                kernel,
                dim=(end - begin, self._lanes),
                inputs=inputs,
                outputs=[self._parts[begin:end]],
                device=self._device,
            )

    def _array(self, value: ndarray, dtype: Any) -> wp.array:
        flat = np.int32 if dtype is wp.int32 else np.float32
        return wp.array(np.ascontiguousarray(value, dtype=flat), dtype=dtype, device=self._device)
