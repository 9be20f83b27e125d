"""Motion of a steered hand: it follows orders smoothly and within its limits."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.simulation.fingers import Fingers
from physhandi.simulation.steering import SteeredMotion, turn_between, turn_on

LAG = 0.1
"""Time in which a hand takes up most of a change of its speed [s]."""
TOP_TURN = 2.0 * math.pi
"""A hand turns no faster than this [rad/s]."""
_YIELDING = 0.2
"""Part of its top speed with which a hand gives way that is pulled at twice as hard as allowed."""
_PARTS_OF_A_BEND = (1.0, 0.5, 0.25, 0.125, 0.0625)
"""Parts of a step of a finger, of which the largest is taken that does not go into the ground."""
_THERE = 1e-6
"""A hand that is so near to its goal is there [length unit, rad]."""


@dataclass(frozen=True, kw_only=True)
class HandOrder:
    """Order to a hand; the newest one holds until the next."""

    velocity: tuple[float, ...] = (0.0,) * 6
    """Speed of the wrist [m/s] and its turning about the world's axes [rad/s], without a goal."""
    goal: tuple[float, ...] | None = None
    """Place to go to: offset of the wrist [m] and rotation vector [rad]; None to move freely."""
    closing: float = 0.0
    """Speed at which the fingers close [1/s]; negative for opening."""
    bend: tuple[float, ...] | None = None
    """Target of each finger's bend on top of that [rad], see `Fingers`; None for no change."""

    def to_dict(self) -> dict[str, Any]:
        """Describe it in plain data."""
        return asdict(self)

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> "HandOrder":
        """Rebuild it from plain data."""
        goal, bend = fields["goal"], fields["bend"]
        return cls(
            velocity=tuple(fields["velocity"]),
            goal=None if goal is None else tuple(goal),
            closing=float(fields["closing"]),
            bend=None if bend is None else tuple(bend),
        )


@dataclass(frozen=True, kw_only=True)
class HandLimits:
    """Limits of a steered hand, which hold for all orders."""

    top_speed: float
    """Its wrist moves no faster than this [m/s]."""
    reach: float
    """Its wrist goes no farther than this from where it is in the pose of zero [m]."""


