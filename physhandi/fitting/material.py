"""What the first-order stage learns: a stiffness and a damping per spring, contact coefficients."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from physhandi.errors import FitError
from physhandi.fitting.object_config import FirstOrderConfig
from physhandi.simulation.model import SimulationParameters, SpringMassModel

CONTACT = {
    "restitution": (0.0, 1.0),
    "friction": (0.0, 2.0),
    "self_restitution": (0.0, 1.0),
    "self_friction": (0.0, 2.0),
}
"""Interval of each contact coefficient; outside it acts as at the nearer end (physics.md §3.2)."""
SMALLEST = 1e-6
"""Stands for a zero, which has no logarithm, in a spring's stiffness [N] or damping [N·s/m]."""


class Material:
    """Logarithms of stiffness and damping, object springs shared, virtual springs per sequence.

    A spring that starts without stiffness is off and stays off, dashpot included: where PhysTwin's
    linear search reaches 0 N, its springs have the logarithm -∞ and no gradient.
    """

    def __init__(
        self,
        models: Mapping[str, SpringMassModel],
        parameters: SimulationParameters,
        config: FirstOrderConfig,
    ) -> None:
        """Start from the springs of every sequence's model.

        Args:
            models: Model of each sequence; they must share their object springs.
            parameters: Where the contact coefficients start.
            config: What is learned.

        Raises:
            FitError: If two sequences connect the object's nodes differently.
        """
        first = next(iter(models.values()))
        self._object_count = first.object_spring_count
        for name, model in models.items():
            same = np.array_equal(
                model.spring_nodes[: self._object_count], first.spring_nodes[: self._object_count]
            )
            if model.object_spring_count != self._object_count or not same:
                raise FitError(
                    f"Sequence '{name}' connects the object's nodes differently from the first "
                    "one: sequences fitted together must share one object and its rest nodes."
                )
        self._config = config
        self._shared = _logarithms(first, slice(None, self._object_count))
        self._own = {n: _logarithms(m, slice(self._object_count, None)) for n, m in models.items()}
        self._is_off = {n: torch.from_numpy(m.stiffness <= 0.0) for n, m in models.items()}
        self._start = [tensor.detach().clone() for tensor in self.logarithms()]
        self._contact: dict[str, Tensor] = {}
        if config.learns_contact:
            self._contact = {
                name: torch.tensor(float(getattr(parameters, name)), requires_grad=True)
                for name in CONTACT
            }

    def logarithms(self) -> list[Tensor]:
        """The learned logarithms, of stiffness (row 0) and damping (row 1) of some springs."""
        return [self._shared, *self._own.values()]

    def tensors(self) -> list[Tensor]:
        """All that is learned."""
        return [*self.logarithms(), *self._contact.values()]

    def of(self, name: str) -> tuple[Float[Tensor, " spring"], Float[Tensor, " spring"]]:
        """Log stiffness [log N] and damping [N·s/m] of all springs of one sequence's model."""
        both = torch.cat([self._shared, self._own[name]], dim=1)
        log_stiffness, is_off = both[0], self._is_off[name]
        if self._config.most_stiffness is not None:
            # The gradient of a clamp is zero where it acts.
            log_stiffness = log_stiffness.clamp(max=math.log(self._config.most_stiffness))
        damping = (both[1] if self._config.learns_damping else both[1].detach()).exp()
        off = torch.full_like(log_stiffness, -math.inf)
        return torch.where(is_off, off, log_stiffness), damping * ~is_off

    def contact(self) -> dict[str, Tensor]:
        """The learned contact coefficients by name; empty if none are learned."""
        return dict(self._contact)

    def gradient(self, name: str) -> Float[Tensor, " spring"]:
        """Gradient that a backward pass left in the log stiffness of one sequence's springs."""
        parts = (self._shared, self._own[name])
        rows = [torch.zeros_like(part[0]) if part.grad is None else part.grad[0] for part in parts]
        return torch.cat(rows)

    def distance_from_start(self) -> Float[Tensor, ""]:
        """Sum of the squared changes of all logarithms."""
        pairs = zip(self.logarithms(), self._start, strict=True)
        return torch.stack([((now - then) ** 2).sum() for now, then in pairs]).sum()

    def model(self, name: str, model: SpringMassModel) -> SpringMassModel:
        """Put what was learned of the springs into one sequence's model."""
        log_stiffness, damping = self.of(name)
        return replace(
            model,
            stiffness=log_stiffness.detach().exp().numpy().astype(np.float32),
            damping=damping.detach().numpy().astype(np.float32),
        )

    def parameters(self, parameters: SimulationParameters) -> SimulationParameters:
        """Put what was learned of contact into the global parameters, as it acts."""
        learned = {
            name: min(max(float(value.detach()), CONTACT[name][0]), CONTACT[name][1])
            for name, value in self._contact.items()
        }
        return replace(parameters, **learned)


def _logarithms(model: SpringMassModel, part: slice) -> Tensor:
    both = np.stack([model.stiffness[part], model.damping[part]])
    return torch.log(torch.from_numpy(both).clamp(min=SMALLEST)).requires_grad_()
