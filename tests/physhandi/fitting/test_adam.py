"""Our Adam beside PyTorch's."""

import pytest
import torch

from physhandi.fitting.adam import Adam


def test_every_step_is_that_of_pytorch_bit_for_bit() -> None:
    generator = torch.Generator().manual_seed(3)
    starts = [torch.randn(40, 3, generator=generator), torch.randn(7, generator=generator)]
    rates, betas = [0.02, 0.3], (0.9, 0.99)
    ours = [start.clone().requires_grad_() for start in starts]
    theirs = [start.clone().requires_grad_() for start in starts]
    groups = [{"params": [t], "lr": rate} for t, rate in zip(theirs, rates, strict=True)]
    reference = torch.optim.Adam(groups, betas=betas)
    adam = Adam(list(zip(ours, rates, strict=True)), betas=betas)
    for iteration in range(30):
        share = 1.0 - iteration / 40
        for group, rate in zip(reference.param_groups, rates, strict=True):
            group["lr"] = rate * share
        for tensors, optimizer in ((ours, adam), (theirs, reference)):
            optimizer.zero_grad()
            wave, decay = tensors
            loss = (wave.sin() * 5.0).sum()
            # The second tensor misses a gradient now and then, and must then stay.
            if iteration % 3:
                loss = loss + (decay**4).sum()
            loss.backward()
        adam.step(share)
        reference.step()
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
