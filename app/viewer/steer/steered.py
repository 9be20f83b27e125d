"""The object of a session while somebody steers its hands."""

import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from app.viewer.live.client import SimulationClient
from app.viewer.live.drive import HandLimits, HandOrder
from app.viewer.live.wire import Message
from physhandi.errors import UsageError
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.fingers import curled
from physhandi.simulation.restart import NodeState
from physhandi.simulation.steering import (
    POSE,
    HandSurface,
    SteeredHand,
    SteeredMotion,
    nearest_surface,
)

TOP_SPEED = 3.0
"""A wrist moves no faster than this many extents of the scene in a second."""
FARTHEST_REACH = 5.0
"""A wrist goes no farther than this many extents from where it was."""
MOST_UNDONE = 50
"""Gestures that can be taken back."""
LONGEST_MOTION = 60.0
"""A motion is no longer than this [s]."""
_ON_THE_HAND = 1e-5
"""Least way by which a control node is beside the hand [m]."""
_MOST_BYTES = 256 << 20
"""States of the object that a motion may keep, whatever their number."""


@dataclass(frozen=True, eq=False)
class SteeredFrame:
    """One simulated frame."""

    motion: SteeredMotion
    """The hands, and what they hold."""
    position: Float32[ndarray, "node 3"]
    """Object nodes [m]."""
    velocity: Float32[ndarray, "node 3"]
    """Their velocities [m/s]."""
    pose: Float[ndarray, "hand pose"]
    """Poses of the hands; see `SteeredMotion`."""
    pull: Float[ndarray, "hand 3"] | None = None
    """Force of the object on each hand [N]; None before the first frame was simulated."""


def begin_motion(
    rollout: ObjectRollout,
    frame: int,
    hands: Mapping[str, HandSurface],
    wrists: Mapping[str, Float[ndarray, " 3"]],
) -> SteeredMotion:
    """Let hands be steered from a frame of a rollout on.

    Control nodes belong to the hand whose surface is nearest; without hands, to one body.

    Args:
        rollout: The object's motion.
        frame: Frame of the rollout.
        hands: Each hand in the frame.
        wrists: Wrist of each hand [m]; the middle of the hand where it is not known.

    Raises:
        UsageError: If nothing moves the object.
    """
    model, start = rollout.going_on(frame)
    control = np.asarray(rollout.held_control(frame), np.float32)
    moving = len(control) - model.pin_count
    if not moving:
        raise UsageError("Nothing holds this object, so there is no hand to steer.")
    recorded = np.asarray(rollout.control[frame], np.float64)
    # What a restart moved off the hand would be a spike of its surface; there it holds anyway.
    is_moved = np.abs(control - recorded).max(axis=1) > _ON_THE_HAND
    corner_moved = is_moved[model.hand_face].any(axis=1)
    model = replace(model, hand_face=model.hand_face[~corner_moved])
    if hands:
        surfaces = [curled(hand.shapes, 0.0) for hand in hands.values()]
        owner = nearest_surface(recorded[:moving], surfaces)
        steered = tuple(
            SteeredHand.of_surface(
                name,
                hand,
                control=np.flatnonzero(owner == number),
                recorded=recorded,
                place=control,
                wrist=wrists.get(name),
            )
            for number, (name, hand) in enumerate(hands.items())
        )
    else:
        every = np.arange(moving)
        wrist = recorded[:moving].mean(axis=0)
        steered = (SteeredHand(name="controls", control=every, wrist=wrist),)
    return SteeredMotion(
        model=model,
        start=start,
        parameters=rollout.parameters_in(frame + 1),
        control=control,
        hands=steered,
        is_edited=bool(rollout.edits),
        pose=np.zeros((1, len(steered), POSE)),
    )


