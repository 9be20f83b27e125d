"""Fits splats to what all views show of an object in one frame.

They begin where depth was measured on the object, and on its surface where no view looks, with the
colors that are seen there. Then pictures of them are compared with each view in turn: color (mean
absolute difference and structural similarity, as Kerbl et al. (2023) mix them), what they cover
with the object's mask, and depth. Hands and what is near them are left out, since nobody knows what
is behind. At outlines, where recorded colors are mixed with those of what is behind, the mask alone
is compared. Their number stays: splats that have become invisible are moved to where the picture is
most wrong, each beside one that is there and that shares its opacity with it (S. Kheradmand et al.,
3D Gaussian Splatting as Markov Chain Monte Carlo, 2024, without their noise).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import KDTree
from torch import Tensor

from physhandi.adam import Adam
from physhandi.appearance.config import APPEARANCE, AppearanceConfig
from physhandi.appearance.differentiable import draw_splats
from physhandi.appearance.gsplat_backend import draw_splats_by_gsplat, is_installed
from physhandi.appearance.recorded import RecordedObject, cut_out_object
from physhandi.appearance.splats import Splats
from physhandi.data.checkpoint import Checkpointer, resumed_note
from physhandi.data.view import View
from physhandi.errors import MissingInputError
from physhandi.metrics.photometric import seen_colors
from physhandi.one_thread import one_thread
from physhandi.perception.lifting import OBJECT_LABEL, VOXEL, fuse, surface_points
from physhandi.progress import NullProgress, Progress
from physhandi.simulation.object_surface import ObjectSurface

_START_OPACITY = 0.6
_START_SCALE = 0.7
"""Standard deviation at first, in distances to the nearest splats."""
_INVISIBLE = 0.02
"""Splats with less opacity are moved, and left out in the end."""
_MOST_BETWEEN = 3
"""Most splats that are added at first for each place at which one was measured or laid."""
_NEIGHBORS = 24
"""Measured points around a splat through which a plane is laid."""
_SMALLEST, _LARGEST = 0.45, 4.0
"""Bounds of standard deviations, in typical distances of splats."""
_SPLIT = 0.8
"""Standard deviation of each of two splats that take the place of one, as a part of its own."""
_LAST_RENEWAL = 0.75
"""Part of the iterations after which no splat is moved any more."""
_BETAS = (0.9, 0.999)
_LAST_CENTER_STEP, _LAST_COLOR_STEP = 0.01, 0.1
_WINDOW, _SIGMA = 11, 1.5
"""Of structural similarity [px]."""
_C1, _C2 = 0.01**2, 0.03**2
"""Its constants, for values from 0 to 1."""
_SAMPLES = 4
"""Points of the object's surface that are looked at for each splat."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedSplats:
    """Result of a fit of splats."""

    splats: Splats
    """The splats."""
    curve: Float[ndarray, " iteration"]
    """Loss before each update."""


