"""Readings of one thing in the scene."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from app.viewer.color.coloring import Painter
from app.viewer.color.hand_coloring import HandPainter
from app.viewer.color.legend import number
from app.viewer.content.content import Content, ShownHand
from app.viewer.content.layers import Coloring
from app.viewer.inspect.picking import Pick, PickKind
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.contact_intervals import NEVER
from physhandi.simulation.forces import spring_tensions, virtual_spring_forces
from physhandi.simulation.model import SpringMassModel

HistoryQuantity = Literal[
    "speed", "force", "mean force", "strain", "error", "difference", "height", "length"
]
"""Quantities that a chart can show of a thing."""
HISTORIES: dict[PickKind, tuple[HistoryQuantity, ...]] = {
    "node": ("speed", "force", "mean force", "strain", "error", "difference", "height"),
    "spring": ("strain", "force", "mean force", "length"),
    "control": ("speed", "force", "mean force", "height"),
    "hand": ("speed", "height"),
    "marker": ("speed", "height"),
}
"""Quantities that a chart can show, by kind of thing."""


def follow(
    pick: Pick,
    kind: HistoryQuantity,
    rollout: ObjectRollout | None,
    content: Content,
    painter: Painter,
) -> Float[ndarray, " frame"]:
    """Follow one value of a thing over the frames that are ready, in SI units.

    What is averaged between frames is simulated once more, so it is not known before all are ready.

    Args:
        pick: The thing.
        kind: One of its `HISTORIES`.
        rollout: The rollout; None without an object.
        content: Hands and control nodes.
        painter: Measures what colors tell as well.
    """
    if pick.kind in {"hand", "marker"} or rollout is None:
        return _of_track(track_of(pick, content), kind, content.frame_rate)
    if kind == "height":
        of = rollout.position if pick.kind == "node" else rollout.control
        return np.asarray(of[: rollout.ready, pick.index, 2], dtype=np.float64)
    if kind == "length":
        first, second = rollout.model.spring_nodes[pick.index]
        point = np.concatenate(
            [rollout.position[: rollout.ready], rollout.control[: rollout.ready]], axis=1
        )
        return np.linalg.norm(point[:, second] - point[:, first], axis=-1).astype(np.float64)
    if kind == "mean force":
        return _mean_force(rollout, pick)
    part = reduced(rollout, pick)
    if pick.kind == "control":
        return np.array(
            [_of_control(pick.index, kind, part, frame) for frame in range(rollout.ready)]
        )
    values = [painter.measure(kind, part, frame) for frame in range(rollout.ready)]
    is_spring = pick.kind == "spring"
    return np.array(
        [float(v.spring[0].mean() if is_spring else v.node[pick.index]) for v in values]
    )


def unit_of(kind: HistoryQuantity, content: Content, painter: Painter) -> tuple[str, float]:
    """Tell the unit in which a history is written, and its number in one SI unit."""
    if kind == "height" or kind == "length":  # noqa: PLR1714  # narrows the type
        return length_unit(content)
    quantity = painter.quantity("force" if kind == "mean force" else kind)
    return quantity.unit, quantity.factor


def length_unit(content: Content) -> tuple[str, float]:
    """Tell the unit of small lengths, and its number in one unit of the content."""
    return ("mm", 1e3) if content.is_metric else (content.length_unit, 1.0)


def track_of(pick: Pick, content: Content) -> Float[ndarray, "frame 3"]:
    """Find where a vertex of a hand, or a control node without an object, is in every frame [m]."""
    if pick.kind == "control" and content.control is not None:
        return np.asarray(content.control[:, pick.index], dtype=np.float64)
    if pick.kind == "marker" and content.markers is not None:
        return np.asarray(content.markers.point[:, pick.index], dtype=np.float64)
    hand = next(hand for hand in content.hands if hand.side == pick.side)
    return np.asarray(hand.vertex[:, pick.index], dtype=np.float64)


def springs_at(rollout: ObjectRollout, point: int) -> Int[ndarray, " spring"]:
    """Find the springs that end at an object node, or at a control node counted after them."""
    return np.flatnonzero((rollout.model.spring_nodes == point).any(axis=1))


def virtual_springs_at(rollout: ObjectRollout, point: int, frame: int) -> Int[ndarray, " spring"]:
    """Find the virtual springs that end there and are attached in a frame."""
    joined = springs_at(rollout, point)
    acts = rollout.model.acts_in(frame)
    return joined[(joined >= rollout.model.object_spring_count) & acts[joined]]


def reduced(rollout: ObjectRollout, pick: Pick) -> ObjectRollout:
    """Keep only what matters to a thing, so that all its frames are read quickly."""
    smaller = _with_springs(rollout.model, _springs_of(rollout, pick))
    if pick.kind != "node":
        smaller = replace(smaller, hand_face=smaller.hand_face[:0])
    return replace(rollout, model=smaller, hand_shift=rollout.shift_of_hands())


def _springs_of(rollout: ObjectRollout, pick: Pick) -> Int[ndarray, " spring"]:
    if pick.kind == "spring":
        return np.array([pick.index])
    before = rollout.model.node_count if pick.kind == "control" else 0
    return springs_at(rollout, pick.index + before)


def _with_springs(model: SpringMassModel, chosen: Int[ndarray, " spring"]) -> SpringMassModel:
    """Leave out all springs but some."""
    return replace(
        model,
        spring_nodes=model.spring_nodes[chosen],
        rest_length=model.rest_length[chosen],
        stiffness=model.stiffness[chosen],
        damping=model.damping[chosen],
        object_spring_count=int((chosen < model.object_spring_count).sum()),
        attached=model.attached[
            chosen[chosen >= model.object_spring_count] - model.object_spring_count
        ],
    )


def _mean_force(rollout: ObjectRollout, pick: Pick) -> Float[ndarray, " frame"]:
    """Average the pull of a spring, or the force on a node or control node, between frames [N]."""
    if not rollout.is_complete:
        return np.full(rollout.ready, np.nan)
    if pick.kind == "node" and rollout.is_pushed:
        return np.linalg.norm(rollout.mean_forces()[:, pick.index], axis=1)
    chosen = _springs_of(rollout, pick)

    def measure(model: SpringMassModel, *state: Any) -> ndarray:
        part = _with_springs(model, chosen)
        if pick.kind == "spring":
            return spring_tensions(part, *state)
        return virtual_spring_forces(part, *state).sum(axis=0)

    return np.linalg.norm(rollout.frame_means(measure), axis=1)


def _of_track(
    track: Float[ndarray, "frame 3"], kind: HistoryQuantity, frame_rate: float
) -> Float[ndarray, " frame"]:
    if kind == "height":
        return track[:, 2]
    return frame_rate * np.linalg.norm(np.diff(track, axis=0, prepend=track[:1]), axis=1)


def _of_control(control: int, kind: HistoryQuantity, part: ObjectRollout, frame: int) -> float:
    value = part.state(frame)[3][control] if kind == "speed" else part.spring_forces(frame).sum(0)
    return float(np.linalg.norm(value))


def _restart_rows(rollout: ObjectRollout, frame: int) -> "Rows":
    """Say from where a predicted frame was simulated, if that is not the rollout's own state."""
    restart = rollout.restart
    if restart is None or frame <= restart.frame:
        return []
    rows = [("predicted from", f"the observed state at frame {restart.frame}")]
    if restart.friction_share < 1.0:
        rows.append(("friction", f"{100 * restart.friction_share:.2g} % of the fitted one is left"))
    return rows


