"""Lays a mesh of the object onto what all views see of it in one frame.

Size, rotation and place (a similarity) are found by iterated closest points. Two things are asked
of them, because only a part of the object is seen:

* Every point of the cloud lies on the mesh, on a side that faces the camera.
* No part of the mesh lies where a view has seen that nothing is: beside the object's mask, or in
  front of the surface that its depth measured. Without that, a mesh too large, or turned so that
  its hidden side is anywhere, would fit as well.

The search starts from rotations all around, or near the one that is given; the best few are
followed to the end with ever fewer outliers allowed.
"""

from collections.abc import Sequence as Many
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from physhandi.data.camera import PinholeCamera
from physhandi.data.view import View
from physhandi.errors import FitError
from physhandi.perception.lifting import OBJECT_LABEL
from physhandi.triangles import SurfaceSamples, is_closed, sample_surface

ALIGNMENT_TOLERANCE = 0.025
"""Distance up to which cloud and mesh agree, as a share of the cloud's size."""
LEAST_ALIGNMENT_TOLERANCE = 0.004
"""The same at least [m]: the noise of depth sensors."""
LEAST_COVERAGE = 0.85
"""Part of the cloud that must agree."""
MOST_OUTSIDE = 0.08
"""Part of the mesh's surface that may lie where views see past the object."""
GIVEN_ANGLE = 25.0
"""How far a rough pose that is given may be turned wrongly [degrees]."""
_MARGIN = 2
"""Pixels by which a mask may be too small."""
_NORMAL_NEIGHBORS = 12
_DESCENTS = ((120, 250, 400, 10), (8, 1000, 1500, 15), (2, 3000, 4000, 25))
"""Starts that are followed, cloud points, mesh samples and steps, of each round."""
_WIDTHS = (0.15, 0.06, 0.025)
"""Distance at which a point counts a quarter, in sizes of the cloud, at the end of each round."""
_NORMAL_WEIGHT = (0.15, 0.1, 0.05)
"""Distance that opposite normals count as half of, in sizes of the cloud."""
_ALONG = 0.1
"""Pull along the surface, in terms of that across it."""
_SCALE_STEP = 0.1
_SAME = np.deg2rad(5.0)
"""Angle below which two poses become one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """Where a mesh lies in the world, and how well that explains what was seen."""

    scale: float
    """Metres for one unit of the mesh's file."""
    rotation: Float[ndarray, "3 3"]
    """Turns axes of the mesh into those of the world."""
    translation: Float[ndarray, " 3"]
    """Where the mesh's origin is in the world [m]."""
    residual: float = np.inf
    """Median distance from the cloud to the mesh [m]."""
    coverage: float = 0.0
    """Part of the cloud that is nearer to the mesh than `tolerance`."""
    outside: float = 1.0
    """Part of the mesh's surface that lies, by more than `tolerance`, where a view sees nothing."""
    tolerance: float = 0.0
    """Distance up to which cloud and mesh agree [m]."""

    def apply(self, point: Float[ndarray, "point 3"]) -> Float[ndarray, "point 3"]:
        """Move points of the mesh into the world [m]."""
        return self.scale * point @ self.rotation.T + self.translation

    def to_dict(self) -> dict[str, Any]:
        """Describe the alignment in plain data."""
        return {
            "scale": float(self.scale),
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
            "residual": round(self.residual, 6),
            "coverage": round(self.coverage, 4),
            "outside": round(self.outside, 4),
            "tolerance": round(self.tolerance, 6),
        }


class SeenSpace:
    """Space around an object in one frame, as all views see it."""

    def __init__(self, views: Many[View], frame: int) -> None:
        """Read masks and depth of a frame.

        Args:
            views: Views with masks.
            frame: Number of the frame.
        """
        window = np.ones((2 * _MARGIN + 1,) * 2, dtype=np.uint8)
        self._views: list[tuple[PinholeCamera, ndarray, ndarray, ndarray]] = []
        # Camera, where the object may be, depth, and depth of the object's nearest part around.
        for view in views:
            mask = view.mask(frame)
            is_covered = cv2.dilate((mask >= OBJECT_LABEL).astype(np.uint8), window) > 0
            depth = view.depth(frame) if view.has_depth else np.zeros(mask.shape, np.float32)
            # Rims of masks show what is behind the object: a nearer neighbor counts.
            nearest = cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), window)
            nearest[(mask != OBJECT_LABEL) | np.isinf(nearest)] = 0.0
            self._views.append((view.camera, is_covered, depth, nearest))

    @property
    def eyes(self) -> Float[ndarray, "view 3"]:
        """Where the cameras are [m]."""
        return np.array([camera.T_world_camera[:3, 3] for camera, *_ in self._views])

    def is_empty(
        self, point: Float[ndarray, "point 3"], tolerance: float
    ) -> Bool[ndarray, " point"]:
        """Mark points at which a view sees that the object is not.

        Args:
            point: Points in the world [m].
            tolerance: How far in front of a measured surface there may still be object [m].
        """
        empty = np.zeros(len(point), dtype=bool)
        for camera, is_covered, depth, nearest in self._views:
            pixel = np.nan_to_num(camera.project(point), nan=-1e6).round().astype(np.int64)
            inside = (pixel >= 0).all(axis=1)
            inside &= (pixel[:, 0] < camera.width) & (pixel[:, 1] < camera.height)
            column, row = pixel[inside].T
            away = camera.camera_depth(point[inside])
            measured = depth[row, column]
            is_behind = (measured > 0) & (measured < away - tolerance)
            is_before = nearest[row, column] > away + tolerance
            empty[inside] |= (~is_covered[row, column] & ~is_behind) | is_before
        return empty


