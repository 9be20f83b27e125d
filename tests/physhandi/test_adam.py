"""Our Adam beside PyTorch's."""

import pytest
import torch
from torch.optim.adam import _single_tensor_adam

from physhandi.adam import Adam


class Reference:
    """What `torch.optim.Adam` does to one tensor on a CPU.

    The class itself imports PyTorch's compiler when it is used, which takes seconds.
    """

    def __init__(self, value: torch.Tensor, betas: tuple[float, float]) -> None:
        self.value, self.betas = value, betas
        self.moments = torch.zeros_like(value.detach()), torch.zeros_like(value.detach())
        self.count = torch.tensor(0.0)

    @torch.no_grad()
    def step(self, rate: float) -> None:
        if self.value.grad is None:
            return
        first, second = self.moments
        _single_tensor_adam(
            *([self.value], [self.value.grad], [first], [second], [], [self.count], None, None),
            lr=rate,
            beta1=self.betas[0],
            beta2=self.betas[1],
            eps=1e-8,
            weight_decay=0.0,
            amsgrad=False,
            maximize=False,
            has_complex=False,
            capturable=False,
            differentiable=False,
            decoupled_weight_decay=False,
        )


def test_every_step_is_that_of_pytorch_bit_for_bit() -> None:
    generator = torch.Generator().manual_seed(3)
    starts = [torch.randn(40, 3, generator=generator), torch.randn(7, generator=generator)]
    rates, betas = [0.02, 0.3], (0.9, 0.99)
    ours = [start.clone().requires_grad_() for start in starts]
    theirs = [start.clone().requires_grad_() for start in starts]
    references = [Reference(t, betas) for t in theirs]
    adam = Adam(list(zip(ours, rates, strict=True)), betas=betas)
    for iteration in range(30):
        share = 1.0 - iteration / 40
        adam.zero_grad()
        for reference in references:
            reference.value.grad = None
        for wave, decay in (ours, theirs):
            loss = (wave.sin() * 5.0).sum()
            # The second tensor misses a gradient now and then, and must then stay.
            if iteration % 3:
                loss = loss + (decay**4).sum()
            loss.backward()
        adam.step(share)
        for reference, rate in zip(references, rates, strict=True):
            reference.step(rate * share)
        assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True)), iteration
    moved = [float((a - s).detach().abs().max()) for a, s in zip(ours, starts, strict=True)]
    assert moved[0] > 0.2
    assert moved[1] > 0.5


def test_the_first_step_has_the_size_that_is_asked_for() -> None:
    value = torch.tensor([1.0, -2.0], requires_grad=True)
    adam = Adam([(value, 0.1)], betas=(0.9, 0.99))
    (3.0 * value[0] - 1e-3 * value[1]).backward()
    adam.step(0.5)
    assert value.tolist() == pytest.approx([0.95, -1.95], rel=1e-4)


def test_rows_that_became_something_else_move_as_at_the_start() -> None:
    value = torch.ones(3, requires_grad=True)
    adam = Adam([(value, 0.1)], betas=(0.9, 0.99))
    for slope in (1.0, -3.0):
        value.grad = torch.full((3,), slope)
        adam.step()
    adam.forget(torch.tensor([1]))
    state = adam.state()
    assert state["adam.0.first"][1] == state["adam.0.second"][1] == 0.0
    assert state["adam.0.first"][0] == pytest.approx(0.9 * 0.1 - 0.1 * 3.0)
    assert state["adam.0.second"][2] == pytest.approx(0.99 * 0.01 + 0.01 * 9.0)
