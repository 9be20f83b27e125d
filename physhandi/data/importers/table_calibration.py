"""Poses of cameras from the pattern of the table: wood, print or cloth that several of them see.

Depth gives each camera the plane of the table to a fraction of a millimetre. Seen straight from
above, at one scale, the pictures of two cameras then differ by a turn and a shift alone, which
matching places of the pattern tell; where hands and objects are, it is left out. What is found must
rest on many places, be found in another frame again, and be the only solution: a plain table, or a
pattern that repeats, is refused. (Laying what stands on the table onto each other, with and without
color, gives wrong poses that nothing betrays: each camera sees other sides of it.)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.errors import ImportFailedError

LEAST_PLACES = 60
"""Places of the pattern that two views must share in each frame."""
LEAST_SPREAD = 0.06
"""Least standard deviation of these places along their shorter side [m]."""
MOST_RIVAL = 0.3
"""Part of these places that another solution may have: more, and the pattern repeats."""
MOST_DISAGREEMENT = (0.004, 0.3)
"""How far solutions of different frames may be apart: at the table [m], and turned [degrees]."""
_CELL = 0.7
"""Side of a pixel seen from above, in sides of a pixel of the camera at the median distance."""
_CELL_BOUNDS = (0.001, 0.004)
_MOST_CELLS = 1200
_HEIGHT = 0.008
"""Points lower than this above the table show its pattern [m]."""
_RIM = 5
_FARTHEST = 1.6
_FEATURES = 3000
_RATIO = 0.85
"""Next best match of a place must be that much worse."""
_TOLERANCE = 0.005
"""How far from its match a place may be [m]."""
_LEAST_LEG = 0.05
_HYPOTHESES = 2000
_PAIRS = 60_000
_OTHER = (0.01, np.deg2rad(2.0))
_FOLLOWED = 60


@dataclass(frozen=True, eq=False)
class TablePattern:
    """Places of the table's pattern that a view sees in a frame."""

    point: Float[ndarray, "place 2"]
    """Where they are, in table coordinates of this view [m]."""
    descriptor: Float32[ndarray, "place 128"]
    """SIFT descriptors of these places."""


@dataclass(frozen=True, eq=False)
class PatternFit:
    """How the table coordinates of one view lie in those of another one."""

    angle: float
    """Turn about the vertical [rad]."""
    shift: Float[ndarray, " 2"]
    """Shift after it [m]."""
    place_count: int
    """Places that agree."""
    rival_count: int
    """Places that agree with the next best solution."""
    spread: float
    """Standard deviation of the places along the shorter side of where they are [m]."""
    error: float
    """Root mean square of how far they are from each other [m]."""
    middle: Float[ndarray, " 2"]
    """Middle of the places [m]."""

    @property
    def transform(self) -> Float[ndarray, "4 4"]:
        """Maps table coordinates of the one view to those of the other [m]."""
        return _upright(self.angle, self.shift)


