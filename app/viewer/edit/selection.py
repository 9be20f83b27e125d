"""Selection in a scene: nodes or springs within a shape that was drawn on the screen."""

from dataclasses import dataclass, field
from typing import Annotated, Literal, TypeVar

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int
from msgspec import Meta
from numpy import ndarray
from viser import CameraHandle
from viser.transforms import SO3

from physhandi.errors import UsageError
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.edits import NodePair
from physhandi.simulation.model import SpringMassModel
from physhandi.typed import decode_json

SelectKind = Literal["nodes", "springs", "virtual springs"]
"""Kinds of things that a shape selects."""
SelectWay = Literal["replace", "add", "remove", "toggle"]
"""Ways to combine a new selection with the one before."""
MOST_SHAPE_BYTES = 1 << 18
"""Longer messages of a page are no shapes."""
_NEAREST = 1e-6
_MOST_PAIRS = 500_000
"""Rays times triangles that are looked at in one go."""
_Item = TypeVar("_Item", int, NodePair)


@dataclass(frozen=True, kw_only=True, eq=False)
class ScreenView:
    """A camera, by which the scene is seen on a screen."""

    position: Float[ndarray, " 3"]
    """Position of the camera [m]."""
    axes: Float[ndarray, "3 3"]
    """Rows: what is right, down and ahead of it, in the world."""
    fov: float
    """Vertical field of view [rad]."""
    aspect: float
    """Width of the screen by its height."""

    @classmethod
    def of(cls, camera: CameraHandle) -> "ScreenView":
        """Read a client's camera."""
        axes = SO3(np.asarray(camera.wxyz, np.float64)).as_matrix().T
        position = np.asarray(camera.position, np.float64)
        return cls(position=position, axes=axes, fov=camera.fov, aspect=camera.aspect)

    def project(self, point: Float[ndarray, "point 3"]) -> Float[ndarray, "point 2"]:
        """Find points on the screen, whose upper left corner is (0, 0) and lower right one (1, 1).

        Returns:
            Their places; NaN for what is behind the camera.
        """
        across, down, ahead = ((np.asarray(point, np.float64) - self.position) @ self.axes.T).T
        ahead = np.where(ahead > _NEAREST, ahead, np.nan)
        half = np.tan(self.fov / 2)
        place = np.stack([across / (half * self.aspect), down / half], axis=1)
        return 0.5 + 0.5 * place / ahead[:, None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Cover:
    """A surface behind which things are not seen."""

    vertex: Float[ndarray, "vertex 3"]
    """Its vertices [m]."""
    face: Int[ndarray, "face 3"]
    """Its triangles."""
    depth: float
    """Depth behind it to which things still count as parts of it [m]."""

    def hides(
        self, eye: Float[ndarray, " 3"], point: Float[ndarray, "point 3"]
    ) -> Bool[ndarray, " point"]:
        """Mark points of which the surface keeps somebody's view.

        Möller and Trumbore's intersection of rays and triangles; as all rays have one origin, its
        triple products are matrix products.

        Args:
            eye: Where somebody stands [m].
            point: What is looked at [m].
        """
        a, b, c = np.asarray(self.vertex, np.float64)[self.face].transpose(1, 0, 2)
        one, two, from_a = b - a, c - a, eye - a
        across = np.cross(from_a, one)
        normal, first = np.cross(two, one), np.cross(two, from_a)
        height = (across * two).sum(axis=1)
        hidden = np.zeros(len(point), bool)
        rows = max(1, _MOST_PAIRS // max(1, len(self.face)))
        for start in range(0, len(point), rows):
            way = point[start : start + rows] - eye
            scale = way @ normal.T
            with np.errstate(divide="ignore", invalid="ignore"):
                u, v, part = way @ first.T / scale, way @ across.T / scale, height / scale
            nearer = 1.0 - self.depth / np.linalg.norm(way, axis=1, keepdims=True)
            is_hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (part > 0.0) & (part < nearer)
            hidden[start : start + rows] = is_hit.any(axis=1)
        return hidden


def within(
    polygon: Float[ndarray, "corner 2"], place: Float[ndarray, "point 2"]
) -> Bool[ndarray, " point"]:
    """Mark points within a closed polygon; where it crosses itself, by the even-odd rule."""
    inside = np.zeros(len(place), dtype=bool)
    x, y = place.T
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        crosses = (ay > y) != (by > y)
        with np.errstate(divide="ignore", invalid="ignore"):
            inside ^= crosses & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    return inside


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Nodes or springs, by what they mean in every topology."""

    nodes: frozenset[int] = frozenset()
    """Object nodes."""
    springs: frozenset[NodePair] = frozenset()
    """Pairs of object nodes that springs join, the lower number first."""
    virtual: frozenset[NodePair] = frozenset()
    """Object node and control node of virtual springs."""

    def __bool__(self) -> bool:
        return bool(self.nodes or self.springs or self.virtual)

    def changed(self, new: "Selection", way: SelectWay) -> "Selection":
        """Replace it by another one, add that, take it out, or add what is new and take the rest.

        Args:
            new: The other one.
            way: Which of these.
        """
        if way == "replace":
            return new
        return Selection(
            nodes=_changed(self.nodes, new.nodes, way),
            springs=_changed(self.springs, new.springs, way),
            virtual=_changed(self.virtual, new.virtual, way),
        )

    def within(self, model: SpringMassModel) -> "Selection":
        """Keep what a model has."""
        if not self:
            return self
        every = all_of(model)
        return Selection(
            nodes=self.nodes & every.nodes,
            springs=self.springs & every.springs,
            virtual=self.virtual & every.virtual,
        )

    @property
    def text(self) -> str:
        """Say how much is selected."""
        counts = (
            (len(self.nodes), "node"),
            (len(self.springs), "spring"),
            (len(self.virtual), "virtual spring"),
        )
        parts = [f"{count} {name}{'' if count == 1 else 's'}" for count, name in counts if count]
        return ", ".join(parts) or "nothing"


def of_springs(model: SpringMassModel, chosen: Int[ndarray, " spring"]) -> Selection:
    """Select springs by their places in a model's list."""
    ends = np.sort(model.spring_nodes[chosen].astype(np.int64), axis=1)
    is_own = chosen < model.object_spring_count
    virtual = ends[~is_own] - [0, model.node_count]
    return Selection(springs=_pairs(ends[is_own]), virtual=_pairs(virtual))


def all_of(model: SpringMassModel) -> Selection:
    """Select everything."""
    springs = of_springs(model, np.arange(len(model.spring_nodes)))
    every = frozenset(range(model.node_count))
    return Selection(nodes=every, springs=springs.springs, virtual=springs.virtual)


def only(selection: Selection, kind: SelectKind) -> Selection:
    """Keep one kind of what is selected."""
    if kind == "nodes":
        return Selection(nodes=selection.nodes)
    if kind == "springs":
        return Selection(springs=selection.springs)
    return Selection(virtual=selection.virtual)


def springs_between(model: SpringMassModel, nodes: frozenset[int]) -> frozenset[NodePair]:
    """Find the object springs that join two of some nodes."""
    own = model.spring_nodes[: model.object_spring_count]
    is_chosen = np.zeros(model.node_count, dtype=bool)
    is_chosen[list(nodes)] = True
    return _pairs(np.sort(own[is_chosen[own].all(axis=1)], axis=1))


def ends_of(selection: Selection) -> frozenset[int]:
    """Find the object nodes of what is selected."""
    ends = {end for pair in selection.springs for end in pair}
    return frozenset(selection.nodes | ends | {node for node, _ in selection.virtual})


def select(
    eye: ScreenView,
    shape: "Polygon | Stroke",
    rollout: ObjectRollout,
    frame: int,
    kind: SelectKind,
    *,
    cover: Cover | None = None,
) -> Selection:
    """Select what is within a shape on the screen.

    A spring is where its middle is; one that is not attached in the frame is not there.

    Args:
        eye: Who looks.
        shape: What was drawn.
        rollout: The object's motion.
        frame: Which frame of it.
        kind: What is selected.
        cover: What lies behind it is left out; None selects also behind other things.
    """
    model = rollout.model
    position = np.asarray(rollout.position[frame], np.float64)

    def held(point: Float[ndarray, "point 3"]) -> Int[ndarray, " chosen"]:
        chosen = np.flatnonzero(shape.holds(eye.project(point), eye.aspect))
        return chosen if cover is None else chosen[~cover.hides(eye.position, point[chosen])]

    if kind == "nodes":
        return Selection(nodes=frozenset(map(int, held(position))))
    point = np.concatenate([position, np.asarray(rollout.held_control(frame), np.float64)])
    own, count = model.object_spring_count, len(model.spring_nodes)
    number = np.arange(own) if kind == "springs" else np.arange(own, count)
    number = number[model.acts_in(frame)[number]]
    middle = point[model.spring_nodes[number]].mean(axis=1)
    return of_springs(model, number[held(middle)])


@dataclass(frozen=True, kw_only=True, eq=False)
class Polygon:
    """A closed line on the screen."""

    corners: Float[ndarray, "corner 2"]
    """Its corners, as `ScreenView.project` has them."""

    @classmethod
    def rectangle(cls, low: tuple[float, float], high: tuple[float, float]) -> "Polygon":
        """Give the rectangle between two corners."""
        (left, top), (right, bottom) = low, high
        corners = [[left, top], [right, top], [right, bottom], [left, bottom]]
        return cls(corners=np.array(corners, np.float64))

    def holds(self, place: Float[ndarray, "point 2"], aspect: float) -> Bool[ndarray, " point"]:
        """Mark points within it; of what is not on the screen at all, none is."""
        del aspect
        return within(self.corners, place)


@dataclass(frozen=True, kw_only=True, eq=False)
class Stroke:
    """The way of a brush over the screen."""

    points: Float[ndarray, "point 2"]
    """Its positions, as `ScreenView.project` gives them."""
    radius: float
    """Its radius, as a part of the screen's height."""

    def holds(self, place: Float[ndarray, "point 2"], aspect: float) -> Bool[ndarray, " point"]:
        """Mark points that it went over."""
        scale = np.array([aspect, 1.0])
        point, way = place * scale, self.points * scale
        start, along = way, np.diff(way, axis=0, append=way[-1:])
        held = np.zeros(len(point), dtype=bool)
        for origin, step in zip(start, along, strict=True):
            offset = point - origin
            part = np.clip(offset @ step / max(float(step @ step), 1e-18), 0.0, 1.0)
            apart = np.linalg.norm(offset - part[:, None] * step, axis=1)
            held |= apart <= self.radius
        return held


_Coordinate = Annotated[float, Meta(ge=-10.0, le=10.0)]


class DrawnShape(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A finished lasso or brush stroke, as the page reports it."""

    tool: Literal["lasso", "brush"]
    """The tool."""
    way: SelectWay
    """How it is combined with the selection before."""
    points: Annotated[
        tuple[tuple[_Coordinate, _Coordinate], ...], Meta(min_length=1, max_length=4000)
    ]
    """Positions of the pointer, as `ScreenView.project` gives them."""
    radius: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    """Of the brush, as a part of the screen's height."""

    @classmethod
    def parse(cls, text: bytes) -> "DrawnShape":
        """Read one.

        Raises:
            UsageError: If it is none; says what is wrong with it.
        """
        if len(text) > MOST_SHAPE_BYTES:
            raise UsageError(f"A shape has at most {MOST_SHAPE_BYTES} bytes, not {len(text)}.")
        try:
            return decode_json(text, cls)
        except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
            raise UsageError(f"This is no shape: {error}.") from error

    @property
    def shape(self) -> Polygon | Stroke:
        """The shape."""
        points = np.array(self.points, np.float64)
        if self.tool == "lasso":
            return Polygon(corners=points)
        return Stroke(points=points, radius=self.radius)


@dataclass(eq=False)
class Highlights:
    """Selected points and springs of a model, computed once for a selection."""

    _cached: tuple[SpringMassModel, Selection, ndarray, ndarray] | None = field(default=None)

    def of(
        self, model: SpringMassModel, selection: Selection
    ) -> tuple[Int[ndarray, " node"], Int[ndarray, " spring"]]:
        """Give the selected nodes, and the places of the selected springs in the model's list."""
        cached = self._cached
        if cached is None or cached[0] is not model or cached[1] is not selection:
            nodes = np.array(sorted(selection.nodes), np.int64)
            count = model.node_count + model.control_count
            named = [a * count + b for a, b in selection.springs]
            named += [a * count + b + model.node_count for a, b in selection.virtual]
            ends = np.sort(model.spring_nodes.astype(np.int64), axis=1)
            springs = np.flatnonzero(np.isin(ends[:, 0] * count + ends[:, 1], named))
            cached = self._cached = (model, selection, nodes, springs)
        return cached[2], cached[3]


def _changed(was: frozenset[_Item], new: frozenset[_Item], way: SelectWay) -> frozenset[_Item]:
    return was | new if way == "add" else was - new if way == "remove" else was ^ new


def _pairs(ends: Int[ndarray, "pair 2"]) -> frozenset[NodePair]:
    return frozenset((int(first), int(second)) for first, second in ends)
