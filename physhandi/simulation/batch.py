"""Many candidates of one object at once: one launch moves them all by a substep on CUDA."""

from collections.abc import Iterator
from collections.abc import Sequence as Many

import numpy as np
import warp as wp
from jaxtyping import Float, Float32
from numpy import ndarray

from physhandi.errors import SimulationDivergedError, UsageError
from physhandi.simulation.batch_losses import LossSum, MotionTarget
from physhandi.simulation.master import MasterTopology
from physhandi.simulation.model import SimulationParameters
from physhandi.simulation.population import BatchLosses, BatchRollout, Population
from physhandi.simulation.simulator import Simulator, checked_control

_COMMON = ("rest_length_floor", "virtual_rest_length_floor", "frame_rate", "frame_duration")


class BatchSimulator:
    """Rolls out many candidates that differ in parameters and in topology.

    On CUDA they share every launch and take the substeps of the one that needs most; on a CPU
    they take turns. Self-collision is not simulated.
    """

    def __init__(
        self, master: MasterTopology, parameters: Many[SimulationParameters], device: str = "cpu"
    ) -> None:
        """Place candidates on a device.

        Args:
            master: Springs of all candidates; see `MasterTopology.of`.
            parameters: The candidates, at least one.
            device: Warp device.

        Raises:
            UsageError: If there is no candidate, or candidates differ in what must be common:
                rest length floors and frame rate.
        """
        if not parameters:
            raise UsageError("A batch needs at least one candidate.")
        for name in _COMMON:
            if len({getattr(p, name) for p in parameters}) > 1:
                raise UsageError(f"All candidates of a batch must have the same {name}.")
        if any(p.self_collision for p in parameters):
            raise UsageError("Self-collision is not simulated in a batch; switch it off.")
        self.master = master
        self.parameters = tuple(parameters)
        self.substeps = max(p.substeps_per_frame for p in parameters)
        self.device = wp.get_device(device)
        self._population: Population | None = None

    def rollout(self, control: Float[ndarray, "frame control 3"]) -> BatchRollout:
        """Simulate all frames of a control trajectory.

        Args:
            control: Positions of the control nodes in every frame [m].

        Raises:
            ValueError: If the trajectory does not fit the master topology or is not finite.
        """
        control = checked_control(control, self.master.control_count)
        population = self._on_device()
        if population is not None:
            return population.rollout(control)
        shape = (len(self.parameters), len(control), len(self.master.object_node), 3)
        position = np.full(shape, np.nan, dtype=np.float32)
        diverged = np.full(len(self.parameters), -1)
        for candidate, parameters in enumerate(self.parameters):
            try:
                for frame, state, _ in self._alone(parameters, control):
                    position[candidate, frame] = state
            except SimulationDivergedError as error:
                diverged[candidate] = error.frame
        return BatchRollout(position, diverged)

    def losses(
        self, control: Float[ndarray, "frame control 3"], target: MotionTarget
    ) -> BatchLosses:
        """Simulate the observed frames and compare every candidate with what was observed.

        On CUDA the losses are added up on the device, and the host waits for it once.

        Args:
            control: Positions of the control nodes, in the observed frames at least [m].
            target: What was observed.

        Raises:
            ValueError: If the trajectory does not fit the master topology, is not finite, or is
                shorter than what was observed.
        """
        control = checked_control(control, self.master.control_count)
        if len(control) < target.frame_count:
            raise ValueError(
                f"control has {len(control)} frames, but {target.frame_count} were observed."
            )
        population = self._on_device()
        if population is not None:
            return population.losses(control, target)
        loss = np.full(len(self.parameters), np.inf, dtype=np.float32)
        diverged = np.full(len(self.parameters), -1)
        nodes = len(self.master.object_node)
        good = wp.full(1, -1, dtype=wp.int32, device=self.device)
        for candidate, parameters in enumerate(self.parameters):
            sums = LossSum(target, np.arange(nodes), lanes=1, width=1, device=self.device)
            try:
                for frame, *state in self._alone(parameters, control[: target.frame_count]):
                    flat = np.concatenate(state, axis=1).ravel()
                    sums.add(frame, wp.array(flat, dtype=wp.float32, device=self.device), good)
                loss[candidate] = sums.loss.numpy()[0]
            except SimulationDivergedError as error:
                diverged[candidate] = error.frame
        return BatchLosses(loss, diverged)

    def _on_device(self) -> Population | None:
        if not self.device.is_cuda or len(self.master.object_node) == 0:
            return None
        if self._population is None:
            self._population = Population(self.master, self.parameters, self.substeps, self.device)
        return self._population

    def _alone(
        self, parameters: SimulationParameters, control: Float32[ndarray, "frame control 3"]
    ) -> Iterator[tuple[int, ndarray, ndarray]]:
        model = self.master.model(parameters)
        return Simulator(model, parameters, device=str(self.device)).frames(control)