def align_mesh(
    vertex: Float[ndarray, "vertex 3"],
    faces: Int[ndarray, "face 3"],
    cloud: Float[ndarray, "point 3"],
    space: SeenSpace,
    *,
    scale: float | None = None,
    start: Rotation | None = None,
    middle: Float[ndarray, " 3"] | None = None,
) -> Alignment:
    """Find size, rotation and place of a mesh.

    Args:
        vertex: Corners of the mesh, in any unit.
        faces: Its triangles, seen from outside.
        cloud: Points that views see of the object [m].
        space: What views say of the space around it.
        scale: Metres for one unit of the mesh, if known.
        start: About how the mesh is turned; None for any rotation.
        middle: About where the middle of the mesh's extent is [m]; only with `start`.

    Raises:
        FitError: If no alignment explains what was seen; tells how far the best one is from it.
    """
    search = _Search(vertex, faces, cloud.astype(np.float64), space, scale)
    fit = search.run(start, middle)
    if fit.coverage < LEAST_COVERAGE or fit.outside > MOST_OUTSIDE:
        raise FitError(
            f"The mesh does not fit to what frame 0 shows. At best {100 * fit.coverage:.0f} % of "
            f"the cloud lie within {1e3 * fit.tolerance:.0f} mm of it "
            f"({100 * LEAST_COVERAGE:.0f} % are needed; the median distance is "
            f"{1e3 * fit.residual:.1f} mm), and {100 * fit.outside:.0f} % of its surface are "
            f"where views see nothing ({100 * MOST_OUTSIDE:.0f} % are allowed). Use a mesh of the "
            "object in the shape that it has in frame 0, check the masks of that frame, or tell "
            "about how it lies (--pose) and how large it is (--scale)."
        )
    return fit


