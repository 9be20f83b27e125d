from dataclasses import replace

import numpy as np
import pytest
import torch
from support.physics.splat_scene import askew_camera, random_splats

from physhandi.appearance.differentiable import draw_splats
from physhandi.appearance.gsplat_backend import draw_splats_by_gsplat, is_installed


@pytest.mark.gpu
def test_gsplat_draws_and_differentiates_as_we_do() -> None:
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    if not is_installed():
        pytest.skip("needs gsplat: pip install 'physhandi[splats]'")
    camera = askew_camera(120, 90)
    camera = replace(camera, K=camera.K * np.array([[1, 0, 1], [1, 1, 1], [1, 1, 1]]))
    splats = random_splats(camera, 400)
    opacity = splats.opacity.clip(0.01, 0.99)
    found = []
    for draw in (draw_splats, draw_splats_by_gsplat):
        leaves = [
            torch.tensor(value, device="cuda", requires_grad=True)
            for value in (
                splats.center,
                np.log(splats.scale),
                splats.color,
                np.log(opacity / (1 - opacity)),
            )
        ]
        color, alpha, depth = draw(camera, *leaves)
        (color.square().sum() + alpha.sum() + (alpha.detach() * depth).sum()).backward()
        picture = [value.detach().cpu().numpy() for value in (color, alpha)]
        found.append((picture, [leaf.grad.cpu().numpy() for leaf in leaves]))
    (ours, our_slopes), (theirs, their_slopes) = found
    for own, other in zip(ours, theirs, strict=True):
        assert own.mean() > 0.05
        assert np.abs(own - other).max() < 2 / 255
        assert np.abs(own - other).mean() < 1e-4
    for own, other in zip(our_slopes, their_slopes, strict=True):
        assert np.abs(own - other).mean() < 0.01 * np.abs(own).mean()


def test_what_gsplat_cannot_draw_is_refused() -> None:
    camera = askew_camera()
    splats = (torch.zeros(2, 3), torch.zeros(2), torch.zeros(2, 3), torch.zeros(2))
    with pytest.raises(ValueError, match="neither lens distortion nor skew"):
        draw_splats_by_gsplat(camera, *splats)
    straight = replace(camera, K=camera.K * np.array([[1, 0, 1], [1, 1, 1], [1, 1, 1]]))
    with pytest.raises(ValueError, match="gsplat draws on CUDA alone, but the splats are on cpu"):
        draw_splats_by_gsplat(straight, *splats)