class HandDrive:
    """Moves one hand a frame at a time as its newest order says."""

    def __init__(
        self,
        pose: Float[ndarray, " pose"],
        *,
        frame_rate: float,
        limits: HandLimits,
        depth: Callable[[Float[ndarray, " pose"]], float],
        fingers: Fingers | None = None,
    ) -> None:
        """Begin at rest.

        Args:
            pose: Where the hand is; see `POSE`.
            frame_rate: Frames per second [Hz].
            limits: How fast and how far it goes.
            depth: Tells how far a pose is too low [m]; the hand is lifted by so much. Negative for
                a pose that is higher than it must be.
            fingers: Its fingers, if they bend one by one.
        """
        self.order = HandOrder()
        """The order that the hand follows."""
        self.most_force = math.inf
        """Pulled at harder than this, the hand gives way [N]."""
        self.pose = np.array(pose, np.float64)
        """Pose of the hand."""
        self._step = 1.0 / frame_rate
        self._top = np.array([limits.top_speed, TOP_TURN])
        self._yielding = _YIELDING * limits.top_speed
        self._reach = limits.reach
        self._depth = depth
        self._fingers = fingers
        self._velocity = np.zeros(6)
        self._closing = 0.0

    def next(self, pull: Float[ndarray, " 3"]) -> Float[ndarray, " pose"]:
        """Move on by a frame.

        Args:
            pull: How the object pulls at the hand [N].

        Returns:
            The new pose.
        """
        goal = self.order.goal
        if goal is None:
            self._velocity += self._share * (np.array(self.order.velocity) - self._velocity)
            self._limit()
        else:
            offset = np.array(goal[:3]) - self.pose[:3]
            away = np.concatenate([offset, turn_between(self.pose[3:6], np.array(goal[3:]))])
            self._velocity = away * (self._share / self._step)
            self._limit()
            if np.abs(away).max() < _THERE:
                self._velocity = away / self._step
        self._give_way(pull)
        before = self.pose[:3].copy()
        move = self._velocity * self._step
        self.pose[:3] += move[:3]
        self.pose[3:6] = turn_on(self.pose[3:6], move[3:])
        self._closing += self._share * (self.order.closing - self._closing)
        self.pose[6] = np.clip(self.pose[6] + self._closing * self._step, -1.0, 1.0)
        if self._fingers is not None:  # What keys close bends no joint farther than it goes.
            self.pose[7:] = np.clip(self.pose[7:], *self._fingers.limits(self.pose[6]))
        self._stop_at_bounds(before)
        self._bend()
        return self.pose.copy()

    def _bend(self) -> None:
        """Bend single fingers as they shall be, as far as joints go, and not into the ground."""
        if self._fingers is None or self.order.bend is None:
            return
        now, most = self.pose[7:].copy(), TOP_TURN * self._step
        away = np.clip(self.order.bend, *self._fingers.limits(self.pose[6])) - now
        if np.abs(away).max() > _THERE:
            away = np.clip(self._share * away, -most, most)
        deepest = max(self._depth(self.pose), 0.0)
        for part in _PARTS_OF_A_BEND:
            self.pose[7:] = now + part * away
            if self._depth(self.pose) <= deepest:
                return
        self.pose[7:] = now

    @property
    def _share(self) -> float:
        """Part of a change that is taken up in a frame."""
        return 1.0 - math.exp(-self._step / LAG)

    def _limit(self) -> None:
        """Slow down to the top speeds."""
        for part, top in zip((slice(0, 3), slice(3, 6)), self._top, strict=True):
            speed = float(np.linalg.norm(self._velocity[part]))
            if speed > top:
                self._velocity[part] *= top / speed

    def _give_way(self, pull: Float[ndarray, " 3"]) -> None:
        """Go no farther against a pull that is too strong, but along it, the faster the stronger.

        The speed grows with what the pull has too much, up to twice the greatest force.
        """
        force = float(np.linalg.norm(pull))
        if force <= self.most_force:
            return
        along = pull / force
        wanted = self._yielding * min(force / self.most_force - 1.0, 1.0)
        self._velocity[:3] += along * max(wanted - float(along @ self._velocity[:3]), 0.0)

    def _stop_at_bounds(self, before: Float[ndarray, " 3"]) -> None:
        """Hold the wrist within reach and above the ground; it slides along both.

        Args:
            before: Where the wrist was in the frame before [m].
        """
        distance = float(np.linalg.norm(self.pose[:3]))
        depth = self._depth(self.pose)
        if distance <= self._reach and depth <= 0.0:
            return
        if distance > self._reach:
            self.pose[:3] *= self._reach / distance
            depth = self._depth(self.pose)
        self.pose[2] += max(depth, 0.0)
        self._velocity[:3] = (self.pose[:3] - before) / self._step


class Drives:
    """The hands of one steered object."""

    def __init__(self, motion: SteeredMotion, limits: HandLimits) -> None:
        """Begin at rest in the first frame of a motion; see `HandDrive`.

        No control node goes lower than the ground, or than where the lowest one of its hand was
        recorded if that is lower: what is pressed through a table is thrown about.
        """
        self._drives = [
            HandDrive(
                pose,
                frame_rate=motion.parameters.frame_rate,
                limits=limits,
                depth=partial(motion.depth_below_ground, number),
                fingers=motion.hands[number].fingers,
            )
            for number, pose in enumerate(motion.pose[0])
        ]

    def obey(self, orders: Sequence[Mapping[str, Any]], most_force: float | None) -> None:
        """Follow new orders.

        Args:
            orders: One a hand, as `HandOrder.to_dict` gives them.
            most_force: A hand that is pulled at harder gives way [N]; None for no limit.
        """
        for drive, order in zip(self._drives, orders, strict=True):
            drive.order = HandOrder.from_dict(order)
            drive.most_force = math.inf if most_force is None else most_force

    def next(self, pull: Float[ndarray, "hand 3"]) -> Float[ndarray, "hand pose"]:
        """Move all hands on by a frame.

        Args:
            pull: How the object pulls at each of them [N].

        Returns:
            Their poses.
        """
        return np.stack([drive.next(its) for drive, its in zip(self._drives, pull, strict=True)])