class _Search:
    """Follows starting poses to the nearest best ones."""

    def __init__(
        self,
        vertex: ndarray,
        faces: ndarray,
        cloud: ndarray,
        space: SeenSpace,
        scale: float | None,
    ) -> None:
        low, high = vertex.min(axis=0), vertex.max(axis=0)
        self._unit = float(np.linalg.norm(high - low)) or 1.0
        # Lengths of the mesh are made comparable, so that nothing depends on its unit.
        self._middle = (low + high) / 2
        self._samples = _outward(
            sample_surface((vertex - self._middle) / self._unit, faces, _DESCENTS[-1][2]),
            has_outside=is_closed(faces),
        )
        self._cloud, self._space = cloud, space
        self._scale = None if scale is None else scale * self._unit
        self._size = float(np.linalg.norm(np.ptp(np.percentile(cloud, [2, 98], axis=0), axis=0)))
        self.tolerance = max(ALIGNMENT_TOLERANCE * self._size, LEAST_ALIGNMENT_TOLERANCE)
        self._normal = _normals_towards(cloud, space.eyes)
        self._tree = KDTree(cloud)

    def run(self, start: Rotation | None, middle: ndarray | None) -> Alignment:
        """Start all around, keep the best, and tell how well the last one fits."""
        poses = [self._start(rotation, middle) for rotation in _rotations(start)]
        before = 2.0 * _WIDTHS[0]
        for level, (most, cloud_count, sample_count, steps) in enumerate(_DESCENTS):
            part = self._part(cloud_count, sample_count)
            widths = np.geomspace(before, _WIDTHS[level], steps) * self._size
            before = _WIDTHS[level]
            weight = _NORMAL_WEIGHT[level] * self._size
            poses = [self._descend(pose, part, widths, weight) for pose in poses[:most]]
            score = [self._score(pose, part, widths[-1]) for pose in poses]
            poses = _different([poses[index] for index in np.argsort(score, kind="stable")])
        return self._told(poses[0])

    def _start(self, rotation: Rotation, middle: ndarray | None) -> Alignment:
        """Lay what cameras would see of the turned mesh onto the middle of the cloud."""
        turn = rotation.as_matrix()
        point, normal = self._samples.point @ turn.T, self._samples.normal @ turn.T
        center = self._cloud.mean(axis=0)
        towards = self._space.eyes - center
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        is_seen = (normal @ towards.T > 0.1).any(axis=1)
        seen = point[is_seen] if is_seen.sum() > 10 else point
        spread = np.sqrt(((seen - seen.mean(axis=0)) ** 2).sum(axis=1).mean())
        wide = np.sqrt(((self._cloud - center) ** 2).sum(axis=1).mean())
        scale = self._scale or wide / max(float(spread), 1e-9)
        place = center - scale * seen.mean(axis=0) if middle is None else middle
        return Alignment(scale=scale, rotation=turn, translation=place)

    def _part(self, cloud_count: int, sample_count: int) -> tuple[ndarray, ndarray, SurfaceSamples]:
        random = np.random.default_rng(1)
        chosen = np.arange(len(self._cloud))
        if len(chosen) > cloud_count:
            chosen = np.sort(random.choice(chosen, cloud_count, replace=False))
        samples = self._samples
        picked = random.permutation(len(samples.point))[:sample_count]
        part = replace(samples, point=samples.point[picked], normal=samples.normal[picked])
        return self._cloud[chosen], self._normal[chosen], part

    def _descend(
        self,
        pose: Alignment,
        part: tuple[ndarray, ndarray, SurfaceSamples],
        widths: Float[ndarray, " step"],
        normal_weight: float,
    ) -> Alignment:
        cloud, cloud_normal, samples = part
        # Distances in the mesh's own unit; normals at right angles count like a distance.
        unit_weight, center = normal_weight / pose.scale, self._cloud.mean(axis=0)
        tree = KDTree(np.concatenate([samples.point, unit_weight * samples.normal], axis=1))
        for width in widths:
            back = (cloud - pose.translation) @ pose.rotation / pose.scale
            turned = unit_weight * cloud_normal @ pose.rotation
            nearest = tree.query(np.concatenate([back, turned], axis=1))[1]
            surface = pose.apply(samples.point[nearest])
            normal = samples.normal[nearest] @ pose.rotation.T
            equations = [
                _equations(
                    surface, cloud, center, width=width, share=1.0 / len(cloud), across=normal
                )
            ]
            world = pose.apply(samples.point)
            outside = world[self._space.is_empty(world, self.tolerance)]
            if len(outside):
                target = self._cloud[self._tree.query(outside)[1]]
                share = 1.0 / len(samples.point)
                equations.append(_equations(outside, target, center, width=width, share=share))
            pose = self._moved(pose, equations, center)
        return pose

    def _moved(
        self, pose: Alignment, equations: list[tuple[ndarray, ndarray]], center: ndarray
    ) -> Alignment:
        """Take one Gauss-Newton step: turn, move and grow about a center."""
        count = 7 if self._scale is None else 6
        normal = np.sum([part for part, _ in equations], axis=0)
        load = np.sum([part for _, part in equations], axis=0)
        normal += 1e-9 * np.trace(normal) * np.eye(7)
        step = np.zeros(7)
        step[:count] = np.linalg.solve(normal[:count, :count], load[:count])
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        grown = float(np.exp(np.clip(step[6], -_SCALE_STEP, _SCALE_STEP)))
        return Alignment(
            scale=pose.scale * grown,
            rotation=turn @ pose.rotation,
            translation=grown * turn @ (pose.translation - center) + center + step[3:6],
        )

    def _score(
        self, pose: Alignment, part: tuple[ndarray, ndarray, SurfaceSamples], width: float
    ) -> float:
        cloud, _, samples = part
        distance = self._distances(pose, cloud, samples)
        outside = self._outside(pose, samples)
        return float(np.minimum(distance, 2 * width).mean() + np.minimum(outside, 2 * width).mean())

    def _distances(
        self, pose: Alignment, cloud: ndarray, samples: SurfaceSamples
    ) -> Float[ndarray, " point"]:
        """Measure how far cloud points are from the mesh, across its surface if they are near."""
        world, normal = pose.apply(samples.point), samples.normal @ pose.rotation.T
        distance, nearest = KDTree(world).query(cloud)
        across = np.abs(((cloud - world[nearest]) * normal[nearest]).sum(axis=1))
        gap = 2.0 * pose.scale * np.sqrt(samples.area * len(self._samples.point) / len(world))
        return np.where(distance < gap, across, distance)

    def _outside(self, pose: Alignment, samples: SurfaceSamples) -> Float[ndarray, " sample"]:
        """Measure how far samples where nothing may be are from the cloud; others give 0."""
        world = pose.apply(samples.point)
        empty = self._space.is_empty(world, self.tolerance)
        distance = np.zeros(len(world))
        if empty.any():
            distance[empty] = self._tree.query(world[empty])[0]
        return distance

    def _told(self, pose: Alignment) -> Alignment:
        distance = self._distances(pose, self._cloud, self._samples)
        outside = self._outside(pose, self._samples)
        scale = pose.scale / self._unit
        return Alignment(
            scale=scale,
            rotation=pose.rotation,
            translation=pose.translation - scale * pose.rotation @ self._middle,
            residual=float(np.median(distance)),
            coverage=float((distance <= self.tolerance).mean()),
            outside=float((outside > self.tolerance).mean()),
            tolerance=self.tolerance,
        )