def _attached_rows(model: SpringMassModel, spring: int) -> "Rows":
    """Say in which frames a virtual spring is attached, if not in all."""
    if spring < model.object_spring_count:
        return []
    first, last = model.attached[spring - model.object_spring_count].tolist()
    if (first, last) == (0, NEVER):
        return []
    return [("attached", f"from frame {first}" + ("" if last == NEVER else f" to {last}"))]


@dataclass(frozen=True, kw_only=True, eq=False)
class HandLoad:
    """Action of a hand on the object in one frame."""

    touched: int
    """Object nodes that it holds or pushes."""
    force: Float[ndarray, " 3"]
    """Sum of its forces [N]."""
    strongest: float
    """Largest force on one node [N]."""
    moment: Float[ndarray, " 3"]
    """Sum of its forces' moments about a point of the hand [N·m]."""


def hand_load(
    force: Float[ndarray, "force 3"],
    *,
    node: Int[ndarray, " force"],
    position: Float[ndarray, "node 3"],
    about: Float[ndarray, " 3"],
) -> HandLoad:
    """Sum up the forces of virtual springs, or of a hand's surface, on object nodes.

    Args:
        force: Each of them [N].
        node: Node on which each acts.
        position: Object nodes [m].
        about: Point that moments are about [m].
    """
    touched, at = np.unique(node, return_inverse=True)
    of_node = np.zeros((len(touched), 3))
    np.add.at(of_node, at, force)
    is_touched = np.linalg.norm(of_node, axis=1) > 0.0
    arm = position[touched] - about
    return HandLoad(
        touched=int(is_touched.sum()),
        force=of_node.sum(axis=0),
        strongest=float(np.linalg.norm(of_node, axis=1).max(initial=0.0)),
        moment=np.cross(arm, of_node).sum(axis=0).reshape(3),
    )


