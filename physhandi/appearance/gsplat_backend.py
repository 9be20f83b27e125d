"""The same pictures from gsplat's rasteriser, which is faster on CUDA where it is installed.

gsplat (V. Ye et al., Apache-2.0, extra ``splats``) adds gradients with atomics in any order, so a
fit with it does not end with the same bits. Its pictures agree with ours within 2/255, which is
what a splat at the limit `kernels.FAINT` may cover, and within 1e-4 on average.
"""

import importlib.util

import torch
from jaxtyping import Float
from torch import Tensor

from physhandi.appearance.kernels import BLUR, LEAST_DEPTH
from physhandi.data.camera import PinholeCamera


def is_installed() -> bool:
    """Tell whether gsplat is there, without importing it: it may compile then."""
    return importlib.util.find_spec("gsplat") is not None


def draw_splats_by_gsplat(
    camera: PinholeCamera,
    center: Float[Tensor, "splat 3"],
    log_scale: Float[Tensor, " splat"],
    color: Float[Tensor, "splat 3"],
    opacity_logit: Float[Tensor, " splat"],
) -> tuple[Tensor, Tensor, Tensor]:
    """Do what `differentiable.draw_splats` does; see there for arguments and result.

    Raises:
        ValueError: If the camera has distortion or skew, or the tensors are not on CUDA.
    """
    if camera.distortion.any() or camera.K[0, 1] != 0.0:
        raise ValueError("the camera must have neither lens distortion nor skew for gsplat")
    if not center.is_cuda:
        raise ValueError(f"gsplat draws on CUDA alone, but the splats are on {center.device}")
    from gsplat import (  # pyrefly: ignore[missing-import]  # an extra
        rasterization,
    )

    def placed(value: object) -> Tensor:
        return torch.tensor(value, dtype=torch.float32, device=center.device)

    K = camera.K.copy()
    K[:2, 2] += 0.5  # Its pixels have their centres at halves.
    upright = placed([1.0, 0.0, 0.0, 0.0]).expand(len(center), 4)
    picture, alpha, _ = rasterization(
        center,
        upright,
        log_scale.exp()[:, None].expand(-1, 3),
        opacity_logit.sigmoid(),
        color,
        placed(camera.T_camera_world)[None],
        placed(K)[None],
        camera.width,
        camera.height,
        near_plane=float(LEAST_DEPTH),
        eps2d=float(BLUR),
        packed=False,
        render_mode="RGB+ED",
    )
    return picture[0, ..., :3], alpha[0, ..., 0], picture[0, ..., 3]
