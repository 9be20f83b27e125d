"""Loss terms against hand-computed cases and brute force in float64."""

import numpy as np
import pytest
import torch

from physhandi.fitting.object_problem import (
    ObjectProblem,
    chamfer_loss,
    node_acceleration_loss,
    track_loss,
)


def test_chamfer_is_one_way_and_squared() -> None:
    observed = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [9.0, 9.0, 9.0]]])
    real = torch.tensor([[True, True, False]])
    # A node far from every observation costs nothing: (0.2² + 0.3²) / 2.
    node = torch.tensor([[[0.0, 0.2, 0.0], [1.0, 0.0, 0.3], [5.0, 5.0, 5.0]]])
    assert chamfer_loss(observed, real, node).tolist() == pytest.approx([0.065])


def test_chamfer_gradient_pulls_only_the_nearest_node() -> None:
    observed = torch.zeros(1, 1, 3)
    node = torch.tensor([[[0.1, 0.0, 0.0], [0.5, 0.0, 0.0]]], requires_grad=True)
    chamfer_loss(observed, torch.ones(1, 1, dtype=torch.bool), node).sum().backward()
    assert node.grad is not None
    assert node.grad[0, :, 0].tolist() == pytest.approx([0.2, 0.0])


def test_frozen_count_replaces_the_number_of_points() -> None:
    observed = torch.zeros(1, 2, 3)
    node = torch.tensor([[[0.2, 0.0, 0.0]]])
    real = torch.ones(1, 2, dtype=torch.bool)
    assert chamfer_loss(observed, real, node, count=torch.tensor([8.0])).item() == pytest.approx(
        0.01
    )


def test_track_loss_ignores_what_cannot_be_trusted() -> None:
    observed = torch.tensor([[[0.3, 0.0, 0.0], [float("nan")] * 3]])
    predicted = torch.zeros(1, 2, 3)
    valid = torch.tensor([[True, False]])
    assert track_loss(observed, valid, predicted).tolist() == pytest.approx([0.09])
    assert track_loss(observed, torch.zeros_like(valid), predicted).tolist() == [0.0]


def test_six_track_losses_are_one_of_phystwin() -> None:
    difference = torch.tensor([[[0.1, 0.2, -0.1]]])
    theirs = torch.nn.functional.smooth_l1_loss(difference, torch.zeros_like(difference)).item()
    ours = track_loss(difference, torch.ones(1, 1, dtype=torch.bool), torch.zeros_like(difference))
    assert ours.item() / 6 == pytest.approx(theirs)
    assert theirs == pytest.approx(0.01)


def test_acceleration_loss_sees_a_jerk_and_no_steady_push() -> None:
    steady = torch.arange(5.0)[:, None, None].expand(5, 2, 3)
    assert node_acceleration_loss(steady).tolist() == [0.0] * 5
    kick = steady.clone()
    kick[3:] += 1.0
    # The change of velocity grows by 1 and falls back by 1: smooth L1 of 1 is 0.5, twice.
    assert node_acceleration_loss(kick).tolist() == pytest.approx([0.0, 0.0, 0.0, 0.5, 0.5])


@pytest.mark.parametrize("seed", range(3))
def test_chamfer_equals_brute_force(seed: int) -> None:
    random = np.random.default_rng(seed)
    observed, node = random.normal(size=(2, 7, 3)), random.normal(size=(2, 5, 3))
    real = random.random((2, 7)) < 0.7
    expected = [
        np.mean([min(np.sum((o - n) ** 2) for n in node[f]) for o in observed[f][real[f]]])
        for f in range(2)
    ]
    loss = chamfer_loss(
        torch.from_numpy(observed).float(), torch.from_numpy(real), torch.from_numpy(node).float()
    )
    assert loss.tolist() == pytest.approx(expected, rel=1e-4)


def test_the_nearest_node_is_found_far_from_the_origin_and_between_padding() -> None:
    random = np.random.default_rng(3)
    far = np.array([3.0, -2.0, 1.0])
    node = far + random.uniform(-0.01, 0.01, (2, 400, 3))
    observed = far + random.uniform(-0.01, 0.01, (2, 60, 3))
    real = random.random((2, 60)) < 0.7
    node, observed = node.astype(np.float32), observed.astype(np.float32)
    expected = []
    for frame in range(2):
        gap = observed[frame][real[frame], None].astype(float) - node[frame].astype(float)
        expected.append((gap**2).sum(axis=2).min(axis=1).mean())
    observed[~real] = np.nan
    loss = chamfer_loss(torch.from_numpy(observed), torch.from_numpy(real), torch.from_numpy(node))
    assert loss.tolist() == pytest.approx(expected, rel=1e-3)
    assert min(expected) > 1e-7


@pytest.mark.gpu
def test_a_gpu_computes_the_same_losses_and_the_same_bits_every_time() -> None:
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    random = np.random.default_rng(5)

    def draw(*shape: int) -> torch.Tensor:
        return torch.from_numpy(random.normal(size=shape)).float()

    tracks, nodes = 300, 50
    problem = ObjectProblem(
        name="cloud",
        object_node=np.zeros((nodes, 3), np.float32),
        rest_node=np.zeros((nodes, 3), np.float32),
        control=np.zeros((4, 0, 3), np.float32),
        hand_face=np.zeros((0, 3), np.int32),
        frame_rate=30.0,
        ground_height=None,
        gravity=0.0,
        initial_velocity=np.zeros((nodes, 3), np.float32),
        clearance=np.zeros(nodes, np.float32),
        cloud=draw(4, 200, 3),
        is_observed=torch.from_numpy(random.random((4, 200)) < 0.8),
        track=draw(4, tracks, 3),
        is_valid=torch.from_numpy(random.random((4, tracks)) < 0.8),
        carrier=torch.from_numpy(random.random((tracks, nodes)).argsort(axis=1)[:, :4].copy()),
        carrier_weight=torch.from_numpy(random.dirichlet(np.ones(4), tracks)).float(),
        track_offset=draw(tracks, 3),
        surface_count=40,
    )
    moved = draw(3, nodes, 3)

    def judged(device: str) -> tuple[torch.Tensor, torch.Tensor]:
        node = moved.clone().to(device).requires_grad_()
        losses = problem.on(device).frame_losses(node, track_weight=0.7)
        (losses * torch.arange(1.0, 4.0, device=device)).sum().backward()
        assert node.grad is not None
        return losses.detach().cpu(), node.grad.cpu()

    wanted, gradient = judged("cpu")
    assert wanted.min() > 0.1
    losses, there = judged("cuda:0")
    torch.testing.assert_close(losses, wanted, rtol=1e-5, atol=0.0)
    torch.testing.assert_close(there, gradient, rtol=1e-4, atol=1e-5)
    for _ in range(5):
        again = judged("cuda:0")
        assert torch.equal(again[0], losses)
        assert torch.equal(again[1], there)