@one_thread()
def fit_splats(
    views: Sequence[View],
    node: Float[ndarray, "node 3"],
    *,
    config: AppearanceConfig,
    frame: int = 0,
    surface: ObjectSurface | None = None,
    progress: Progress | None = None,
    device: str = "cpu",
    checkpointer: Checkpointer | None = None,
) -> FittedSplats:
    """Fit splats to a frame of all views.

    Args:
        views: Those with color and masks count.
        node: The object's nodes in that frame [m].
        config: The settings.
        frame: The frame.
        surface: The object's surface, laid through these nodes, with its colors; tells what no
            view shows.
        progress: Receives a report each iteration; may cancel.
        device: Warp device.
        checkpointer: Keeps the state after an iteration; None keeps nothing.

    Returns:
        The splats, those that cover next to nothing left out, and the curve of the loss. On a CPU
        and with the built-in rasteriser the same input gives the same bits, resumed or not.

    Raises:
        MissingInputError: If no view with color and masks shows the object.
        CancelledError: If the user asked to stop.
    """
    progress, checkpointer = progress or NullProgress(), checkpointer or Checkpointer()
    progress.check_cancelled()
    recorded = cut_out_object(views, frame, hand_margin=config.hand_margin)
    target = [_Target(one, device) for one in recorded]
    start = _first_splats(views, node, frame, surface, config.splat_count)
    fit = _Fit(start, config, device)
    curve: list[float] = []
    state = checkpointer.load(APPEARANCE, fit.state(curve), growing=("curve",))
    if state is not None:
        curve = fit.restore(state.tensors)
        progress.report(
            APPEARANCE, len(curve), config.iterations, curve[-1], resumed_note(len(curve))
        )
    for iteration in range(len(curve), config.iterations):
        progress.check_cancelled()
        curve.append(fit.update(target[iteration % len(target)], iteration))
        checkpointer.offer(APPEARANCE, iteration + 1, lambda: fit.state(curve))
        progress.report(APPEARANCE, iteration + 1, config.iterations, curve[-1])
    return FittedSplats(splats=fit.splats(node), curve=np.array(curve, np.float64))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Start:
    """Splats before the fit."""

    center: Float[ndarray, "splat 3"]
    color: Float[ndarray, "splat 3"]
    scale: Float[ndarray, " splat"]
    spacing: float


def _first_splats(
    views: Sequence[View],
    node: Float[ndarray, "node 3"],
    frame: int,
    surface: ObjectSurface | None,
    count: int,
) -> _Start:
    """Place splats where the object was measured, and on its surface where it was not."""
    seen = [
        surface_points(view, view.depth(frame), view.mask(frame) == OBJECT_LABEL)
        for view in views
        if view.has_depth and view.has_mask
    ]
    solid = fuse(seen)
    measured = np.concatenate([np.zeros((0, 3)), *seen])
    if len(solid):
        measured = measured[KDTree(solid).query(measured)[0] < VOXEL]
    laid, shade = _on_surface(surface, node, _SAMPLES * count)
    center, is_laid = _thinned(measured, laid, count)
    between = _between(center, min(count - len(center), _MOST_BETWEEN * len(center)))
    is_laid = np.concatenate([is_laid, np.zeros(len(between), bool)])
    center = np.concatenate([center, between])
    center[~is_laid] = _smoothed(center[~is_laid], measured)
    if not len(center):
        center, is_laid = node[:count].astype(np.float64), np.zeros(min(count, len(node)), bool)
    color = seen_colors(views, center, frame=frame)
    if color is None:
        raise MissingInputError(
            f"No view shows any color of the object in frame {frame}: its points lie outside of "
            "the masks. Check masks and calibration."
        )
    color = color / 255.0
    if is_laid.any() and shade is not None:
        color[is_laid] = shade[KDTree(laid).query(center[is_laid])[1]]
    near = min(4, len(center))
    apart = KDTree(center).query(center, k=near)[0].reshape(len(center), near)[:, 1:]
    distance = apart.mean(axis=1) if near > 1 else np.full(len(center), VOXEL)
    spacing = float(np.median(distance))
    return _Start(
        center=center,
        color=color,
        scale=_START_SCALE * np.clip(distance, 0.5 * spacing, 2.0 * spacing),
        spacing=spacing,
    )


def _on_surface(
    surface: ObjectSurface | None, node: Float[ndarray, "node 3"], count: int
) -> tuple[Float[ndarray, "point 3"], Float[ndarray, "point 3"] | None]:
    """Give evenly spread points of a surface, and their colors if it has any."""
    if surface is None:
        return np.zeros((0, 3)), None
    vertex = surface.place(node).astype(np.float64)
    corner = vertex[surface.face]
    area = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    share = np.cumsum(area) / max(float(area.sum()), 1e-30)
    chosen = np.minimum(np.searchsorted(share, (np.arange(count) + 0.5) / count), len(area) - 1)
    a, b = _spread(count, 2).T
    over = a + b > 1.0
    a, b = np.where(over, 1.0 - a, a), np.where(over, 1.0 - b, b)
    weight = np.stack([1.0 - a - b, a, b], axis=1)
    point = np.einsum("pk,pkd->pd", weight, corner[chosen])
    if surface.color is None:
        return point, None
    shade = surface.color[surface.face[chosen]] / 255.0
    return point, np.einsum("pk,pkd->pd", weight, shade)


