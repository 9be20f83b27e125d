"""Benchmark of splats: pictures and a fit, beside a loop over splats in NumPy in the same run.

The scene is made: a ball of textured splats before cameras on a circle, of which the fit sees
pictures. The baseline draws what `physhandi.appearance.rasterise` draws, splat by splat with NumPy
over the pixels that each reaches.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float, UInt8
from numpy import ndarray

from physhandi.appearance.config import AppearanceConfig
from physhandi.appearance.fit import fit_splats
from physhandi.appearance.rasterise import render_splats
from physhandi.appearance.splats import Splats
from physhandi.benchmarks.timing import describe_machine, time_in_turns
from physhandi.data.camera import PinholeCamera
from physhandi.data.view import View
from physhandi.devices import start_warp

SCENES = {"5k at 424x240": (5_000, 424, 240), "20k at 848x480": (20_000, 848, 480)}
"""Splats and size of the pictures of each scene."""
_RADIUS, _AWAY = 0.12, 0.55
_ROUNDS = 5
_VIEWS = 3
_PARTS_OF_A_CIRCLE = 4


def benchmark_splats(
    *, device: str = "cpu", iterations: int | None = None, scenes: tuple[str, ...] = ()
) -> dict[str, Any]:
    """Time pictures of splats, and fits of as many to three views.

    Args:
        device: Warp device.
        iterations: Updates of a fit; none takes those of a default fit.
        scenes: Some of `SCENES`; none takes all.

    Returns:
        For each scene pictures a second of ours and of the baseline, the largest difference between
        them, the seconds of a fit and what it reached in a view that it did not see.
    """
    start_warp()
    results = {
        name: _measure(*SCENES[name], device=device, iterations=iterations)
        for name in scenes or SCENES
    }
    return {"benchmark": "splats", **describe_machine(device), "scenes": results}


def _measure(
    count: int, width: int, height: int, *, device: str, iterations: int | None
) -> dict[str, Any]:
    cameras = [_camera(part, width, height) for part in range(_PARTS_OF_A_CIRCLE)]
    *seen, unseen = cameras
    splats = _ball(count)
    pictures: dict[str, Any] = {}

    def drawing(name: str, draw: Callable[[], ndarray]) -> Callable[[], None]:
        def work() -> None:
            pictures[name] = draw()

        return work

    works = {
        "ours": drawing("ours", lambda: render_splats(unseen, splats, device=device).color),
        "baseline": drawing("baseline", lambda: draw_one_by_one(unseen, splats)),
    }
    times = time_in_turns(works, device, _ROUNDS)
    difference = np.abs(pictures["ours"] - pictures["baseline"])

    config = AppearanceConfig(splat_count=count)
    if iterations is not None:
        config = AppearanceConfig(splat_count=count, iterations=iterations)
    views = [_FilmedView(camera, splats, device) for camera in seen]
    begin = time.perf_counter()
    fitted = fit_splats(views, splats.rest_node, config=config, device=device).splats
    wp.synchronize_device(device)
    seconds = time.perf_counter() - begin
    true, again = (render_splats(unseen, one, device=device) for one in (splats, fitted))
    is_object = true.alpha > 0.5
    error = float(np.mean((true.color - again.color)[is_object] ** 2))
    return {
        "splats": count,
        "width": width,
        "height": height,
        "pictures_per_s": 1.0 / times["ours"],
        "baseline_pictures_per_s": 1.0 / times["baseline"],
        "speedup": times["baseline"] / times["ours"],
        "max_abs_difference": float(difference.max()),
        "mean_abs_difference": float(difference.mean()),
        "fit_iterations": config.iterations,
        "fit_s": seconds,
        "fit_ms_per_iteration": 1e3 * seconds / max(config.iterations, 1),
        "unseen_psnr_db": -10.0 * float(np.log10(max(error, 1e-10))),
    }


def _camera(part: int, width: int, height: int) -> PinholeCamera:
    """Place a camera on a circle around the ball, looking at it from a little above."""
    angle = 0.5 * part
    forward = np.array([-np.cos(angle), -np.sin(angle), -0.4])
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = -_AWAY * forward
    focal = 0.8 * width
    K = np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
    return PinholeCamera(K=K, T_world_camera=pose, width=width, height=height)


def _ball(count: int) -> Splats:
    """Spread splats over a sphere along a spiral, with a checkered texture."""
    number = np.arange(count)
    z = 1.0 - (2.0 * number + 1.0) / count
    angle = number * np.pi * (3.0 - np.sqrt(5.0))
    across = np.sqrt(1.0 - z * z)
    place = np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
    is_light = (np.sin(9.0 * place).prod(axis=1) > 0.0)[:, None]
    return Splats(
        center=(_RADIUS * place).astype(np.float32),
        scale=np.full(count, 0.7 * _RADIUS * np.sqrt(4.0 * np.pi / count), np.float32),
        color=np.where(is_light, [0.9, 0.75, 0.3], [0.15, 0.3, 0.6]).astype(np.float32),
        opacity=np.full(count, 0.9, np.float32),
        rest_node=(_RADIUS * place[:: max(count // 200, 1)]).astype(np.float32),
    )


class _FilmedView(View):
    """What a camera would have recorded of splats."""

    def __init__(self, camera: PinholeCamera, splats: Splats, device: str) -> None:
        super().__init__(Path("made/views/camera"), "made", camera, 1)
        self.has_color = self.has_depth = self.has_mask = True
        image = render_splats(camera, splats, device=device)
        self._mask = (image.alpha > 0.5).astype(np.uint8)
        self._color = (255.0 * image.color + 0.5).astype(np.uint8)
        self._depth = np.where(self._mask > 0, image.depth, np.float32(0.0))

    def color(self, frame: int) -> UInt8[ndarray, "row column 3"]:
        del frame
        return self._color

    def mask(self, frame: int) -> UInt8[ndarray, "row column"]:
        del frame
        return self._mask

    def depth(self, frame: int) -> Float[ndarray, "row column"]:
        del frame
        return self._depth


def draw_one_by_one(camera: PinholeCamera, splats: Splats) -> Float[ndarray, "row column 3"]:
    """Draw splats over black in float64 with NumPy, each over the pixels that it reaches."""
    size = (camera.height, camera.width)
    light, total = np.ones(size), np.zeros((*size, 3))
    place = camera.to_camera(splats.center.astype(np.float64))
    for splat in np.argsort(place[:, 2], kind="stable"):
        x, y, z = place[splat]
        opacity = float(splats.opacity[splat])
        if z <= 0.01 or opacity <= 1.0 / 255.0:
            continue
        K = camera.K
        middle = K[:2, :2] @ [x / z, y / z] + K[:2, 2]
        slope = K[:2, :2] @ [[1.0, 0.0, -x / z], [0.0, 1.0, -y / z]] / z
        spread = float(splats.scale[splat]) ** 2 * slope @ slope.T + 0.3 * np.eye(2)
        reach = np.sqrt(2.0 * np.log(255.0 * opacity) * np.diag(spread))
        low = np.maximum(np.ceil(middle - reach), 0).astype(int)
        high = np.minimum(np.floor(middle + reach) + 1, size[::-1]).astype(int)
        if (low >= high).any():
            continue
        part = np.s_[low[1] : high[1], low[0] : high[0]]
        right, down = np.meshgrid(
            np.arange(low[0], high[0]) - middle[0], np.arange(low[1], high[1]) - middle[1]
        )
        (a, b), (_, c) = np.linalg.inv(spread)
        squared = a * right**2 + 2.0 * b * right * down + c * down**2
        cover = np.minimum(opacity * np.exp(-0.5 * squared), 0.999)
        rest = light[part] * (1.0 - cover)
        counts = (cover >= 1.0 / 255.0) & (rest > 1e-4)
        share = np.where(counts, light[part] * cover, 0.0)
        total[part] += share[..., None] * splats.color[splat]
        light[part] = np.where(counts, rest, light[part])
    return total
