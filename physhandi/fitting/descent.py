"""Adam on an object's material, one update for every window of frames."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from physhandi.fitting.material import Material
from physhandi.fitting.object_config import ObjectFitConfig
from physhandi.fitting.object_problem import ObjectProblem
from physhandi.fitting.object_simulation import problem_parameters
from physhandi.simulation import differentiable
from physhandi.simulation.model import SimulationParameters, SpringMassModel

State = tuple[Float[Tensor, "node 3"], Float[Tensor, "node 3"]]
"""Positions [m] and velocities [m/s] of the object nodes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """A few simulated frames whose gradient lies in the material."""

    frame_losses: Float[Tensor, " frame"]
    """Loss of each frame, with the material as it was [m²]."""
    state: State
    """Where the nodes were in the last frame."""


class Descent:
    """Walks through sequences and learns the material on the way, from sane gradients only."""

    def __init__(
        self,
        material: Material,
        parameters: SimulationParameters,
        config: ObjectFitConfig,
        device: str = "cpu",
    ) -> None:
        self.material = material
        self._parameters = parameters
        self._config = config
        self._device = device
        settings = config.first_order
        self._optimizer = torch.optim.Adam(
            material.tensors(), lr=settings.learning_rate, betas=(0.9, settings.beta_2)
        )
        self._reach: dict[str, int] = {}

    def walk(self, problem: ObjectProblem, model: SpringMassModel, horizon: int) -> float | None:
        """Walk once through a sequence and update after every window of frames.

        Each window starts where the last one ended, with the material that has since changed
        (physics.md §4.3).

        Args:
            problem: The sequence.
            model: Its springs, as they were at the start.
            horizon: Frames to walk, frame 0 included.

        Returns:
            Mean loss met on the way [m²], or none if a window had no usable gradient; the rest of
            the sequence is then left out.

        Raises:
            SimulationDivergedError: If the motion runs away.
        """
        length = self._config.first_order.window or horizon - 1
        state = torch.from_numpy(model.object_node), torch.from_numpy(model.initial_velocity)
        losses = []
        for begin in range(0, horizon - 1, length):
            window = self.look(problem, model, (begin, min(begin + length, horizon - 1)), state)
            if window is None:
                return None
            self._optimizer.step()
            losses.append(window.frame_losses)
            state = window.state
        return float(torch.cat(losses).double().mean())

    def look(
        self,
        problem: ObjectProblem,
        model: SpringMassModel,
        frames: tuple[int, int],
        state: State,
    ) -> Window | None:
        """Simulate one window and leave the gradient of its mean loss in the material.

        Motion that is chaotic over the window has gradients that grow without bound and point
        nowhere. The gradient then reaches back over half as many frames, and again half as many
        until it is sane; how far it came is tried first the next time.

        Args:
            problem: The sequence.
            model: Its springs.
            frames: First frame, whose state is given, and last frame.
            state: The nodes in the first frame.

        Returns:
            What was simulated, or none if not even one frame has a sane gradient.
        """
        begin, end = frames
        steepest = self._config.first_order.steepest
        reach = min(self._reach.get(problem.name, end - begin), end - begin)
        while reach >= 1:
            self._optimizer.zero_grad()
            log_stiffness, damping = self.material.of(problem.name)
            contact: dict[str, Any] = self.material.contact()
            node, velocity = differentiable.rollout(
                model,
                problem_parameters(self._parameters, problem),
                torch.from_numpy(problem.control[begin : end + 1]),
                log_stiffness=log_stiffness,
                damping=damping,
                initial_position=state[0],
                initial_velocity=state[1],
                device=self._device,
                window=reach,
                **contact,
            )
            frame_losses = problem.frame_losses(
                node[1:],
                first_frame=begin + 1,
                track_weight=self._config.track_weight,
                freeze_counts=self._config.freezes_counts,
            )
            prior = self._config.first_order.prior_weight * self.material.distance_from_start()
            loss = frame_losses.mean() + prior
            loss.backward()
            if steepest is None or self._slope() <= steepest * float(loss.detach()):
                if reach < end - begin:
                    self._reach[problem.name] = reach
                last = node[-1].detach(), velocity[-1].detach()
                return Window(frame_losses=frame_losses.detach(), state=last)
            reach //= 2
        return None

    def _slope(self) -> float:
        gradients = [t.grad for t in self.material.logarithms() if t.grad is not None]
        return max(float(gradient.double().norm()) for gradient in gradients)
