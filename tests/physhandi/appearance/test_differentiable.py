import numpy as np
import pytest
import torch
from reference.splats import draw
from support.physics.splat_scene import askew_camera, random_splats

from physhandi.appearance.differentiable import draw_splats
from physhandi.appearance.rasterise import render_splats

STEP = 1e-6
NAMES = ("center", "log_scale", "color", "opacity_logit")


def logit(value: np.ndarray) -> np.ndarray:
    return np.log(value / (1 - value))


def test_slopes_are_those_of_pixels_that_ask_every_splat(device: str) -> None:
    """Compare with difference quotients, in float64, of the drawing by the book.

    Where a splat begins to count, the picture jumps and has no slope, so pixels near to that have
    no weight in the loss.
    """
    camera = askew_camera(27, 21)
    splats = random_splats(camera, 16, seed=7, beyond=1)
    opacity = splats.opacity.astype(np.float64).clip(0.01, 0.9985)
    opacity[:8] = 0.999999  # Their middles are as opaque as can be, which has no slope.
    values = {
        "center": splats.center.astype(np.float64),
        "log_scale": np.log(0.4 * splats.scale.astype(np.float64)),
        "color": splats.color.astype(np.float64),
        "opacity_logit": logit(opacity),
    }
    # What float32 rounds, the reference rounds too.
    values = {k: v.astype(np.float32).astype(np.float64) for k, v in values.items()}
    random = np.random.default_rng(8)
    weights = [
        random.normal(size=(camera.height, camera.width, *channels)) for channels in ((3,), (), ())
    ]

    def drawn(given: dict[str, np.ndarray]):
        return draw(
            camera,
            given["center"],
            np.exp(given["log_scale"]),
            given["color"],
            1 / (1 + np.exp(-given["opacity_logit"])),
        )

    expected = drawn(values)
    is_smooth = (expected.clearance > 1e-3) & (expected.alpha > 0.02)
    weights = [w * (is_smooth[..., None] if w.ndim == 3 else is_smooth) for w in weights]

    def loss(given: dict[str, np.ndarray]) -> float:
        picture = drawn(given)
        parts = (picture.color, picture.alpha, picture.depth)
        return float(sum(np.sum(w * p) for w, p in zip(weights, parts, strict=True)))

    tensors = {
        k: torch.tensor(v, dtype=torch.float32, device=device, requires_grad=True)
        for k, v in values.items()
    }
    picture = draw_splats(camera, **tensors)
    np.testing.assert_allclose(
        picture[0].detach().cpu().numpy()[is_smooth], expected.color[is_smooth], atol=2e-5
    )
    total = sum(
        (torch.tensor(w, dtype=torch.float32, device=device) * p).sum()
        for w, p in zip(weights, picture, strict=True)
    )
    total.backward()
    for name in NAMES:
        found = tensors[name].grad.cpu().numpy()
        quotient = np.zeros_like(values[name])
        for index in np.ndindex(quotient.shape):
            sides = []
            for sign in (1, -1):
                moved = {k: v.copy() for k, v in values.items()}
                moved[name][index] += sign * STEP
                sides.append(loss(moved))
            quotient[index] = (sides[0] - sides[1]) / (2 * STEP)
        assert (np.abs(quotient) > 1e-3 * np.abs(quotient).max()).mean() > 0.2
        np.testing.assert_allclose(
            found, quotient, rtol=2e-3, atol=2e-4 * np.abs(quotient).max(), err_msg=name
        )


def test_the_same_splats_give_the_same_slopes_bit_by_bit(device: str) -> None:
    camera = askew_camera(200, 120)
    splats = random_splats(camera, 3000)
    weight = torch.linspace(-1, 1, 200 * 120 * 3, device=device).reshape(120, 200, 3)
    found = []
    for _ in range(2):
        leaves = [
            torch.tensor(value, device=device, requires_grad=True)
            for value in (splats.center, np.log(splats.scale), splats.color, splats.opacity)
        ]
        color, alpha, depth = draw_splats(camera, *leaves)
        ((color * weight).sum() + alpha.sum() + depth.square().sum()).backward()
        found.append([leaf.grad.cpu().numpy() for leaf in leaves])
    for first, second in zip(*found, strict=True):
        assert np.isfinite(first).all()
        assert np.abs(first).max() > 1e-3
        np.testing.assert_array_equal(first, second)


def test_pictures_are_those_of_the_renderer() -> None:
    camera = askew_camera()
    splats = random_splats(camera)
    opacity = splats.opacity.clip(0.01, 0.99)
    picture = draw_splats(
        camera,
        torch.tensor(splats.center),
        torch.tensor(np.log(splats.scale)),
        torch.tensor(splats.color),
        torch.tensor(logit(opacity)),
    )
    fields = splats.to_tensors() | {"opacity": opacity}
    image = render_splats(camera, type(splats)(**fields))
    for part, value in zip(("color", "alpha", "depth"), picture, strict=True):
        np.testing.assert_allclose(value.numpy(), getattr(image, part), atol=0.005)
        assert np.abs(value.numpy() - getattr(image, part)).mean() < 1e-5


def test_tensors_that_do_not_fit_are_named() -> None:
    camera, zero = askew_camera(), torch.zeros(4)
    with pytest.raises(ValueError, match=r"color is torch.float64"):
        draw_splats(camera, torch.zeros(4, 3), zero, torch.zeros(4, 3).double(), zero)
