"""Where a hand takes hold of an object that lies on the ground, and how it gets there."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from physhandi.errors import SequenceError
from physhandi.synthetic.grasp import (
    FLAT,
    INDEX,
    LITTLE,
    MIDDLE,
    PINCHING,
    POINTING,
    RELAXED,
    RING,
    THUMB,
    bend_of,
    fingertip,
    orientation_towards,
    reach,
)
from physhandi.synthetic.hand_script import HandScript, Move, Tremor
from physhandi.synthetic.places import (
    Place,
    handful_place,
    height_range,
    narrow_places,
    rim_place,
)
from physhandi.synthetic.true_hand import HandPose, TrueHand

Carry = Callable[[float], tuple[Float[ndarray, " 3"], Float[ndarray, " 3"]]]
"""Where a grasp has gone after a share of a move: shift [m] and rotation vector [rad]."""

_UP = np.array([0.0, 0.0, 1.0])
# Times of reaching, touching, closing and being ready, before the recording starts [s].
_BEGIN, _TOUCH, _CLOSED, _READY = -1.5, -1.1, -0.6, -0.15
_HOVER, _ASIDE = 0.06, 0.08
_CLEARANCE = 0.004
_CLEAR_OF = 0.02
_POSES_PER_MOVE = 9
_FINGER_SPACING, _PINCH_SPACING = 0.020, 0.016
_PITCH, _PINCH_PITCH = 0.75, 0.0
# How far below the horizon pinching fingers point, and how much of them is beyond the pinch.
_TILT, _PAD = 0.7, 0.006


class Graspable(Protocol):
    """What hands must know of an object."""

    @property
    def name(self) -> str:
        """What kind of object it is."""
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

    poses: Sequence[HandPose]
    """Poses from the one that first touches the object to the one that holds it."""
    place: Place
    """Where the object is grasped, and which way the hand faces."""
    approach: Sequence[Move]
    """How the hand gets there before the recording starts, from far away to the last pose."""

    @property
    def forward(self) -> Float[ndarray, " 3"]:
        """Horizontal direction in which the fingers reach."""
        return self.place.forward

    @property
    def across(self) -> Float[ndarray, " 3"]:
        """Horizontal direction to the left of `forward`."""
        return np.cross(_UP, self.place.forward)


class Handler:
    """One hand that is about to do something with one object."""

    def __init__(self, hand: TrueHand, body: Graspable, random: Generator) -> None:
        """Remember who does what.

        Args:
            hand: The hand.
            body: The object as it lies on the ground.
            random: Decides places, directions and the tremor.
        """
        self._hand = hand
        self._body = body
        self._random = random

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
        closed = self._pinch(place, place.closed_gap, None)
        raised = max(_CLEARANCE - self._lowest(closed)[0], 0.0) * _UP
        lower = [closed]
        for gap in np.linspace(place.closed_gap, place.open_gap, 4)[1:]:
            lower.append(self._pinch(place, float(gap), lower[-1]))
        lower.reverse()
        held = replace(place, point=place.point + raised)
        outside = _moved(lower[0], -_ASIDE * place.forward)
        return Grasp(
            place=held,
            poses=(_moved(closed, raised),),
            approach=(
                Move(_BEGIN, _TOUCH, (outside, lower[0])),
                Move(_TOUCH, _CLOSED, lower),
                Move(_CLOSED, _READY, (closed, _moved(closed, raised))),
            ),
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
        poses = self._close(place, gaps)
        return Grasp(poses=poses, place=place, approach=_from_above(poses[0], poses))

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
        poses = self._close(place, gaps)
        return Grasp(poses=poses, place=place, approach=_from_above(poses[0], poses))

    def lay_flat(self) -> Grasp:
        """Press the flat hand on the middle of the object."""
        angle = np.pi / 2 + self._random.uniform(-0.4, 0.4)
        forward = np.array([np.cos(angle), np.sin(angle), 0.0])
        middle = self._body.node.mean(axis=0)
        _, top = height_range(self._body, middle, 0.06)
        place = Place(point=np.array([*middle[:2], top]), forward=forward, inwards=forward)
        pose = HandPose(
            orientation=orientation_towards(forward, pitch=0.06),
            position=np.zeros(3),
            bend=bend_of(FLAT),
        )
        low, center = self._lowest(pose)
        is_soft = height_range(self._body, middle, 0.06)[1] > 0.02
        press = 0.010 if is_soft else 0.003
        shift = np.array([*(place.point - center)[:2], top - press - low])
        above = _moved(pose, shift + (press + 0.004) * _UP)
        poses = (above, _moved(pose, shift))
        return Grasp(poses=poses, place=place, approach=_from_above(above, poses))

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
        orientation = orientation_towards(forward, pitch=_PITCH)
        touch = reach(self._hand, {INDEX: target}, orientation=orientation, joints=POINTING)
        back = 0.01 * _UP if is_flat else -0.01 * forward
        poses = (_moved(touch, back), touch)
        return Grasp(poses=poses, place=place, approach=_from_above(poses[0], poses))

    def script(self, grasp: Grasp, moves: Sequence[tuple[float, float, Carry]]) -> HandScript:
        """Reach for the object, close the hand, and carry what it holds.

        Args:
            grasp: Where and how to take hold.
            moves: Start, end [s] and way of each move after that.
        """
        held = grasp.poses[-1]
        chain = list(grasp.approach)
        for start, end, carry in moves:
            phases = np.linspace(0.0, 1.0, _POSES_PER_MOVE)
            poses = [_turned(held, grasp.place.point, *carry(float(p))) for p in phases]
            chain.append(Move(start, end, poses))
        return HandScript(self._hand.side, chain, Tremor(self._random))

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
            drifting = [_moved(p, share * drift) for p, share in zip(leg, shares, strict=True)]
            chain.append(Move(times[number], times[number + 1], drifting))
        return HandScript(self._hand.side, chain, Tremor(self._random))

    def distance_to_middle(self, grasp: Grasp) -> float:
        """How far the grasp is from the object's middle along the way the hand faces [m]."""
        return abs(float((self._body.node.mean(axis=0) - grasp.place.point) @ grasp.place.inwards))

    def _pinch(self, place: Place, gap: float, start: HandPose | None) -> HandPose:
        """Put the thumb below a place and two fingers above it; the others stay clear of it."""
        along = np.cos(_TILT) * place.forward - np.sin(_TILT) * _UP
        above = np.sin(_TILT) * place.forward + np.cos(_TILT) * _UP
        point = place.point + _PAD * along
        targets = {THUMB: point - (gap / 2 + self._radius(THUMB)) * above}
        clear = place.thickness / 2 + _CLEAR_OF
        for finger in (INDEX, MIDDLE, RING, LITTLE):
            height = gap / 2 if finger <= MIDDLE else clear
            aside = (INDEX + 0.5 - finger) * _PINCH_SPACING * self._thumb_side(place)
            targets[finger] = point + (height + self._radius(finger)) * above + aside
        return reach(
            self._hand,
            targets,
            orientation=orientation_towards(place.forward, pitch=_PINCH_PITCH),
            joints=PINCHING,
            start=start,
            along=along,
        )

    def _close(self, place: Place, gaps: Float[ndarray, " step"]) -> list[HandPose]:
        """Close thumb and fingers in steps, the wrist almost at rest."""
        poses: list[HandPose] = []
        for gap in gaps:
            poses.append(self._claw(place, float(gap), poses[-1] if poses else None))
        return poses

    def _claw(self, place: Place, gap: float, start: HandPose | None) -> HandPose:
        """Put the thumb and all fingers on opposite sides of a place, tips down."""
        targets: dict[int, ndarray] = {}
        for finger in (THUMB, INDEX, MIDDLE, RING, LITTLE):
            radius = self._radius(finger)
            sign, order = (-1.0, 0.0) if finger == THUMB else (1.0, 2.5 - finger)
            target = place.point + sign * (gap / 2 + radius) * place.forward
            target = target + order * _FINGER_SPACING * self._thumb_side(place)
            targets[finger] = np.array([*target[:2], max(place.depth, 0.001) + radius])
        return reach(
            self._hand,
            targets,
            orientation=orientation_towards(place.forward, pitch=_PITCH),
            joints=RELAXED,
            start=start,
            along=0.3 * place.forward - 0.95 * _UP,
        )

    def _radius(self, finger: int) -> float:
        return fingertip(self._hand, finger).radius

    def _thumb_side(self, place: Place) -> Float[ndarray, " 3"]:
        """Tell the horizontal direction from the little finger to the index finger."""
        side = 1.0 if self._hand.side == "right" else -1.0
        return side * np.cross(_UP, place.forward)

    def _lowest(self, pose: HandPose) -> tuple[float, Float[ndarray, " 3"]]:
        """Find the lowest skin of a pose, and the middle of its palm."""
        transform = self._hand.bone_transforms(pose)
        lowest = np.inf
        for capsule in self._hand.capsules:
            turn, shift = transform[capsule.bone, :3, :3], transform[capsule.bone, :3, 3]
            for end in (capsule.start, capsule.end):
                lowest = min(lowest, float((turn @ end + shift)[2]) - capsule.radius)
        keypoint = self._hand.pose(pose).keypoint
        return lowest, (keypoint[0] + keypoint[9]) / 2


def _from_above(first: HandPose, closing: Sequence[HandPose]) -> list[Move]:
    """Come down to where a hand touches first, then close it."""
    return [
        Move(_BEGIN, _TOUCH, (_moved(first, _HOVER * _UP), first)),
        Move(_TOUCH, _READY, closing),
    ]


def _moved(pose: HandPose, shift: Float[ndarray, " 3"]) -> HandPose:
    return HandPose(orientation=pose.orientation, position=pose.position + shift, bend=pose.bend)


def _turned(
    pose: HandPose,
    point: Float[ndarray, " 3"],
    shift: Float[ndarray, " 3"],
    turn: Float[ndarray, " 3"],
) -> HandPose:
    """Turn a pose about a point, then shift it."""
    rotation = Rotation.from_rotvec(turn)
    return HandPose(
        orientation=(rotation * Rotation.from_rotvec(pose.orientation)).as_rotvec(),
        position=point + rotation.apply(pose.position - point) + shift,
        bend=pose.bend,
    )
