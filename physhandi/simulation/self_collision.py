"""Self-collision: finds candidate pairs of object nodes in a frame and launches the collisions."""

from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float32
from numpy import ndarray

from physhandi.errors import SimulationError
from physhandi.simulation.kernels.self_collision.candidates import count_candidates, list_candidates
from physhandi.simulation.kernels.self_collision.collide import collide_nodes, free_nodes

FIRST_CAPACITY = 32
"""Initial capacity: candidates of a node on average."""
MOST_CANDIDATES = 2**25
"""Most candidates of all nodes together (128 MiB)."""
_GRID = 64
_CELL_MARGIN = 1.02


class SelfCollision:
    """Finds the candidates of each frame on the device and launches the collisions.

    A pair is a candidate during a frame if it is nearer than the collision distance at its
    start. Nodes that are nearer than that at rest would block each other for good, so they are
    left out unless `collides_rest_neighbors` is set; at rest means in the model's
    `object_node`, its shape at frame 0, wherever a rollout starts.
    """

    def __init__(
        self, rest: Float32[ndarray, "node 3"], clearance: wp.array, world: wp.array
    ) -> None:
        """Make room for a model's nodes.

        Args:
            rest: Object nodes at rest [m].
            clearance: Height above the ground at which each node touches it [m].
            world: The simulator's `World`, whose device is used.
        """
        self._world = world
        self._clearance = clearance
        self._device = world.device
        self._count = len(rest)
        self._rest = self._array(rest, wp.vec3)
        self._grid = wp.HashGrid(_GRID, _GRID, _GRID, device=self._device)
        self._counts = self._zeros(self._count + 1, wp.int32)
        self.start = self._zeros(self._count + 1, wp.int32)
        """Start of each node's candidates, and the end of the last."""
        self.candidate = self._zeros(FIRST_CAPACITY * self._count, wp.int32)
        """Candidates of all nodes; those of a node are in ascending order."""
        self.position = self._zeros(self._count, wp.vec3)
        """Positions of every other substep [m]."""
        self._free_velocity = self._zeros(self._count, wp.vec3)
        self._version = 1

    def find(self, position: wp.array, distance: float) -> int:
        """Find the candidates of the frame that starts at `position`; waits for the device.

        Args:
            position: Object nodes [m].
            distance: `collision_distance` of the world [m].

        Returns:
            A number that changes when `candidate` has moved, because it had to grow.

        Raises:
            SimulationError: If there are more than `MOST_CANDIDATES`.
        """
        self._grid.build(position, max(_CELL_MARGIN * distance, 1e-6))
        inputs = [self._grid.id, self._world, self._rest, position]
        wp.launch(
            count_candidates,
            dim=self._count,
            inputs=inputs,
            outputs=[self._counts],
            device=self._device,
        )
        counts = self._counts.numpy()
        total = int(counts.sum(dtype=np.int64))
        if total > MOST_CANDIDATES:
            node = int(counts.argmax())
            raise SimulationError(
                f"Node {node} has {counts[node]} other nodes within collision_distance "
                f"({distance:g} m), all nodes together {total}; at most {MOST_CANDIDATES} are "
                "held. Lower collision_distance, or use fewer nodes."
            )
        if total > len(self.candidate):
            self.candidate = self._zeros(min(2 * total, MOST_CANDIDATES), wp.int32)
            self._version += 1
        wp.utils.array_scan(self._counts, self.start, inclusive=False)
        wp.launch(
            list_candidates,
            dim=self._count,
            inputs=[*inputs, self.start],
            outputs=[self.candidate],
            device=self._device,
        )
        return self._version

    def launch_free(
        self,
        start: wp.array,
        entry: wp.array,
        velocity: wp.array,
        pull: wp.array,
        free_velocity: wp.array | None,
    ) -> None:
        """Launch springs, gravity and drag; see `free_nodes`."""
        wp.launch(
            free_nodes,
            dim=self._count,
            inputs=[self._world, start, entry, velocity, pull],
            outputs=[self._free_velocity if free_velocity is None else free_velocity],
            device=self._device,
        )

    def launch_collide(
        self,
        substep: int,
        position: wp.array,
        free_velocity: wp.array | None,
        outputs: list[Any],
    ) -> None:
        """Launch the collisions and the motion after them; see `collide_nodes`."""
        velocity = self._free_velocity if free_velocity is None else free_velocity
        ground = [self._world, self._clearance]
        wp.launch(
            collide_nodes,
            dim=self._count,
            inputs=[substep, *ground, self.start, self.candidate, position, velocity],
            outputs=outputs,
            device=self._device,
        )

    def _array(self, value: ndarray, dtype: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(value), dtype=dtype, device=self._device)

    def _zeros(self, count: int, dtype: Any) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=self._device)
