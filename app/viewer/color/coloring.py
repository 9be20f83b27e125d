"""Colors of an object's nodes, surface and springs, and the range that they span."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from scipy.spatial import KDTree

from app.viewer.color.colormaps import paint_levels
from app.viewer.color.difference import surface_difference
from app.viewer.color.legend import ColorScale, Legend, Limits, nearly_all, with_width
from app.viewer.color.quantities import (
    QUANTITIES,
    Quantity,
    Values,
    for_mass,
    in_length_unit,
    measure,
)
from app.viewer.content.content import Content
from app.viewer.content.layers import COLORINGS, Coloring, Layers
from physhandi.data.object_mass import ObjectMass, given_mass
from physhandi.metrics.alignment import carried_points
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.object_surface import ObjectSurface

_SHARERS = 4
"""Tracks that tell the error of a node."""
_REACH = 3.0
"""They are not farther from it than this many typical distances between nodes."""
_MOST_POINTS = 3_000


class ObservedError:
    """Errors of nodes and of observed points, of any rollout of one content's object.

    With tracks, the error of a track is the distance to the place that the nodes around it carry
    along, as the metric ``track_error`` has it, and a node has the mean of the tracks around it.
    Without, the error of a node is the distance to the nearest observed point, and that of an
    observed point the distance to the object's surface.
    """

    def __init__(self, content: Content) -> None:
        self._content = content
        tracks, fitted = content.tracks, content.fitted
        self._tracks = tracks
        self._compared: Int[ndarray, " compared"] = np.zeros(0, np.int64)
        if tracks is None or fitted is None:
            return
        self._compared = np.flatnonzero(tracks.is_visible[0])
        start = np.asarray(fitted.position[0], dtype=np.float64)
        place = np.asarray(tracks.point[0, self._compared], dtype=np.float64)
        if len(place) == 0:
            self._tracks = None
            return
        count = min(_SHARERS, len(place))
        tree: Any = KDTree(place)
        distance, near = tree.query(start, k=count)
        self._near = np.reshape(near, (-1, count))
        self._is_near = np.reshape(distance, (-1, count)) <= _REACH * _pitch(start)

    @property
    def is_known(self) -> bool:
        """Whether there is anything to compare with."""
        return self._tracks is not None or self._content.observed is not None

    @property
    def source(self) -> str:
        """Reference of the distance."""
        if self._tracks is None:
            return "the nearest observed point"
        return self._tracks.name

    def nodes(self, rollout: ObjectRollout, frame: int) -> Float[ndarray, " node"]:
        """Measure the error of each node [m]; NaN where nothing was observed."""
        if self._tracks is None:
            return self._from_points(rollout, frame)
        error, is_seen = self.tracks(rollout, frame)
        if len(self._near) != rollout.model.node_count:
            return np.full(rollout.model.node_count, np.nan)
        counts = self._is_near & is_seen[self._near]
        total = np.where(counts, error[self._near], 0.0).sum(axis=1)
        number = counts.sum(axis=1)
        return np.where(number > 0, total / np.maximum(number, 1), np.nan)

    def tracks(
        self, rollout: ObjectRollout, frame: int
    ) -> tuple[Float[ndarray, " compared"], Bool[ndarray, " compared"]]:
        """Measure the error of each track that frame 0 shows [m], and tell whether it is seen."""
        tracks, compared = self._tracks, self._compared
        if tracks is None or frame >= len(tracks.point):
            return np.full(len(compared), np.nan), np.zeros(len(compared), dtype=bool)
        point = np.asarray(tracks.point[frame, compared], dtype=np.float64)
        is_seen = np.asarray(tracks.is_visible[frame, compared]) & np.isfinite(point).all(axis=1)
        if tracks.node is not None:
            predicted = np.asarray(rollout.position[frame], dtype=np.float64)[tracks.node[compared]]
        else:
            both = np.stack([rollout.position[0], rollout.position[frame]]).astype(np.float64)
            start = np.asarray(tracks.point[0, compared], dtype=np.float64)
            predicted = carried_points(start, both)[1]
        return np.linalg.norm(point - predicted, axis=1), is_seen

    def points(
        self, point: Float[ndarray, "point 3"], rollout: ObjectRollout, frame: int
    ) -> Float[ndarray, " point"]:
        """Measure how far observed points are from the object's surface [m]."""
        node = np.asarray(rollout.position[frame], dtype=np.float64)
        if len(point) == 0:
            return np.zeros(0)
        return surface_difference(np.asarray(point, dtype=np.float64), node)

    def _from_points(self, rollout: ObjectRollout, frame: int) -> Float[ndarray, " node"]:
        observed = self._content.observed
        point = observed.points(frame) if observed is not None else np.zeros((0, 3))
        if len(point) == 0:
            return np.full(rollout.model.node_count, np.nan)
        tree: Any = KDTree(point[:: max(1, len(point) // _MOST_POINTS)])
        distance, _ = tree.query(np.asarray(rollout.position[frame], dtype=np.float64))
        return np.asarray(distance, dtype=np.float64)


def _pitch(node: Float[ndarray, "node 3"]) -> float:
    """Measure how far a node typically is from the nearest other one [m]."""
    if len(node) < 2:
        return np.inf
    tree: Any = KDTree(node)
    return float(np.median(tree.query(node, k=2)[0][:, 1]))


_SAMPLED_FRAMES = 16


@dataclass(frozen=True, kw_only=True, eq=False)
class Painted:
    """An object's colors in one frame."""

    values: Values
    """The quantity at nodes and springs."""
    scale: ColorScale
    """The color scale."""

    @property
    def node(self) -> UInt8[ndarray, "node 3"]:
        """Colors of the nodes."""
        return self.scale.paint(self.values.node)

    @property
    def level(self) -> Float[ndarray, " node"]:
        """Places of the nodes on the scale, from 0 to 1; NaN where nothing is known."""
        return self.scale.levels(self.values.node)

    def vertices(self, surface: ObjectSurface) -> UInt8[ndarray, "vertex 3"]:
        """Give the colors of a surface that follows the nodes."""
        return paint_levels(surface.carry(self.level), self.scale.quantity.scale)

    def springs(self, chosen: slice | ndarray) -> UInt8[ndarray, "segment 2 3"]:
        """Give the colors of both ends of some springs."""
        return self.scale.paint(self.values.spring[chosen])


class Painter:
    """Paints the rollouts of one content; used by one thread.

    The range belongs to a whole rollout, not to a frame: colors keep their meaning while it plays.

    Attributes:
        reference: Rollout that ``difference`` compares with.
        errors: Distances from what was observed.
    """

    def __init__(self, content: Content) -> None:
        self.reference: ObjectRollout | None = content.fitted
        self.errors = ObservedError(content)
        self._has_object = content.fitted is not None
        self._has_hands = bool(content.hands)
        self._length_unit = content.length_unit
        self._content_mass = content.mass
        self._node_count = 1 if content.fitted is None else content.fitted.model.node_count
        self.mass: ObjectMass | None = content.mass
        """Mass of the object; None if unknown."""
        self._ranges: dict[
            tuple[Coloring, _Parts], tuple[ObjectRollout, ObjectRollout | None, int, Limits]
        ] = {}
        self._legend: Legend | None = None

    @property
    def legend(self) -> Legend | None:
        """Legend of the colors painted last; None if they are plain."""
        return self._legend

    @property
    def offered(self) -> tuple[Coloring, ...]:
        """Colorings of the content's object; none without one."""
        if not self._has_object:
            return ()
        return tuple(c for c in COLORINGS[1:] if c != "error" or self.errors.is_known)

    def quantity(self, coloring: Coloring) -> Quantity:
        """Describe a coloring in the units of the content."""
        quantity = QUANTITIES[coloring]
        if coloring == "error":
            about = f"Distance from {self.errors.source} in this frame"
            quantity = replace(quantity, about=about)
        if coloring == "force" and not self._has_hands:
            quantity = replace(
                quantity,
                about=quantity.about.replace(
                    "by which the hand holds it", "that hold it from outside"
                ),
            )
        quantity = for_mass(quantity, self.mass, self._node_count)
        return in_length_unit(quantity, self._length_unit)

    @property
    def kilograms(self) -> float:
        """Mass for which forces are written [kg]: that of the model if the object's is unknown."""
        return float(self._node_count) if self.mass is None else self.mass.kilograms

    @property
    def force_factor(self) -> float:
        """Written value of one newton of the model."""
        return 1.0 if self.mass is None else self.mass.force_factor(self._node_count)

    def weigh(self, kilograms: float | None) -> None:
        """Write forces for an object of another mass [kg]; None for what the content says."""
        mass = self._content_mass if kilograms is None else given_mass(kilograms)
        if mass != self.mass:
            self.mass = mass
            self._ranges.clear()

    def paint(self, rollout: ObjectRollout, frame: int, layers: Layers) -> Painted | None:
        """Give nodes and springs their colors; None if they are plain.

        Args:
            rollout: The rollout.
            frame: One of its frames that is ready.
            layers: Which quantity, and in which range.
        """
        if layers.color == "plain":
            self._legend = None
            return None
        quantity = self.quantity(layers.color)
        values = self.measure(layers.color, rollout, frame)
        limits = layers.color_range or self.limits(layers.color, rollout, layers)
        scale = ColorScale(quantity=quantity, limits=limits)
        shown = _shown(values, layers.color, rollout, layers)
        self._legend = Legend.of(scale, values.node, shown=shown)
        return Painted(values=values, scale=scale)

    def measure(self, coloring: Coloring, rollout: ObjectRollout, frame: int) -> Values:
        """Measure a quantity in one frame of a rollout."""
        error_of = self.errors.nodes if self.errors.is_known else None
        return measure(coloring, rollout, frame, error_of=error_of, reference=self.reference)

    def limits(
        self, coloring: Coloring, rollout: ObjectRollout, layers: Layers | None = None
    ) -> Limits:
        """Find the range of a quantity over a rollout, of those things that layers show.

        While a rollout is being computed, the range is measured anew each time that twice as many
        frames are ready.
        """
        layers = layers or Layers()
        key = coloring, _shown_parts(layers)
        cached = self._ranges.get(key)
        if cached is not None and cached[0] is rollout and cached[1] is self.reference:
            is_enough = rollout.ready == cached[2] or (
                not rollout.is_complete and rollout.ready < 2 * cached[2]
            )
            if is_enough:
                return cached[3]
        limits = self._measure_range(coloring, rollout, layers)
        self._ranges[key] = (rollout, self.reference, rollout.ready, limits)
        return limits

    def _measure_range(self, coloring: Coloring, rollout: ObjectRollout, layers: Layers) -> Limits:
        quantity = self.quantity(coloring)
        count = 1 if quantity.is_static else min(_SAMPLED_FRAMES, rollout.ready)
        frames = np.unique(np.linspace(0, rollout.ready - 1, count).astype(int))
        parts = [
            _shown(self.measure(coloring, rollout, int(frame)), coloring, rollout, layers)
            for frame in frames
        ]
        return with_width(nearly_all(np.concatenate(parts), quantity), quantity)


_Parts = tuple[bool, bool, bool]


def _shown_parts(layers: Layers) -> _Parts:
    """Tell whether nodes, object springs and virtual springs show colors."""
    has_nodes = layers.nodes or layers.surface or layers.splats
    return has_nodes, layers.object_springs, layers.virtual_springs


def _shown(
    values: Values, coloring: Coloring, rollout: ObjectRollout, layers: Layers
) -> Float[ndarray, " value"]:
    """Collect the known values of all that is shown; those of nodes if nothing is."""
    has_nodes, has_springs, has_virtual = _shown_parts(layers)
    own = rollout.model.object_spring_count
    # The virtual springs are so short that their strain would hide that of all others.
    has_virtual = has_virtual and coloring != "strain"
    parts = [values.spring[:own].mean(axis=1)] if has_springs else []
    parts += [values.spring[own:].mean(axis=1)] if has_virtual else []
    if has_nodes or not parts:
        parts.append(values.node)
    value = np.concatenate(parts)
    return value[np.isfinite(value)]