class SteeredObject:
    """Has the live simulation process simulate what is steered, and keeps its newest frame.

    Orders come from the page, frames from the process, and the clock draws, each in threads of
    their own.
    """

    def __init__(
        self,
        mailbox: str,
        live: SimulationClient,
        motion: SteeredMotion,
        *,
        extent: float,
        on_change: Callable[[str, str], None],
    ) -> None:
        """Begin to simulate.

        Args:
            mailbox: Name of the listener, which no other has.
            live: The process.
            motion: The state to begin in, and the hands.
            extent: Size of the scene, which bounds how fast and how far a wrist moves [m].
            on_change: Called with the kind of each message of the process, and why it ended.
        """
        self._mailbox = mailbox
        self._live = live
        self._limits = HandLimits(top_speed=TOP_SPEED * extent, reach=FARTHEST_REACH * extent)
        self._on_change = on_change
        self._lock = threading.Lock()
        self._number = 0
        self._orders = [HandOrder() for _ in motion.hands]
        self._most_force: float | None = None
        start = SteeredFrame(motion, *motion.start, motion.pose[0])
        self._before = self._newest = start
        self._durations: deque[float] = deque(maxlen=30)
        self._undone: deque[SteeredFrame] = deque(maxlen=MOST_UNDONE)
        self._recorded: list[SteeredFrame] = []
        self._is_recording = self._is_replaying = False
        self._replayed = motion
        rate, size = motion.parameters.frame_rate, 24 * max(motion.model.node_count, 1)
        self.most_frames = max(2, min(int(LONGEST_MOTION * rate), _MOST_BYTES // size))
        """Frames of the longest motion; then recording ends by itself."""
        self._rollout = _of_two_frames(start)
        live.subscribe(mailbox, self._receive)
        self._simulate(start)

    @property
    def newest(self) -> SteeredFrame:
        """The newest frame."""
        with self._lock:
            return self._newest

    @property
    def duration(self) -> float:
        """Time that a frame of late has taken to simulate, the median [s]; NaN before the first."""
        with self._lock:
            return float(np.median(self._durations)) if self._durations else float("nan")

    @property
    def motion(self) -> SteeredMotion:
        """The hands now, and what they hold."""
        return self.newest.motion

    def close(self) -> None:
        """Stop simulating."""
        with self._lock:
            self._number = 0
        self._live.unsubscribe(self._mailbox)

    def order(self, hand: int, order: HandOrder) -> None:
        """Tell a hand where to go, from now on.

        Raises:
            UsageError: If a number is not finite, or the goal is out of reach.
        """
        numbers = {"velocity": order.velocity, "goal": order.goal or (), "bend": order.bend or ()}
        for name, values in numbers.items():
            if not np.all(np.isfinite(values)):
                raise UsageError(f"The {name} of a hand must be finite numbers, not {values}.")
        reach = self._limits.reach
        if order.goal is not None and float(np.linalg.norm(order.goal[:3])) > reach:
            raise UsageError(f"The hand can go {reach:.3g} from where it was, and no farther.")
        with self._lock:
            if hand >= len(self._orders) or order == self._orders[hand]:
                return
            self._orders[hand] = order
            self._drive()

    def order_of(self, hand: int) -> HandOrder:
        """Give the order that a hand follows."""
        with self._lock:
            return self._orders[hand]

    def limit_force(self, most: float | None) -> None:
        """Let hands give way that the object pulls at harder than this, from now on.

        Args:
            most: The greatest force, of the model [N]; None for no limit.
        """
        with self._lock:
            if most != self._most_force:
                self._most_force = most
                self._drive()

    def _drive(self) -> None:
        self._live.drive(self._mailbox, self._orders, self._most_force)

    def begin_gesture(self) -> None:
        """Remember the state to which `undo` returns."""
        with self._lock:
            self._undone.append(self._newest)

    def regrip(
        self,
        change: Callable[[SteeredMotion, NodeState, Float[ndarray, "hand pose"]], SteeredMotion],
    ) -> SteeredMotion:
        """Change what the hands hold; what was recorded is not recorded any more.

        Args:
            change: Gives the motion that begins then, from the one before, the state of the object
                and the poses of the hands, as `SteeredMotion.grip` does.

        Returns:
            The motion that has begun.
        """
        with self._lock:
            before = self._newest
            motion = change(before.motion, (before.position, before.velocity), before.pose)
            self._undone.append(before)
            orders = {
                hand.name: order
                for hand, order in zip(before.motion.hands, self._orders, strict=True)
            }
            self._orders = [orders.get(hand.name, HandOrder()) for hand in motion.hands]
            self._go_on(SteeredFrame(motion, before.position, before.velocity, motion.pose[0]))
            return motion

    @property
    def is_recording(self) -> bool:
        """Whether frames are recorded."""
        with self._lock:
            return self._is_recording

    @property
    def is_full(self) -> bool:
        """Whether a recording has ended by itself, since it is as long as one may be."""
        with self._lock:
            return not self._is_recording and len(self._recorded) >= self.most_frames

    @property
    def is_replaying(self) -> bool:
        """Whether a motion is simulated again, so that orders are not followed."""
        with self._lock:
            return self._is_replaying

    @property
    def recorded(self) -> tuple[SteeredFrame, ...]:
        """The frames that were recorded last, or are being recorded."""
        with self._lock:
            return tuple(self._recorded)

    def record(self, *, on: bool) -> None:
        """Begin a recording with the newest frame, in the place of the last one, or end it."""
        with self._lock:
            if on:
                self._recorded = [self._newest]
            self._is_recording = on
            if not on:
                self._recorded = []

    def replay(self, motion: SteeredMotion) -> None:
        """Simulate a motion again; hands are steered on from its end.

        Args:
            motion: Of the same hands and object.
        """
        with self._lock:
            self._undone.append(self._newest)
            self._orders = [HandOrder() for _ in motion.hands]
            self._is_recording, self._is_replaying = False, True
            self._replayed = motion
            self._number = self._live.steer(self._mailbox, motion, self._limits, replays=True)

    def undo(self) -> bool:
        """Return to where the last gesture began; returns whether there was one.

        What was recorded since is not recorded any more.
        """
        with self._lock:
            if not self._undone:
                return False
            state, was_recording = self._undone.pop(), self._is_recording
            places = [frame is state for frame in self._recorded]
            count = places.index(True) + 1 if True in places else 0
            kept_frames = self._recorded[:count] or [state]
            self._orders = [HandOrder() for _ in state.motion.hands]
            self._go_on(state)
            if was_recording:
                self._is_recording, self._recorded = True, kept_frames
        return True

    def _go_on(self, start: SteeredFrame) -> None:
        """Let no frame of before come any more; called under the lock."""
        self._before = self._newest = start
        self._is_recording, self._recorded = False, []
        self._simulate(start)

    def shown(self) -> tuple[ObjectRollout, int, SteeredFrame]:
        """Give what to draw: a rollout, its frame, and that frame; called by one thread."""
        with self._lock:
            before, newest = self._before, self._newest
        rollout, motion = self._rollout, newest.motion
        if before.motion.model is not motion.model:
            before = newest
        if rollout.model is not motion.model:
            rollout = self._rollout = _of_two_frames(newest)
        for place, frame in enumerate((before, newest)):
            rollout.position[place] = frame.position
            if rollout.velocity is not None:
                rollout.velocity[place] = frame.velocity
            rollout.control[place] = motion.control_at(frame.pose)
        return rollout, 1, newest

    def _simulate(self, start: SteeredFrame) -> None:
        """Go on from a state."""
        state = start.position, start.velocity
        begun = replace(start.motion, start=state, pose=start.pose[None])
        self._is_replaying = False
        self._number = self._live.steer(self._mailbox, begun, self._limits)
        self._drive()

    def _receive(self, message: Message) -> None:
        if message.kind == "ready":
            return
        with self._lock:
            is_ours = message.kind == "crashed" or message["request"] == self._number
            if not is_ours or self._number == 0:
                return
            if message.kind == "frame":
                arrays = message.arrays
                self._before = self._newest
                # The first one is the state that it goes on from, which is known unless it is that
                # of a motion.
                if message["frame"] > 0 or self._is_replaying:
                    motion = self._replayed if self._is_replaying else self._newest.motion
                    self._newest = SteeredFrame(
                        motion,
                        arrays["position"],
                        arrays["velocity"],
                        arrays["pose"],
                        arrays["pull"],
                    )
                if message["frame"] > 0:
                    self._durations.append(float(message["duration"]))
                    self._keep(self._newest)
            elif message.kind == "finished":
                self._simulate(self._newest)
            else:
                self._number = 0
        reason = message.fields.get("error", "The live simulation stopped and is started anew.")
        self._on_change(message.kind, "" if message.kind == "frame" else str(reason))

    def _keep(self, frame: SteeredFrame) -> None:
        """Record a frame, if frames are recorded and there is room."""
        if self._is_recording:
            self._recorded.append(frame)
            self._is_recording = len(self._recorded) < self.most_frames


def _of_two_frames(frame: SteeredFrame) -> ObjectRollout:
    """Make a rollout of a frame and the one before it, which is the same at first."""
    return ObjectRollout(
        model=frame.motion.model,
        parameters=frame.motion.parameters,
        control=np.repeat(frame.motion.control_at(frame.pose)[None], 2, axis=0),
        position=np.repeat(frame.position[None], 2, axis=0),
        velocity=np.repeat(frame.velocity[None], 2, axis=0),
        ready=2,
    )