def _thinned(
    measured: Float[ndarray, "_ 3"], laid: Float[ndarray, "_ 3"], count: int
) -> tuple[Float[ndarray, "splat 3"], Bool[ndarray, " splat"]]:
    """Thin points to one a voxel, with voxels as small as the number of splats allows.

    Returns:
        Mean point of each voxel, and whether it was laid: only where nothing was measured.
    """
    point = np.concatenate([measured, laid])
    if not len(point):
        return point, np.zeros(0, bool)
    extent = float(np.ptp(point, axis=0).max()) + 1e-6
    low, high = 1e-3 * extent, 2.0 * extent
    for _ in range(24):
        middle = math.sqrt(low * high)
        if len(np.unique(_voxels(point, middle))) > count:
            low = middle
        else:
            high = middle
    _, owner = np.unique(_voxels(point, high), return_inverse=True)
    real = np.bincount(owner[: len(measured)], minlength=int(owner.max()) + 1)
    is_laid = real == 0
    counts = np.where(np.arange(len(point)) < len(measured), 1.0, is_laid[owner])
    total = np.stack([np.bincount(owner, weights=counts * axis) for axis in point.T], axis=1)
    return total / np.bincount(owner, weights=counts)[:, None], is_laid


def _between(point: Float[ndarray, "point 3"], count: int) -> Float[ndarray, "more 3"]:
    """Give more points between those that there are, which pixels are too coarse to show."""
    if count < 1 or len(point) < 2:
        return np.zeros((0, 3))
    chosen = np.arange(count) % len(point)
    distance = KDTree(point).query(point, k=2)[0][:, 1]
    return point[chosen] + (_spread(count, 3) - 0.5) * 2.0 * distance[chosen, None]


def _spread(count: int, size: int) -> Float[ndarray, "point axis"]:
    """Fill the unit cube evenly, always alike (M. Roberts' low-discrepancy sequence, 2018)."""
    root = 2.0
    for _ in range(32):
        root = (1.0 + root) ** (1.0 / (size + 1))
    return np.mod(np.arange(1, count + 1)[:, None] / root ** np.arange(1, size + 1), 1.0)


def _smoothed(
    point: Float[ndarray, "point 3"], measured: Float[ndarray, "_ 3"]
) -> Float[ndarray, "point 3"]:
    """Move points onto the planes through what was measured around them, since depth is noisy.

    From other sides than those of the cameras, splats at different depths would fall apart.
    """
    near = min(_NEIGHBORS, len(measured))
    if near < 4 or not len(point):
        return point
    beside = measured[KDTree(measured).query(point, k=near)[1]]
    middle = beside.mean(axis=1)
    arm = beside - middle[:, None]
    across = np.linalg.eigh(np.swapaxes(arm, 1, 2) @ arm)[1][:, :, 0]
    return point - np.sum((point - middle) * across, axis=1, keepdims=True) * across


def _voxels(point: Float[ndarray, "point 3"], edge: float) -> Int[ndarray, " point"]:
    """Number the voxel of each point."""
    place = ((point - point.min(axis=0)) / edge).astype(np.int64)
    return np.ravel_multi_index(place.T, place.max(axis=0) + 1)


