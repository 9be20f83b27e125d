from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from reference.splats import draw
from support.physics.splat_scene import askew_camera, random_splats

from physhandi.appearance.rasterise import render_splats
from physhandi.appearance.splats import Splats
from physhandi.data.camera import PinholeCamera


def arrays(splats: Splats) -> tuple[np.ndarray, ...]:
    return splats.center, splats.scale, splats.color, splats.opacity


def test_pictures_are_what_every_pixel_gets_from_every_splat(device: str) -> None:
    camera = askew_camera()
    splats = random_splats(camera)
    random = np.random.default_rng(2)
    background = random.random((camera.height, camera.width, 3))
    occluder = random.choice([0.0, 0.35, 0.5], (camera.height, camera.width))
    for behind, before in ((None, None), (background, None), (background, occluder)):
        image = render_splats(camera, splats, background=behind, occluder=before, device=device)
        expected = draw(camera, *arrays(splats), behind, before)
        is_sure = expected.clearance > 1e-3
        assert is_sure.mean() > 0.9
        np.testing.assert_allclose(image.color[is_sure], expected.color[is_sure], atol=2e-5)
        np.testing.assert_allclose(image.alpha[is_sure], expected.alpha[is_sure], atol=2e-5)
        np.testing.assert_allclose(image.depth[is_sure], expected.depth[is_sure], atol=2e-5)
        # Where rounding decides on a splat, that is one of least opacity.
        assert np.abs(image.color - expected.color).max() < 0.005
    assert 0.1 < expected.alpha.mean() < 0.7
    assert (expected.alpha == 0.0).any()


def test_the_same_splats_give_the_same_bits(device: str) -> None:
    camera = askew_camera(200, 120)
    splats = random_splats(camera, 3000)
    first, second = (render_splats(camera, splats, device=device) for _ in range(2))
    for name in ("color", "alpha", "depth"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_a_part_of_a_picture_is_the_picture_of_a_part() -> None:
    camera = askew_camera()
    splats = random_splats(camera)
    inside = camera.to_camera(splats.center)[:, 2] > 0.2  # Wide ones depend on the border.
    splats = Splats(
        **{
            name: value if name == "rest_node" else value[inside]
            for name, value in splats.to_tensors().items()
        }
    )
    K = camera.K.copy()
    K[:2, 2] -= [13, 9]
    part = replace(camera, K=K, width=30, height=20)
    whole = render_splats(camera, splats)
    np.testing.assert_allclose(
        render_splats(part, splats).color, whole.color[9:29, 13:43], atol=2e-3
    )


def one_splat(**changed: Any) -> Splats:
    fields: dict[str, Any] = {
        "center": [[0.0, 0.0, 0.5]],
        "scale": [0.01],
        "color": [[0.2, 0.4, 0.8]],
        "opacity": [0.75],
        "rest_node": [[0.0, 0.0, 0.0]],
    }
    return Splats(**{k: np.asarray(v, np.float32) for k, v in (fields | changed).items()})


def straight_camera() -> PinholeCamera:
    K = np.array([[100.0, 0, 20], [0, 100.0, 10], [0, 0, 1]])
    return PinholeCamera(K=K, T_world_camera=np.eye(4), width=41, height=21)


def test_one_splat_is_a_gaussian_of_its_size_and_the_blur() -> None:
    image = render_splats(straight_camera(), one_splat())
    variance = (0.01 * 100 / 0.5) ** 2 + 0.3
    assert image.alpha[10, 20] == pytest.approx(0.75)
    assert image.alpha[12, 23] == pytest.approx(0.75 * np.exp(-0.5 * 13 / variance), rel=1e-5)
    np.testing.assert_allclose(image.color[10, 20], [0.15, 0.3, 0.6], rtol=1e-5)
    assert image.depth[12, 23] == pytest.approx(0.5)
    assert (image.alpha[0, 0], image.depth[0, 0]) == (0.0, 0.0)


def test_splats_go_where_they_are_carried() -> None:
    splats = one_splat()
    moved = render_splats(
        straight_camera(), splats, center=splats.center + np.array([0.05, 0.0, 0.0])
    )
    assert np.unravel_index(moved.alpha.argmax(), moved.alpha.shape) == (10, 30)


def test_what_does_not_fit_is_refused() -> None:
    camera, splats = straight_camera(), one_splat()
    with pytest.raises(ValueError, match="no lens distortion"):
        render_splats(replace(camera, distortion=np.array([0.1, 0, 0, 0, 0])), splats)
    with pytest.raises(ValueError, match=r"center has shape \(2, 3\)"):
        render_splats(camera, splats, center=np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"background has shape \(3, 4, 3\); expected \(21, 41"):
        render_splats(camera, splats, background=np.zeros((3, 4, 3)))
    with pytest.raises(ValueError, match="occluder has shape"):
        render_splats(camera, splats, occluder=np.zeros((3, 4)))


def test_nothing_to_draw_leaves_the_background() -> None:
    camera, splats = straight_camera(), one_splat(center=[[0.0, 0.0, -1.0]])
    background = np.random.default_rng(4).random((21, 41, 3)).astype(np.float32)
    image = render_splats(camera, splats, background=background)
    np.testing.assert_array_equal(image.color, background)
    assert not image.alpha.any()
