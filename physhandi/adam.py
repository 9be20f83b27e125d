"""Adam, as PyTorch computes it on a CPU, without the seconds that importing its compiler takes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor


@dataclass
class _Moments:
    """A tensor that is learned, and what Adam remembers of its gradients."""

    tensor: Tensor
    rate: float
    first: Tensor
    second: Tensor
    count: int = 0


class Adam:
    """Adam (Kingma and Ba, 2015), bit for bit `torch.optim.Adam` on a CPU.

    The first use of any optimizer in `torch.optim` imports PyTorch's compiler (`torch._dynamo`),
    which takes longer than a stage of a short fit; nothing of it is used here.
    """

    def __init__(
        self,
        tensors: Sequence[tuple[Tensor, float]],
        *,
        betas: tuple[float, float],
        epsilon: float = 1e-8,
    ) -> None:
        """Start without momentum.

        Args:
            tensors: What to update, and the step of each.
            betas: Decay of the first and of the second moment.
            epsilon: Root of the second moment below which the step shrinks.
        """
        self._betas, self._epsilon = betas, epsilon
        self._moments = [
            _Moments(tensor, rate, torch.zeros_like(tensor), torch.zeros_like(tensor))
            for tensor, rate in tensors
        ]

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for moments in self._moments:
            moments.tensor.grad = None

    @torch.no_grad()
    def step(self, share: float = 1.0) -> None:
        """Update every tensor that has a gradient, by this share of its step."""
        beta_1, beta_2 = self._betas
        for moments in self._moments:
            gradient = moments.tensor.grad
            if gradient is None:
                continue
            moments.count += 1
            moments.first.lerp_(gradient, 1 - beta_1)
            moments.second.mul_(beta_2).addcmul_(gradient, gradient, value=1 - beta_2)
            size = moments.second.sqrt() / (1 - beta_2**moments.count) ** 0.5
            step = share * moments.rate / (1 - beta_1**moments.count)
            moments.tensor.addcdiv_(moments.first, size.add_(self._epsilon), value=-step)

    @torch.no_grad()
    def forget(self, is_row: Tensor) -> None:
        """Forget the momentum of some rows of every tensor, which have become something else."""
        for moments in self._moments:
            moments.first[is_row] = 0.0
            moments.second[is_row] = 0.0

    def state(self) -> dict[str, ndarray]:
        """Copy everything that the next steps depend on, the learned tensors included."""
        state: dict[str, ndarray] = {}
        for number, moments in enumerate(self._moments):
            state[f"adam.{number}.value"] = moments.tensor.detach().cpu().numpy().copy()
            state[f"adam.{number}.first"] = moments.first.cpu().numpy().copy()
            state[f"adam.{number}.second"] = moments.second.cpu().numpy().copy()
            state[f"adam.{number}.count"] = np.array([moments.count])
        return state

    @torch.no_grad()
    def restore(self, state: Mapping[str, ndarray]) -> None:
        """Return to what `state` gave."""
        for number, moments in enumerate(self._moments):
            moments.tensor.copy_(torch.from_numpy(state[f"adam.{number}.value"]))
            moments.first.copy_(torch.from_numpy(state[f"adam.{number}.first"]))
            moments.second.copy_(torch.from_numpy(state[f"adam.{number}.second"]))
            moments.count = int(state[f"adam.{number}.count"][0])