class _Target:
    """What a view recorded, on a device."""

    def __init__(self, recorded: RecordedObject, device: str) -> None:
        def placed(value: ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(value)).to(device)

        self.camera = recorded.camera
        self.is_known = placed(recorded.is_known)
        self.is_unmixed = placed(recorded.is_unmixed)[..., None]
        self.color = placed(recorded.color) * self.is_known[..., None]
        self.alpha = placed(recorded.is_object).float()
        self.depth = placed(recorded.depth)
        self.has_depth = (self.depth > 0) & self.is_known
        # A mean over the object: however much black is around it, errors count alike.
        self.size = float(max(int((recorded.is_object & recorded.is_known).sum()), 1))


class _Fit:
    """Splats that are being fitted."""

    def __init__(self, start: _Start, config: AppearanceConfig, device: str) -> None:
        def leaf(value: ndarray) -> Tensor:
            return torch.tensor(value, dtype=torch.float32, device=device).requires_grad_()

        count = len(start.center)
        self._config, self._spacing = config, start.spacing
        takes_gsplat = config.rasteriser == "auto" and device != "cpu" and is_installed()
        self._draw = draw_splats_by_gsplat if takes_gsplat else draw_splats
        self.center, self.log_scale = leaf(start.center), leaf(np.log(start.scale))
        self.color = leaf(start.color)
        self._first_color = self.color.detach().clone()
        self.logit = leaf(np.full(count, math.log(_START_OPACITY / (1.0 - _START_OPACITY))))
        self._adam = {
            name: Adam(rates, betas=_BETAS)
            for name, rates in {
                "center": [(self.center, config.center_rate * start.spacing)],
                "color": [(self.color, config.color_rate)],
                "others": [
                    (self.log_scale, config.scale_rate),
                    (self.logit, config.opacity_rate),
                ],
            }.items()
        }
        self._pull = torch.zeros(count, device=device)

    def update(self, target: _Target, iteration: int) -> float:
        """Compare with a view and move the splats; return the loss."""
        for adam in self._adam.values():
            adam.zero_grad()
        loss = self._loss(target)
        loss.backward()
        done = iteration / max(self._config.iterations - 1, 1)
        self._adam["center"].step(_LAST_CENTER_STEP**done)
        self._adam["color"].step(_LAST_COLOR_STEP**done)
        self._adam["others"].step()
        with torch.no_grad():
            self._pull += _gradient(self.center).norm(dim=1)
            bounds = (math.log(size * self._spacing) for size in (_SMALLEST, _LARGEST))
            self.log_scale.clamp_(*bounds)
            self.color.clamp_(0.0, 1.0)
            if (iteration + 1) % self._config.renewal_interval == 0 and done <= _LAST_RENEWAL:
                self._renew()
        return float(loss.detach())

    def _loss(self, target: _Target) -> Tensor:
        config = self._config
        color, alpha, depth = self._draw(
            target.camera, self.center, self.log_scale, self.color, self.logit
        )
        color = torch.where(target.is_unmixed, color, target.color) * target.is_known[..., None]
        difference = (color - target.color).abs().sum() / (3.0 * target.size)
        unlike = (1.0 - _similarity(color, target.color)).sum() / (3.0 * target.size)
        loss = (1.0 - config.similarity) * difference + config.similarity * unlike
        away = (self.color - self._first_color).square().sum(dim=1).mean()
        loss = loss + config.first_color_weight * away
        cover = ((alpha - target.alpha).abs() * target.is_known).sum() / target.size
        far = ((depth - target.depth).abs() * alpha.detach() * target.has_depth).sum()
        return loss + config.alpha_weight * cover + config.depth_weight * far / target.size

    @torch.no_grad()
    def _renew(self) -> None:
        """Move splats that cover next to nothing beside those that the picture pulls most."""
        is_dead = self.logit.sigmoid() < _INVISIBLE
        dead = torch.nonzero(is_dead).flatten()
        pull = torch.where(is_dead, -1.0, self._pull)
        alive = len(pull) - len(dead)
        dead = dead[:alive]
        if len(dead):
            parent = torch.sort(pull, descending=True, stable=True).indices[: len(dead)]
            # Two in the place of one cover together what it covered.
            half = 1.0 - (1.0 - self.logit[parent].sigmoid()).sqrt()
            size = self.log_scale[parent].exp()
            way = torch.nn.functional.normalize(_gradient(self.center)[parent], dim=1)
            offset = 0.5 * size[:, None] * way
            self.center[dead] = self.center[parent] + offset
            self.center[parent] -= offset
            self.color[dead] = self.color[parent]
            self._first_color[dead] = self._first_color[parent]
            for rows in (dead, parent):
                self.log_scale[rows] = (_SPLIT * size).log()
                self.logit[rows] = half.clamp(1e-4, 1.0 - 1e-4).logit()
            for adam in self._adam.values():
                adam.forget(torch.cat([dead, parent]))
        self._pull.zero_()

    def state(self, curve: Sequence[float]) -> dict[str, ndarray]:
        """Copy everything that the next updates depend on."""
        state = {
            f"{group}.{name}": value
            for group, adam in self._adam.items()
            for name, value in adam.state().items()
        }
        return state | {
            "pull": self._pull.cpu().numpy().copy(),
            "first_color": self._first_color.cpu().numpy().copy(),
            "curve": np.array(curve, np.float64),
        }

    @torch.no_grad()
    def restore(self, state: dict[str, ndarray]) -> list[float]:
        """Return to what `state` gave; give the curve so far."""
        for group, adam in self._adam.items():
            prefix = f"{group}."
            adam.restore(
                {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
            )
        self._pull.copy_(torch.from_numpy(state["pull"]))
        self._first_color.copy_(torch.from_numpy(state["first_color"]))
        return [float(value) for value in state["curve"]]

    @torch.no_grad()
    def splats(self, node: Float[ndarray, "node 3"]) -> Splats:
        """Give the splats that cover something."""
        opacity = self.logit.sigmoid()
        is_visible = opacity >= _INVISIBLE
        values: dict[str, Any] = {
            "center": self.center,
            "scale": self.log_scale.exp(),
            "color": self.color,
            "opacity": opacity,
        }
        return Splats(
            **{name: value[is_visible].cpu().numpy() for name, value in values.items()},
            rest_node=np.asarray(node, np.float32),
        )


def _gradient(tensor: Tensor) -> Tensor:
    return torch.zeros_like(tensor) if tensor.grad is None else tensor.grad


def _similarity(
    first: Float[Tensor, "row column 3"], second: Float[Tensor, "row column 3"]
) -> Float[Tensor, "row column 3"]:
    """Compute structural similarity (SSIM) at every pixel, with zeros beyond the border."""
    axis = torch.arange(_WINDOW, device=first.device, dtype=torch.float32) - _WINDOW // 2
    kernel = torch.exp(-0.5 * (axis / _SIGMA) ** 2)
    kernel = kernel / kernel.sum()
    maps = torch.stack([first, second, first * first, second * second, first * second])
    # As channels of one image they are blurred nine times as fast as one image each.
    maps = maps.permute(0, 3, 1, 2).reshape(1, 15, *first.shape[:2])
    for shape, padding in (
        ((15, 1, 1, -1), (0, _WINDOW // 2)),
        ((15, 1, -1, 1), (_WINDOW // 2, 0)),
    ):
        one = kernel.expand(15, _WINDOW).reshape(shape)
        maps = torch.nn.functional.conv2d(maps, one, padding=padding, groups=15)
    a, b, aa, bb, ab = maps.reshape(5, 3, *first.shape[:2])
    numerator = (2 * a * b + _C1) * (2 * (ab - a * b) + _C2)
    return (numerator / ((a * a + b * b + _C1) * (aa - a * a + bb - b * b + _C2))).permute(1, 2, 0)
