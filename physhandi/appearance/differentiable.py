"""Splats as PyTorch sees them: a picture through which a loss can be differentiated."""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physhandi.appearance.rasterise import SplatDrawing
from physhandi.data.camera import PinholeCamera
from physhandi.devices import start_warp

_shared: Callable[..., Any] = wp.from_torch
"""Warp's array of a tensor's memory; without more options it never is a bare C structure."""
_Picture = tuple[
    Float[Tensor, "row column 3"], Float[Tensor, "row column"], Float[Tensor, "row column"]
]
"""Color over black, what is covered, and mean depth of what covers [m], 0 where nothing does."""


def draw_splats(
    camera: PinholeCamera,
    center: Float[Tensor, "splat 3"],
    log_scale: Float[Tensor, " splat"],
    color: Float[Tensor, "splat 3"],
    opacity_logit: Float[Tensor, " splat"],
) -> _Picture:
    """Draw splats over black so that a loss of the picture can be differentiated.

    The gradient is that of `rasterise.render_splats`, in a fixed order of sums.

    Args:
        camera: Where the picture is taken from.
        center: Their middles [m].
        log_scale: Natural logarithms of their standard deviations [log m].
        color: Their colors, from 0 to 1.
        opacity_logit: Their opacities, as what the logistic function takes to them.

    Raises:
        ValueError: If the camera has distortion, or tensors do not fit.
    """
    count = len(center)
    given = {"center": center, "color": color}
    for name, value, shape in (
        *((name, value, (count, 3)) for name, value in given.items()),
        ("log_scale", log_scale, (count,)),
        ("opacity_logit", opacity_logit, (count,)),
    ):
        if value.shape != shape or value.dtype != torch.float32 or value.device != center.device:
            raise ValueError(
                f"{name} is {value.dtype} {tuple(value.shape)} on {value.device}; expected "
                f"torch.float32 {shape} on {center.device}."
            )
    return _Drawing.apply(camera, center, log_scale.exp(), color, opacity_logit.sigmoid())


class _Drawing(torch.autograd.Function):
    """Connects the rasteriser to PyTorch."""

    @staticmethod
    def forward(ctx: Any, camera: PinholeCamera, *splats: Tensor) -> tuple[Tensor, ...]:
        center, scale, color, opacity = (value.detach().contiguous() for value in splats)
        with _on_device_of(center):
            drawing = SplatDrawing(
                camera,
                center=_shared(center, dtype=wp.vec3),
                scale=_shared(scale),
                color=_shared(color, dtype=wp.vec3),
                opacity=_shared(opacity),
            )
            ctx.drawing = drawing
            return tuple(wp.to_torch(v) for v in (drawing.color, drawing.alpha, drawing.depth))

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        color, alpha, depth = (value.contiguous() for value in grad_outputs)
        with _on_device_of(color):
            slopes = ctx.drawing.slopes(
                _shared(color, dtype=wp.vec3), _shared(alpha), _shared(depth)
            )
            return None, *(wp.to_torch(value) for value in slopes)


@contextmanager
def _on_device_of(tensor: Tensor) -> Generator[None]:
    """Let Warp work where a tensor is, and on a GPU in PyTorch's order of things."""
    start_warp()
    if not tensor.is_cuda:
        with wp.ScopedDevice("cpu"):
            yield
        return
    with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(tensor.device))):
        yield