_NAMED = 3
Rows = list[tuple[str, str]]


class Readings:
    """Reads values from rollouts and hands of one content."""

    def __init__(self, content: Content, painter: Painter) -> None:
        self._content = content
        self._painter = painter
        self._unit = "m" if content.is_metric else content.length_unit
        self._units = self._unit if content.is_metric else f"{self._unit}s"
        self._hands = HandPainter(content)

    def settle(self, pick: Pick) -> Pick:
        """Take a hand's vertex for the control node that it is, if it is one."""
        first = self._first_control(pick.side) if pick.kind == "hand" else None
        return pick if first is None else Pick(kind="control", index=first + pick.index)

    def title(self, pick: Pick, rollout: ObjectRollout | None) -> str:
        """Name a thing."""
        if pick.kind == "spring" and rollout is not None:
            is_own = pick.index < rollout.model.object_spring_count
            return f"{'object' if is_own else 'virtual'} spring {pick.index}"
        if pick.kind == "marker":
            return f"marker {pick.index}"
        if pick.kind == "hand":
            return f"{pick.side} hand, vertex {pick.index}"
        if pick.kind == "control":
            return self._name_of_control(pick)
        return f"object node {pick.index}"

    def _name_of_control(self, pick: Pick) -> str:
        for hand in self._content.hands:
            first = self._first_control(hand.side)
            if first is not None and 0 <= pick.index - first < hand.vertex.shape[1]:
                vertex = pick.index - first
                return f"control node {pick.index} ({hand.side} hand, vertex {vertex})"
        markers = self._content.markers
        if markers is not None and pick.index < len(markers.held):
            return f"gripper, marker {markers.held[pick.index]}"
        return f"control node {pick.index}"

    def exists(self, pick: Pick, rollout: ObjectRollout | None) -> bool:
        """Tell whether a thing is there still, when the springs may be others."""
        if pick.kind == "hand":
            return True
        if pick.kind == "marker":
            return self._content.markers is not None
        if rollout is None:
            return pick.kind == "control"
        model = rollout.model
        count = {
            "node": model.node_count,
            "spring": len(model.spring_nodes),
            "control": model.control_count,
        }
        return pick.index < count.get(pick.kind, 0)

    def place(
        self, pick: Pick, rollout: ObjectRollout | None, frame: int, rollout_frame: int
    ) -> Float[ndarray, "end 3"]:
        """Find where a thing is: one point, or both ends of a spring [m]."""
        if pick.kind in {"hand", "marker"}:
            return track_of(pick, self._content)[[min(frame, self._content.frame_count - 1)]]
        if rollout is None:
            control = self._content.control
            return np.zeros((0, 3)) if control is None else np.asarray(control[frame])[[pick.index]]
        point = np.concatenate([rollout.position[rollout_frame], rollout.control[rollout_frame]])
        if pick.kind == "spring":
            return point[rollout.model.spring_nodes[pick.index]]
        offset = rollout.model.node_count if pick.kind == "control" else 0
        return point[[pick.index + offset]]

    def links(
        self, pick: Pick, rollout: ObjectRollout | None, rollout_frame: int
    ) -> Float[ndarray, "segment 2 3"]:
        """Find the spring itself, or the virtual springs that end at a thing [m]."""
        if rollout is None or pick.kind in {"hand", "marker"}:
            return np.zeros((0, 2, 3), np.float32)
        point = np.concatenate([rollout.position[rollout_frame], rollout.control[rollout_frame]])
        if pick.kind == "spring":
            return point[rollout.model.spring_nodes[[pick.index]]]
        offset = rollout.model.node_count if pick.kind == "control" else 0
        held = virtual_springs_at(rollout, pick.index + offset, rollout_frame)
        return point[rollout.model.spring_nodes[held]]

    def rows(
        self, pick: Pick, rollout: ObjectRollout | None, frame: int, rollout_frame: int
    ) -> Rows:
        """List names and values of everything that is known of a thing now."""
        place = self.place(pick, rollout, frame, rollout_frame)
        if pick.kind in {"hand", "marker"} or rollout is None:
            where = [("position", self._vector(place[0], self._units))] if len(place) else []
            return where + self._recorded_rows(pick, frame)
        if pick.kind == "spring":
            return [
                *self._spring_rows(pick.index, rollout, rollout_frame),
                *_restart_rows(rollout, rollout_frame),
            ]
        rows = [("position", self._vector(place[0], self._unit))]
        node_velocity, control_velocity = (rollout.state(rollout_frame)[i] for i in (1, 3))
        velocity = (node_velocity if pick.kind == "node" else control_velocity)[pick.index]
        rows.append(("velocity", self._vector(velocity, f"{self._unit}/s", size=True)))
        own = rollout.model.object_spring_count
        offset = rollout.model.node_count if pick.kind == "control" else 0
        joined = springs_at(rollout, pick.index + offset)
        held = virtual_springs_at(rollout, pick.index + offset, rollout_frame)
        force = rollout.spring_forces(rollout_frame)[held - own].sum(axis=0)
        newtons = self._painter.force_factor
        if pick.kind == "node":
            if rollout.is_pushed:
                force = force + rollout.pushes(rollout_frame)[1][pick.index]
            rows.append(
                (
                    f"force of the {'hand' if self._content.hands else 'controls'}",
                    self._vector(newtons * force, "N", size=True),
                )
            )
            rows += self._node_rows(pick.index, rollout, rollout_frame, int((joined < own).sum()))
            rows.append(("held by", self._partners(rollout, rollout_frame, held, is_control=True)))
            rows += _restart_rows(rollout, rollout_frame)
        else:
            rows.append(("force on the object", self._vector(newtons * force, "N", size=True)))
            rows.append(("holds", self._partners(rollout, rollout_frame, held, is_control=False)))
            rows += self._hand_rows(pick.index, rollout, rollout_frame)
        return rows

    def _hand_rows(self, control: int, rollout: ObjectRollout, frame: int) -> Rows:
        """Sum up what the whole hand of a control node does to the object."""
        hand = next((h for h in self._content.hands if control in self._controls_of(h)), None)
        if hand is None:
            return []
        controls = self._controls_of(hand)
        model = rollout.model
        ends = model.spring_nodes[model.object_spring_count :]
        is_own = np.isin(ends.max(axis=1) - model.node_count, controls)
        force, node = rollout.spring_forces(frame)[is_own], ends[is_own].min(axis=1)
        verb = "holds"
        if rollout.is_pushed:
            face, push = rollout.pushes(frame)
            pushed = np.flatnonzero((face >= 0) & np.isin(model.hand_face[face, 0], controls))
            force, node = np.concatenate([force, push[pushed]]), np.concatenate([node, pushed])
            verb = "holds and pushes"
        load = hand_load(
            self._painter.force_factor * force,
            node=node,
            position=np.asarray(rollout.position[frame], dtype=np.float64),
            about=np.asarray(rollout.held_control(frame)[controls].mean(axis=0), np.float64),
        )
        unit, factor = length_unit(self._content)
        return [
            (f"{hand.side} hand", f"{verb} {load.touched} nodes"),
            ("its force", self._vector(load.force, "N", size=True)),
            ("its strongest", f"{number(load.strongest)} N on a node"),
            ("its moment", self._vector(factor * load.moment, f"N·{unit}", size=True)),
        ]

    def _controls_of(self, hand: ShownHand) -> range:
        """Number the control nodes that are a hand's vertices; none if controls are others."""
        first = self._first_control(hand.side)
        return range(0) if first is None else range(first, first + hand.vertex.shape[1])

    def _recorded_rows(self, pick: Pick, frame: int) -> Rows:
        """Read what needs no simulation: speeds, lengths to neighbors, errors in the images."""
        track = track_of(pick, self._content)
        at = min(frame, len(track) - 1)
        speed = self._content.frame_rate * np.linalg.norm(track[at] - track[max(at - 1, 0)])
        rows: Rows = [("speed", f"{number(float(speed))} {self._unit}/s")]
        hand = next((h for h in self._content.hands if h.side == pick.side), None)
        if hand is not None:
            error = float(self._hands.measure("error", hand, at)[pick.index])
            if np.isfinite(error):
                rows.append(("reprojection error", f"{number(error)} px"))
        markers = self._content.markers
        if markers is None:
            return rows
        marker = pick.index
        if pick.kind == "control":
            if pick.index >= len(markers.held):
                return rows
            marker = markers.held[pick.index]
        unit, factor = length_unit(self._content)
        for other in markers.neighbors(marker):
            length = float(np.linalg.norm(markers.point[at, other] - markers.point[at, marker]))
            rows.append((f"to marker {other}", f"{number(factor * length)} {unit}"))
        return rows

    def _spring_rows(self, spring: int, rollout: ObjectRollout, frame: int) -> Rows:
        model = rollout.model_in(frame)
        strain = float(rollout.strains(frame)[spring])
        unit, factor = length_unit(self._content)
        names = [
            f"node {end}" if end < model.node_count else f"control node {end - model.node_count}"
            for end in map(int, model.spring_nodes[spring])
        ]
        stiffness = rollout.parameters.stiffness_scale * float(model.stiffness[spring])
        rest = float(model.rest_length[spring])
        length = (1.0 + strain) * rest
        lengths = f"{number(factor * length)} {unit}, at rest {number(factor * rest)} {unit}"
        newtons = self._painter.force_factor
        return [
            ("joins", " and ".join(names)),
            ("length", lengths),
            ("strain", f"{number(1e2 * strain)} %"),
            ("pull", f"{number(newtons * float(rollout.tensions(frame)[spring]))} N"),
            ("stiffness", f"{number(newtons * stiffness)} N"),
            ("damping", f"{number(newtons * float(model.damping[spring]))} N·s/m"),
            *_attached_rows(rollout.model, spring),
        ]

    def _node_rows(self, node: int, rollout: ObjectRollout, frame: int, spring_count: int) -> Rows:
        rows: Rows = []
        kinds: tuple[Coloring, ...] = ("stiffness", "damping", "strain", "error", "difference")
        for kind in kinds:
            if kind == "error" and not self._painter.errors.is_known:
                continue
            quantity = self._painter.quantity(kind)
            value = float(self._painter.measure(kind, rollout, frame).node[node]) * quantity.factor
            shown = f"{number(value)} {quantity.unit}" if np.isfinite(value) else "not known"
            rows.append((quantity.label.lower(), shown))
        return [*rows, ("object springs", str(spring_count))]

    def _partners(
        self,
        rollout: ObjectRollout,
        frame: int,
        springs: Int[ndarray, " spring"],
        *,
        is_control: bool,
    ) -> str:
        """Name what virtual springs join a thing to, the one that pulls hardest first."""
        if len(springs) == 0:
            return "nothing"
        pull = self._painter.force_factor * np.abs(rollout.tensions(frame)[springs])
        ends = rollout.model.spring_nodes[springs]
        partner = ends.max(axis=1) - rollout.model.node_count if is_control else ends.min(axis=1)
        order = np.argsort(-pull, kind="stable")
        what = "control" if is_control else "node"
        named = [f"{what} {int(partner[i])} ({number(float(pull[i]))} N)" for i in order[:_NAMED]]
        more = len(springs) - len(named)
        return ", ".join(named) + (f" and {more} more" if more else "")

    def _first_control(self, side: str | None) -> int | None:
        """Find the control node that is the first vertex of a hand; None if they are others."""
        control = self._content.control
        total = sum(hand.vertex.shape[1] for hand in self._content.hands)
        if control is None or total == 0 or control.shape[1] != total:
            return None
        for order in (self._content.hands, self._content.hands[::-1]):
            vertex = np.concatenate([np.asarray(hand.vertex[0]) for hand in order])
            if not np.allclose(vertex, control[0], rtol=0.0, atol=1e-5):
                continue
            first = 0
            for hand in order:
                if hand.side == side:
                    return first
                first += hand.vertex.shape[1]
        return None

    @staticmethod
    def _vector(value: ndarray, unit: str, *, size: bool = False) -> str:
        parts = ", ".join(number(round(float(v), 6)) for v in value)
        if not size:
            return f"{parts} {unit}"
        return f"{number(float(np.linalg.norm(value)))} {unit} ({parts})"