def _equations(
    point: Float[ndarray, "point 3"],
    target: Float[ndarray, "point 3"],
    center: Float[ndarray, " 3"],
    *,
    width: float,
    share: float,
    across: Float[ndarray, "point 3"] | None = None,
) -> tuple[Float[ndarray, "7 7"], Float[ndarray, " 7"]]:
    """Give the normal equations of moving points to their targets, outliers weighted down.

    Unknown are turn [rad], move [m] and growth (logarithm) about a center. The weight is Geman and
    McClure's: a quarter at `width`.

    Args:
        point: Points that move [m].
        target: Where each shall go [m].
        center: What they turn about [m].
        width: Distance at which a point counts a quarter [m].
        share: Weight of each point.
        across: Normals of the surface; along it points are pulled only by `_ALONG`.
    """
    x, y, z = (point - center).T
    slope = np.zeros((len(point), 3, 7))
    slope[:, 0, 1], slope[:, 0, 2] = z, -y
    slope[:, 1, 0], slope[:, 1, 2] = -z, x
    slope[:, 2, 0], slope[:, 2, 1] = y, -x
    slope[:, :, 3:6] = np.eye(3)
    slope[:, :, 6] = point - center
    error = target - point
    weight = share / (1.0 + (error**2).sum(axis=1) / width**2) ** 2
    along = weight if across is None else _ALONG * weight
    flat, load = slope.reshape(-1, 7), (along[:, None] * error).ravel()
    normal, load = flat.T @ (np.repeat(along, 3)[:, None] * flat), flat.T @ load
    if across is not None:
        steep = np.einsum("pi,pij->pj", across, slope)
        normal += steep.T @ (weight[:, None] * steep)
        load += steep.T @ (weight * (across * error).sum(axis=1))
    return normal, load


def _different(poses: list[Alignment]) -> list[Alignment]:
    """Keep the first of those that have come to nearly the same rotation."""
    different: list[Alignment] = []
    for pose in poses:
        turns = np.array([other.rotation.T @ pose.rotation for other in different])
        angles = Rotation.from_matrix(turns.reshape(-1, 3, 3)).magnitude()
        if (angles > _SAME).all():
            different.append(pose)
    return different


def _rotations(start: Rotation | None) -> list[Rotation]:
    """Spread starting rotations over all of them, or about a given one."""
    if start is None:
        group = Rotation.create_group("I")
        # The same group turned between its own rotations halves the gaps.
        between = Rotation.from_rotvec([0.35, 0.35, 0.35])
        return [*group, *(between * group)]
    turns = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * np.deg2rad(GIVEN_ANGLE)
    return [Rotation.from_rotvec(turn) * start for turn in turns]


def _outward(samples: SurfaceSamples, *, has_outside: bool) -> SurfaceSamples:
    """Turn normals outwards; a surface that is open has both."""
    if has_outside:
        volume = (samples.point * samples.normal).sum()
        return samples if volume >= 0 else replace(samples, normal=-samples.normal)
    return SurfaceSamples(
        point=np.concatenate([samples.point, samples.point]),
        normal=np.concatenate([samples.normal, -samples.normal]),
        area=samples.area / 2,
    )


def _normals_towards(cloud: ndarray, eyes: ndarray) -> ndarray:
    """Find the normals of a cloud that face the camera that is most in front of the surface."""
    near = KDTree(cloud).query(cloud, k=min(_NORMAL_NEIGHBORS, len(cloud)))[1]
    offset = cloud[near] - cloud[near].mean(axis=1, keepdims=True)
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))[1][:, :, 0]
    towards = eyes[None] - cloud[:, None]
    towards /= np.linalg.norm(towards, axis=2, keepdims=True)
    facing = np.einsum("nvi,ni->nv", towards, normal)
    best = np.take_along_axis(facing, np.abs(facing).argmax(axis=1)[:, None], axis=1)
    return normal * np.where(best < 0, -1.0, 1.0)
