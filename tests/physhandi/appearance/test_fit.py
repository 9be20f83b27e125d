"""Fits to a made object: a wavy sheet with a picture on it, of which the true splats are known."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from physhandi.appearance.config import AppearanceConfig
from physhandi.appearance.fit import FittedSplats, fit_splats
from physhandi.appearance.rasterise import render_splats
from physhandi.appearance.splats import Splats
from physhandi.data.camera import PinholeCamera
from physhandi.data.checkpoint import Checkpointer, SavedState
from physhandi.data.view import View
from physhandi.errors import CancelledError, MissingInputError
from physhandi.progress import Progress

CONFIG = AppearanceConfig(splat_count=500, iterations=60, renewal_interval=20)


def sheet() -> Splats:
    x, y = (
        a.ravel() for a in np.meshgrid(np.linspace(-0.1, 0.1, 70), np.linspace(-0.08, 0.08, 56))
    )
    z = 0.02 * np.sin(25 * x) + 0.01 * np.cos(30 * y)
    stripe = (np.sin(120 * x) > 0) ^ (np.sin(90 * y) > 0)
    color = np.where(stripe[:, None], [0.9, 0.7, 0.2], [0.1, 0.3, 0.6])
    return Splats(
        center=np.stack([x, y, z], axis=1).astype(np.float32),
        scale=np.full(x.size, 0.0018, np.float32),
        color=color.astype(np.float32),
        opacity=np.full(x.size, 0.95, np.float32),
        rest_node=np.stack([x, y, z], axis=1).astype(np.float32)[::37],
    )


def camera_at(place: tuple[float, float, float]) -> PinholeCamera:
    """A small camera that looks at the origin."""
    forward = -np.array(place) / np.linalg.norm(place)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = place
    K = np.array([[150.0, 0, 40], [0, 150.0, 30], [0, 0, 1]])
    return PinholeCamera(K=K, T_world_camera=pose, width=80, height=60)


CAMERAS = [camera_at(p) for p in ((0.15, 0.05, 0.45), (-0.2, 0.1, 0.4), (0.0, -0.2, 0.42))]
UNSEEN = camera_at((0.03, 0.02, 0.47))


class MadeView(View):
    """A view that is not on a disk."""

    def __init__(self, camera: PinholeCamera, hand: Any = None) -> None:
        super().__init__(Path("made/views/a"), "made", camera, 1)
        self.has_color = self.has_depth = self.has_mask = True
        image = render_splats(camera, sheet())
        self._mask = (image.alpha > 0.5).astype(np.uint8)
        self._color = (255 * image.color + 0.5).astype(np.uint8)
        self._depth = np.where(self._mask > 0, image.depth, np.float32(0.0))
        if hand is not None:
            self._mask[hand], self._color[hand] = 2, [255, 0, 255]

    def color(self, frame: int) -> np.ndarray:
        return self._color

    def mask(self, frame: int) -> np.ndarray:
        return self._mask

    def depth(self, frame: int) -> np.ndarray:
        return self._depth


@dataclass
class Kept(Checkpointer):
    """Keeps the state after one iteration."""

    after: int
    state: dict[str, np.ndarray] = field(default_factory=dict[str, np.ndarray])

    def offer(self, name: str, iteration: int, state: Any) -> None:
        if iteration == self.after:
            self.state = {key: value.copy() for key, value in state().items()}


@dataclass
class Resumed(Checkpointer):
    saved: Mapping[str, np.ndarray]

    def load(self, name: str, like: Any, *, growing: Any = ()) -> SavedState:
        assert set(self.saved) == set(like)
        return SavedState(len(self.saved["curve"]), dict(self.saved))


@pytest.fixture(scope="module")
def views() -> list[View]:
    return [MadeView(camera) for camera in CAMERAS]


@pytest.fixture(scope="module")
def kept() -> Kept:
    return Kept(after=31)


@pytest.fixture(scope="module")
def fitted(views: list[View], kept: Kept) -> FittedSplats:
    return fit_splats(views, sheet().rest_node, config=CONFIG, checkpointer=kept)


def psnr(splats: Splats, camera: PinholeCamera) -> float:
    """Compare with the true splats where these are."""
    true, found = (render_splats(camera, one) for one in (sheet(), splats))
    error = (true.color - found.color)[true.alpha > 0.5]
    return float(-10 * np.log10(np.mean(error**2)))


def test_a_camera_that_took_no_part_sees_the_object_as_it_is(
    views: list[View], fitted: FittedSplats
) -> None:
    start = fit_splats(
        views, sheet().rest_node, config=AppearanceConfig(splat_count=500, iterations=0)
    )
    assert psnr(fitted.splats, UNSEEN) > psnr(start.splats, UNSEEN) + 2.0
    assert psnr(fitted.splats, UNSEEN) > 21.0
    true, found = (render_splats(UNSEEN, one) for one in (sheet(), fitted.splats))
    covered = [image.alpha > 0.5 for image in (true, found)]
    assert (covered[0] & covered[1]).sum() / (covered[0] | covered[1]).sum() > 0.95
    both = covered[0] & covered[1]
    assert np.abs(true.depth - found.depth)[both].mean() < 0.003
    assert len(fitted.splats.center) <= 500
    assert len(fitted.curve) == 60
    assert fitted.curve[-6:].mean() < 0.6 * fitted.curve[:6].mean()


def test_a_resumed_fit_ends_with_the_same_bits(
    views: list[View], fitted: FittedSplats, kept: Kept
) -> None:
    assert len(kept.state["curve"]) == 31
    again = fit_splats(views, sheet().rest_node, config=CONFIG, checkpointer=Resumed(kept.state))
    np.testing.assert_array_equal(again.curve, fitted.curve)
    for name, value in fitted.splats.to_tensors().items():
        np.testing.assert_array_equal(getattr(again.splats, name), value, err_msg=name)


def test_pixels_of_hands_and_colors_that_are_mixed_at_outlines_teach_nothing(
    fitted: FittedSplats,
) -> None:
    hand, beside = np.s_[20:40, 30:50], np.ones((3, 3), np.uint8)
    views = [MadeView(CAMERAS[0], hand), *(MadeView(camera) for camera in CAMERAS[1:])]
    green = []
    for view in views:
        whole = (view.mask(0) > 0).astype(np.uint8)
        is_outline = (view.mask(0) == 1) & (cv2.erode(whole, beside) == 0)
        view.color(0)[is_outline] = [0, 255, 0]
        green.append(is_outline.sum())
    assert np.mean(green) > 60
    found = fit_splats(views, sheet().rest_node, config=CONFIG).splats
    is_pink = (found.color[:, 0] > 0.7) & (found.color[:, 1] < 0.3) & (found.color[:, 2] > 0.7)
    assert not is_pink.any()
    assert psnr(found, UNSEEN) > psnr(fitted.splats, UNSEEN) - 0.8


def test_colors_stay_near_those_they_began_with_as_asked(views: list[View]) -> None:
    def moved(weight: float) -> float:
        config = AppearanceConfig(
            splat_count=500, iterations=20, renewal_interval=100, first_color_weight=weight
        )
        found = fit_splats(views, sheet().rest_node, config=config).splats
        return float(np.abs(found.color - start.color[: len(found.color)]).mean())

    none = AppearanceConfig(splat_count=500, iterations=0)
    start = fit_splats(views, sheet().rest_node, config=none).splats
    free = moved(0.0)
    assert free > 0.03
    assert moved(1e4) < 0.3 * free


def test_the_surface_tells_what_no_view_shows() -> None:
    from physhandi.simulation.object_surface import lay_surface

    node = sheet().rest_node.astype(np.float64)
    surface = lay_surface(node, kind="sheet")
    assert surface is not None
    # One camera sees half of the sheet, since the other half is behind a hand.
    view = MadeView(CAMERAS[0], np.s_[:, 40:])
    few = AppearanceConfig(splat_count=400, iterations=0)
    alone = fit_splats([view], node, config=few).splats.center
    whole = fit_splats([view], node, config=few, surface=surface).splats.center
    hidden = CAMERAS[0].project(node)[:, 0] > 46
    gaps = [
        np.linalg.norm(node[hidden][:, None] - center, axis=2).min(axis=1)
        for center in (alone, whole)
    ]
    assert gaps[0].max() > 0.04
    assert gaps[1].max() < 0.012


def test_views_without_the_object_and_cancels_are_told(views: list[View]) -> None:
    blind = MadeView(CAMERAS[0])
    blind.has_mask = False
    with pytest.raises(MissingInputError, match="No view with color and masks shows the object"):
        fit_splats([blind], sheet().rest_node, config=CONFIG)

    class Cancelled(Progress):
        def report(self, *report: Any, **more: Any) -> None:
            assert report[:3] == ("appearance", 1, 60)
            self.is_asked = True

        def check_cancelled(self) -> None:
            if hasattr(self, "is_asked"):
                raise CancelledError("stop")

    with pytest.raises(CancelledError):
        fit_splats(views, sheet().rest_node, config=CONFIG, progress=Cancelled())
