"""Grasps of an object that lies on the ground, and the hand's path to them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from physhandi.errors import SequenceError
from physhandi.synthetic.hands.grasp import (
    FLAT_HAND,
    INDEX,
    POINTING,
    bend_of,
    fingertip,
    orientation_towards,
    reach,
)
from physhandi.synthetic.hands.places import (
    Place,
    handful_place,
    height_range,
    narrow_places,
    rim_place,
)
from physhandi.synthetic.hands.script import HandMove, HandScript, Tremor
from physhandi.synthetic.hands.shapes import claw, lowest_skin, moved, pinch, turned
from physhandi.synthetic.hands.true_hand import TrueHand, TrueHandPose

Carry = Callable[[float], tuple[Float[ndarray, " 3"], Float[ndarray, " 3"]]]
"""Where a grasp has gone after a share of a move: shift [m] and rotation vector [rad]."""

_UP = np.array([0.0, 0.0, 1.0])
SET_OUT = -1.5
"""When a hand sets out for the object, before the recording starts, if it is not late [s]."""
# Times of touching, closing and being ready, before the recording starts [s].
_TOUCH, _CLOSED, _READY = -1.1, -0.6, -0.15
# How long a hand opens, and how long it then moves away [s].
_OPENING, _LEAVING = 0.4, 0.4
_HOVER, _ASIDE = 0.06, 0.08
_CLEARANCE = 0.004
_POSES_PER_MOVE = 9
_POINT_PITCH = 0.75


class Graspable(Protocol):
    """Interface of an object that hands can grasp."""

    @property
    def name(self) -> str:
        """Kind of object."""
        ...

    @property
    def node(self) -> Float[ndarray, "node 3"]:
        """Nodes of the object lying on the ground, which is z = 0 [m]."""
        ...

    @property
    def radius(self) -> float:
        """Distance at which others touch it, about its nodes [m]."""
        ...

    @property
    def dimension(self) -> int:
        """1 for a rod, 2 for a shell, 3 for a solid."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class Grasp:
    """A hand at an object: its way from open to closed."""

    poses: Sequence[TrueHandPose]
    """Poses from the one that first touches the object to the one that holds it."""
    place: Place
    """Place of the grasp and direction of the hand."""
    approach: Sequence[HandMove]
    """Path of the hand before the recording starts, from far away to the last pose."""
    retreat: Sequence[TrueHandPose]
    """Way out, from a pose that holds the object where it was grasped to one that is far away."""

    @property
    def forward(self) -> Float[ndarray, " 3"]:
        """Horizontal direction in which the fingers reach."""
        return self.place.forward

    @property
    def across(self) -> Float[ndarray, " 3"]:
        """Horizontal direction to the left of `forward`."""
        return np.cross(_UP, self.place.forward)