def see_pattern(
    camera: PinholeCamera,
    color: UInt8[ndarray, "row column 3"],
    depth: Float[ndarray, "row column"],
) -> TablePattern:
    """Find places of the table's pattern in what a view sees of it from above.

    Args:
        camera: The view in table coordinates: z = 0 is the table.
        color: Its picture.
        depth: Its depth [m].
    """
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixel = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    point = camera.unproject(pixel, depth.ravel().astype(np.float64))
    far = np.linalg.norm(point - camera.T_world_camera[:3, 3], axis=1)
    is_table = (np.abs(point[:, 2]) < _HEIGHT) & (depth.ravel() > 0) & (far < _FARTHEST)
    if is_table.sum() < LEAST_PLACES:
        return TablePattern(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    low, high = np.percentile(point[is_table, :2], [1, 99], axis=0)
    cell = float(np.clip(_CELL * np.median(far[is_table]) / camera.K[0, 0], *_CELL_BOUNDS))
    size = np.clip(np.ceil((high - low) / cell), 1, _MOST_CELLS).astype(int)
    to_table = np.array([[cell, 0, low[0]], [0, cell, low[1]], [0, 0, 0], [0, 0, 1]])
    to_pixel = camera.K @ camera.T_camera_world[:3] @ to_table
    shown = is_table.reshape(depth.shape).astype(np.uint8)
    window = np.ones((_RIM, _RIM), np.uint8)
    shown = cv2.erode(np.asarray(cv2.medianBlur(shown, _RIM), np.uint8), window)
    above = (int(size[0]), int(size[1]))
    picture = cv2.warpPerspective(
        color, to_pixel, above, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    )
    mask = cv2.warpPerspective(
        shown, to_pixel, above, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    )
    gray = cv2.createCLAHE(3.0, (8, 8)).apply(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
    # Without the precise upscale all places are shifted by a part of a pixel, which is 1 to 2 mm.
    finder = cv2.SIFT.create(_FEATURES, contrastThreshold=0.02, enable_precise_upscale=True)
    keypoints, descriptor = finder.detectAndCompute(gray, mask)
    if not keypoints:
        return TablePattern(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    # Hellinger's distance instead of Euclid's (Arandjelovic and Zisserman, 2012).
    shape = np.sqrt(descriptor / np.maximum(descriptor.sum(axis=1, keepdims=True), 1e-9))
    place = np.array([one.pt for one in keypoints]) * cell + low
    return TablePattern(place, shape.astype(np.float32))


def lay_patterns(
    moving: Sequence[TablePattern], fixed: Sequence[TablePattern]
) -> PatternFit | None:
    """Find the turn and shift under which most places of two views' patterns agree.

    Args:
        moving: What one view sees, frame after frame.
        fixed: What the other one sees in the same frames.

    Returns:
        The best solution; None if there are too few matches for any.
    """
    matches = [_matches(a, b) for a, b in zip(moving, fixed, strict=True)]
    source = np.concatenate([a for a, _ in matches])
    target = np.concatenate([b for _, b in matches])
    solutions = _solutions(source, target)
    if not solutions:
        return None
    angle, shift, agrees = solutions[0]
    rest = target[agrees] - source[agrees] @ _turn(angle).T - shift
    spread = np.linalg.eigvalsh(np.cov(source[agrees].T))[0]
    return PatternFit(
        angle=angle,
        shift=shift,
        place_count=int(agrees.sum()),
        rival_count=max((int(other[2].sum()) for other in solutions[1:]), default=0),
        spread=float(np.sqrt(max(spread, 0.0))),
        error=float(np.sqrt((rest**2).sum(axis=1).mean())),
        middle=source[agrees].mean(axis=0),
    )


def calibrate_by_pattern(
    names: Sequence[str], pattern: Sequence[Sequence[TablePattern]]
) -> tuple[list[Float[ndarray, "4 4"]], dict[str, dict[str, int | float]]]:
    """Find how all views' table coordinates lie in those of the first one.

    Views are joined by the pairs that share most; where there are three or more, all pairs that can
    be trusted must say the same.

    Args:
        names: Names of the views.
        pattern: What each view sees, frame after frame.

    Returns:
        Transform from each view's table coordinates to the first one's [m], and for each pair of
        views that is used the number of places, their error [m], and how far they spread [m].

    Raises:
        ImportFailedError: If a view shares too little of the pattern with all others, the pattern
            repeats, or pairs or frames contradict each other; says what was found.
    """
    fits: dict[tuple[int, int], PatternFit] = {}
    doubts: dict[tuple[int, int], str] = {}
    for a, b in combinations(range(len(names)), 2):
        fit, doubt = _trusted(pattern[b], pattern[a])
        if fit is None:
            doubts[a, b] = f"'{names[a]}' and '{names[b]}' {doubt}"
        else:
            fits[a, b] = fit
    placed: dict[int, ndarray] = {0: np.eye(4)}
    report: dict[str, dict[str, int | float]] = {}
    while len(placed) < len(names):
        ways = [(p, f) for p, f in fits.items() if (p[0] in placed) != (p[1] in placed)]
        if not ways:
            raise ImportFailedError(
                "The table's pattern does not tell where the cameras are: "
                + "; ".join(doubts.values())
                + ". Take pictures of a board (--charuco), or let all cameras see more of a table "
                "with a pattern that does not repeat, such as wood or newspaper."
            )
        (a, b), fit = max(ways, key=lambda way: way[1].place_count)
        if a in placed:
            placed[b] = placed[a] @ fit.transform
        else:
            placed[a] = placed[b] @ np.linalg.inv(fit.transform)
        report[f"{names[a]}, {names[b]}"] = {
            "places": fit.place_count,
            "error": round(float(fit.error), 5),
            "spread": round(float(fit.spread), 3),
        }
    for (a, b), fit in fits.items():
        around = np.linalg.inv(placed[a]) @ placed[b]
        turned = float(np.arctan2(around[1, 0], around[0, 0]))
        apart = _apart(fit, turned, around[:2, 3])
        if _is_more(apart, (2 * MOST_DISAGREEMENT[0], 2 * MOST_DISAGREEMENT[1])):
            raise ImportFailedError(
                f"The table's pattern says two things about views '{names[a]}' and '{names[b]}', "
                f"{1e3 * apart[0]:.0f} mm and {apart[1]:.1f} degrees apart. Was a camera or the "
                "table moved? Take pictures of a board (--charuco)."
            )
    return [placed[n] for n in range(len(names))], report


def _trusted(
    moving: Sequence[TablePattern], fixed: Sequence[TablePattern]
) -> tuple[PatternFit | None, str]:
    """Lay two views' patterns onto each other in each frame and in all; else say why not."""
    single = [lay_patterns([a], [b]) for a, b in zip(moving, fixed, strict=True)]
    counts = [0 if fit is None else fit.place_count for fit in single]
    fit = lay_patterns(moving, fixed)
    if fit is None or min(counts) < LEAST_PLACES:
        return None, f"share {min(counts)} places of it ({LEAST_PLACES} are needed)"
    if fit.spread < LEAST_SPREAD:
        return None, (
            f"share places in a strip {1e3 * fit.spread:.0f} mm wide ({1e3 * LEAST_SPREAD:.0f} mm "
            "are needed)"
        )
    for one in [*single, fit]:
        if one is not None and one.rival_count > MOST_RIVAL * one.place_count:
            return None, (
                f"fit in two ways, with {one.place_count} and {one.rival_count} places: it repeats"
            )
    for one in single:
        apart = (0.0, 0.0) if one is None else _apart(fit, one.angle, one.shift)
        if _is_more(apart, MOST_DISAGREEMENT):
            return None, (
                f"fit differently in different frames ({1e3 * apart[0]:.0f} mm and {apart[1]:.1f} "
                "degrees apart); was a camera moved?"
            )
    return fit, ""


def _is_more(apart: tuple[float, float], most: tuple[float, float]) -> bool:
    return apart[0] > most[0] or apart[1] > most[1]


def _apart(fit: PatternFit, angle: float, shift: ndarray) -> tuple[float, float]:
    """Tell how far another solution is, at the places [m] and turned [degrees]."""
    moved = _turn(fit.angle) @ fit.middle + fit.shift - _turn(angle) @ fit.middle - shift
    return float(np.linalg.norm(moved)), float(np.rad2deg(abs(_between(fit.angle, angle))))


def _turn(angle: float) -> Float[ndarray, "2 2"]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def _upright(angle: float, shift: ndarray) -> Float[ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:2, :2], pose[:2, 3] = _turn(angle), shift
    return pose


def _between(first: float, second: float) -> float:
    return float((first - second + np.pi) % (2 * np.pi) - np.pi)


def _matches(
    moving: TablePattern, fixed: TablePattern
) -> tuple[Float[ndarray, "match 2"], Float[ndarray, "match 2"]]:
    """Pair places that are most alike, both ways, and much more than any other."""
    if min(len(moving.point), len(fixed.point)) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    # Vectors of length one: the nearer, the larger their product.
    alike = moving.descriptor @ fixed.descriptor.T
    best = alike.argmax(axis=1)
    row = np.arange(len(alike))
    first = alike[row, best]
    second = np.partition(alike, -2, axis=1)[:, -2]
    is_clear = (2.0 - 2.0 * first) < _RATIO**2 * (2.0 - 2.0 * second)
    is_mutual = alike.argmax(axis=0)[best] == row
    is_match = is_clear & is_mutual
    return moving.point[is_match], fixed.point[best[is_match]]


def _solutions(
    source: Float[ndarray, "match 2"], target: Float[ndarray, "match 2"]
) -> list[tuple[float, Float[ndarray, " 2"], Bool[ndarray, " match"]]]:
    """Find the best turn and shift by RANSAC over pairs of matches, and the best other one."""
    if len(source) < 3:
        return []
    random = np.random.default_rng(0)
    i, j = np.triu_indices(len(source), 1)
    if len(i) > _PAIRS:
        chosen = random.choice(len(i), _PAIRS, replace=False)
        i, j = i[chosen], j[chosen]
    leg, other = source[j] - source[i], target[j] - target[i]
    length, far = np.linalg.norm(leg, axis=1), np.linalg.norm(other, axis=1)
    fits = np.flatnonzero((length > _LEAST_LEG) & (np.abs(length - far) < 2 * _TOLERANCE))
    fits = random.permutation(fits)[:_HYPOTHESES]
    cross = leg[:, 0] * other[:, 1] - leg[:, 1] * other[:, 0]
    angles = np.arctan2(cross, (leg * other).sum(axis=1))[fits]
    cos, sin, (x, y) = np.cos(angles)[:, None], np.sin(angles)[:, None], source.T
    turned = cos * x - sin * y, sin * x + cos * y
    base, row = i[fits], np.arange(len(fits))
    shift = [target[base, k] - turned[k][row, base] for k in (0, 1)]
    rest = [target[:, k] - turned[k] - shift[k][:, None] for k in (0, 1)]
    count = (rest[0] ** 2 + rest[1] ** 2 < _TOLERANCE**2).sum(axis=1)
    middle = source.mean(axis=0)
    place_of = np.stack([(turned[k] + shift[k][:, None]).mean(axis=1) for k in (0, 1)], axis=1)
    solutions: list[tuple[float, ndarray, ndarray]] = []
    is_left = np.ones(len(fits), dtype=bool)
    for _ in range(_FOLLOWED):
        if not is_left.any() or len(solutions) == 2:
            break
        n = int(np.where(is_left, count, -1).argmax())
        is_left[n] = False
        one = _improved(source, target, float(angles[n]), np.array([part[n] for part in shift]))
        if one is None:
            continue
        place = _turn(one[0]) @ middle + one[1]
        if all(_is_other(one, other, middle) for other in solutions):
            solutions.append(one)
        # What lies beside it would only lead to it again.
        turn = np.abs((angles - one[0] + np.pi) % (2 * np.pi) - np.pi)
        is_beside = (np.linalg.norm(place_of - place, axis=1) < _OTHER[0]) & (turn < _OTHER[1])
        is_left &= ~is_beside
    return sorted(solutions, key=lambda one: -int(one[2].sum()))


def _is_other(
    one: tuple[float, ndarray, ndarray], other: tuple[float, ndarray, ndarray], middle: ndarray
) -> bool:
    """Whether two solutions differ by more than noise."""
    apart = _turn(one[0]) @ middle + one[1] - _turn(other[0]) @ middle - other[1]
    is_turned = abs(_between(one[0], other[0])) > _OTHER[1]
    return bool(np.linalg.norm(apart) > _OTHER[0] or is_turned)


def _agrees(
    source: ndarray, target: ndarray, angle: float, shift: ndarray
) -> Bool[ndarray, " match"]:
    rest = target - source @ _turn(angle).T - shift
    return (rest**2).sum(axis=1) < _TOLERANCE**2


def _improved(
    source: ndarray, target: ndarray, angle: float, shift: ndarray
) -> tuple[float, ndarray, ndarray] | None:
    """Fit turn and shift to all matches that agree, until they stay the same."""
    agrees = _agrees(source, target, angle, shift)
    for _ in range(5):
        if agrees.sum() < 3:
            return None
        a, b = source[agrees], target[agrees]
        left, right = a - a.mean(axis=0), b - b.mean(axis=0)
        cross = (left[:, 0] * right[:, 1] - left[:, 1] * right[:, 0]).sum()
        angle = float(np.arctan2(cross, (left * right).sum()))
        shift = b.mean(axis=0) - _turn(angle) @ a.mean(axis=0)
        agrees = _agrees(source, target, angle, shift)
    return (angle, shift, agrees) if agrees.sum() >= 3 else None