class Handler:
    """Plans one hand's grasps and motions on one object."""

    def __init__(
        self, hand: TrueHand, body: Graspable, random: Generator, *, lets_go: bool = False
    ) -> None:
        """Remember who does what.

        Args:
            hand: The hand.
            body: The object as it lies on the ground.
            random: Decides places, directions and the tremor.
            lets_go: Whether the hand opens and goes away after the last move of a script.
        """
        self._hand = hand
        self._body = body
        self._random = random
        self._lets_go = lets_go

    def take(self, *, end: float = 0.0) -> Grasp:
        """Take hold of the object so that it can be carried.

        Args:
            end: 1 or -1 for a place on that side of the object; 0 for any.
        """
        # What is heavy hangs down: it must be able to turn about the line between the fingers.
        return self._take_limb(end) if self._body.dimension == 3 else self._pinch_rim(end)

    def _pinch_rim(self, end: float) -> Grasp:
        """Take the rim between the thumb below and two fingers above, a little off the ground."""
        place = rim_place(self._body, self._random, end=end)
        closed = pinch(self._hand, place, place.closed_gap, None)
        raised = max(_CLEARANCE - lowest_skin(self._hand, closed)[0], 0.0) * _UP
        lower = [closed]
        for gap in np.linspace(place.closed_gap, place.open_gap, 4)[1:]:
            lower.append(pinch(self._hand, place, float(gap), lower[-1]))
        lower.reverse()
        raised_place = replace(place, point=place.point + raised)
        outside = moved(lower[0], -_ASIDE * place.forward)
        return Grasp(
            place=raised_place,
            poses=(moved(closed, raised),),
            approach=(
                HandMove(SET_OUT, _TOUCH, (outside, lower[0])),
                HandMove(_TOUCH, _CLOSED, lower),
                HandMove(_CLOSED, _READY, (closed, moved(closed, raised))),
            ),
            retreat=[*lower[::-1], outside],
        )

    def _take_limb(self, end: float) -> Grasp:
        """Take a limb between the thumb on one side and all fingers on the other."""
        places = narrow_places(self._body, self._random, end=end)
        if not places:
            raise SequenceError(
                f"The {self._body.name} has no part that a hand can span. Choose another seed."
            )
        places.sort(key=lambda place: 0.5 * (place.width or 0.0) - place.remoteness)
        place = places[self._random.integers(max(len(places) // 6, 1))]
        place = replace(place, closed_gap=0.5 * (place.width or 0.0))
        gaps = np.linspace((place.width or 0.0) + 0.012, place.closed_gap, 5)
        return _grasp_from_above(place, self._close(place, gaps))

    def embrace(self) -> Grasp:
        """Close all fingers around a part of the object, or around a handful of it."""
        places = narrow_places(self._body, self._random)
        if places:
            places.sort(key=lambda place: -(place.width or 0.0))
            place = places[self._random.integers(max(len(places) // 5, 1))]
            gaps = np.linspace((place.width or 0.0) + 0.012, place.closed_gap, 5)
        else:
            place = handful_place(self._body, self._random)
            gaps = np.linspace(place.open_gap, place.closed_gap, 7)
        return _grasp_from_above(place, self._close(place, gaps))

    def lay_flat(self) -> Grasp:
        """Press the flat hand on the middle of the object."""
        angle = np.pi / 2 + self._random.uniform(-0.4, 0.4)
        forward = np.array([np.cos(angle), np.sin(angle), 0.0])
        middle = self._body.node.mean(axis=0)
        _, top = height_range(self._body, middle, 0.06)
        place = Place(point=np.array([*middle[:2], top]), forward=forward, inwards=forward)
        pose = TrueHandPose(
            orientation=orientation_towards(forward, pitch=0.06),
            position=np.zeros(3),
            bend=bend_of(FLAT_HAND),
        )
        low, center = lowest_skin(self._hand, pose)
        is_soft = height_range(self._body, middle, 0.06)[1] > 0.02
        press = 0.010 if is_soft else 0.003
        shift = np.array([*(place.point - center)[:2], top - press - low])
        above = moved(pose, shift + (press + 0.004) * _UP)
        return _grasp_from_above(place, (above, moved(pose, shift)))

    def point_at(self) -> Grasp:
        """Put the index finger beside the object, or on it where it is flat."""
        body, tip = self._body, fingertip(self._hand, INDEX)
        angle = np.pi / 2 + self._random.uniform(-0.35, 0.35)
        forward = np.array([np.cos(angle), np.sin(angle), 0.0])
        middle = body.node.mean(axis=0)
        across = np.cross(_UP, forward)
        aside = self._random.uniform(-0.03, 0.03)
        beside = np.abs((body.node - middle) @ across - aside) < 0.02
        nodes = body.node[beside]
        near = nodes[((nodes - middle) @ forward).argmin()]
        bottom, top = height_range(body, middle, 0.05)
        is_flat = top - bottom < 0.008 + 2 * body.radius and top < 0.009
        if is_flat:
            inside = near + 0.05 * forward
            target = np.array([*inside[:2], top + tip.radius - 0.002])
        else:
            outside = near - (tip.radius + body.radius - 0.001) * forward
            height = max(tip.radius + 0.002, 0.45 * (bottom + top))
            target = np.array([*outside[:2], height])
        place = Place(point=target, forward=forward, inwards=forward)
        orientation = orientation_towards(forward, pitch=_POINT_PITCH)
        touch = reach(self._hand, {INDEX: target}, orientation=orientation, joints=POINTING)
        back = 0.01 * _UP if is_flat else -0.01 * forward
        return _grasp_from_above(place, (moved(touch, back), touch))

    def script(self, grasp: Grasp, moves: Sequence[tuple[float, float, Carry]]) -> HandScript:
        """Reach for the object, close the hand, and carry what it holds.

        Args:
            grasp: Where and how to take hold.
            moves: Start, end [s] and way of each move after that.
        """
        last_pose = grasp.poses[-1]
        chain = list(grasp.approach)
        for start, end, carry in moves:
            phases = np.linspace(0.0, 1.0, _POSES_PER_MOVE)
            poses = [turned(last_pose, grasp.place.point, *carry(float(p))) for p in phases]
            chain.append(HandMove(start, end, poses))
        return self._finished(grasp, chain)

    def squeeze_script(
        self,
        grasp: Grasp,
        times: Float[ndarray, " 4"],
        *,
        ease: float,
        drift: Float[ndarray, " 3"],
    ) -> HandScript:
        """Close the hand further, ease it, and close it again.

        Args:
            grasp: Where and how to take hold.
            times: Begin and end of closing, end of easing and of closing again [s].
            ease: Share of the way to the open hand by which the grip is eased.
            drift: How far the hand moves aside in the end [m].
        """
        poses = list(grasp.poses)
        half = len(poses) // 2
        eased = poses[max(round((1 - ease) * (len(poses) - 1)), 0) :]
        chain = _from_above(poses[0], poses[: half + 1])
        legs = (poses[half:], 0.0, 0.2), (eased[::-1], 0.2, 0.4), (eased, 0.4, 1.0)
        for number, (leg, first, last) in enumerate(legs):
            shares = np.linspace(first, last, len(leg))
            drifting = [moved(p, share * drift) for p, share in zip(leg, shares, strict=True)]
            chain.append(HandMove(times[number], times[number + 1], drifting))
        return self._finished(grasp, chain)

    def _finished(self, grasp: Grasp, moves: Sequence[HandMove]) -> HandScript:
        """Let the hand tremble, and let go in the end if it shall."""
        last = moves[-1]
        leaving = _let_go(grasp.retreat, last.poses[-1], last.end) if self._lets_go else ()
        return HandScript(self._hand.side, [*moves, *leaving], Tremor(self._random))

    def distance_to_middle(self, grasp: Grasp) -> float:
        """Distance from the grasp to the object's middle along the hand's direction [m]."""
        return abs(float((self._body.node.mean(axis=0) - grasp.place.point) @ grasp.place.inwards))

    def _close(self, place: Place, gaps: Float[ndarray, " step"]) -> list[TrueHandPose]:
        """Close thumb and fingers in steps, the wrist almost at rest."""
        poses: list[TrueHandPose] = []
        for gap in gaps:
            poses.append(claw(self._hand, place, float(gap), poses[-1] if poses else None))
        return poses


def _grasp_from_above(place: Place, poses: Sequence[TrueHandPose]) -> Grasp:
    """Come from above, close the hand, and go back the same way."""
    approach = _from_above(poses[0], poses)
    retreat = [*reversed(poses), moved(poses[0], _HOVER * _UP)]
    return Grasp(poses=poses, place=place, approach=approach, retreat=retreat)


def _from_above(first: TrueHandPose, closing: Sequence[TrueHandPose]) -> list[HandMove]:
    """Come down to where a hand touches first, then close it."""
    return [
        HandMove(SET_OUT, _TOUCH, (moved(first, _HOVER * _UP), first)),
        HandMove(_TOUCH, _READY, closing),
    ]


def _let_go(
    retreat: Sequence[TrueHandPose], held: TrueHandPose, start: float
) -> tuple[HandMove, HandMove]:
    """Open a hand that holds something and take it away, the way it came.

    Args:
        retreat: Way out of the grasp where the object was taken.
        held: Pose of the hand that has carried it elsewhere; its way out is that of the grasp,
            moved and turned as far as the wrist has been.
        start: When it begins to open [s].
    """
    before = Rotation.from_rotvec(retreat[0].orientation)
    turn = Rotation.from_rotvec(held.orientation) * before.inv()
    way = [held] + [
        TrueHandPose(
            orientation=(turn * Rotation.from_rotvec(pose.orientation)).as_rotvec(),
            position=held.position + turn.apply(pose.position - retreat[0].position),
            bend=pose.bend,
        )
        for pose in retreat[1:]
    ]
    opened = start + _OPENING
    return HandMove(start, opened, way[:-1]), HandMove(opened, opened + _LEAVING, way[-2:])
