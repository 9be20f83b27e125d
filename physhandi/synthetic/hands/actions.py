"""The six actions of hands on soft objects: grasp, path and duration of each."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy import ndarray
from numpy.random import Generator

from physhandi.data.sequence_meta import Side
from physhandi.errors import UsageError
from physhandi.synthetic.hands.handling import SET_OUT, Graspable, Handler
from physhandi.synthetic.hands.script import HandScript
from physhandi.synthetic.hands.true_hand import TrueHand, load_true_hand

ActionName = Literal["lift", "fold", "stretch", "squeeze", "wipe", "push"]
ACTIONS: tuple[ActionName, ...] = ("lift", "fold", "stretch", "squeeze", "wipe", "push")
"""Names of the actions."""
_UP = np.array([0.0, 0.0, 1.0])
# How far hands pull each body beyond its length: as far as friction holds it.
_STRETCH = {"cloth": 0.02, "towel": 0.05, "rope": -0.01, "plush": 0.08, "pouch": 0.05}
# Shortest recording in which hands go the whole way, so that they are as slow in shorter ones [s].
_WHOLE_WAY = 3.0
# Shortest time in which an action can be told as one [s].
_LEAST = 0.3
DURATION = 3.0
"""Default duration of an action [s]."""


def script_action(
    action: str,
    body: Graspable,
    random: Generator,
    *,
    duration: float = DURATION,
    set_out: float = SET_OUT,
    release: float | None = None,
    side: Side = "right",
    hands: Mapping[Side, TrueHand] | None = None,
) -> tuple[HandScript, ...]:
    """Write the script of one action on one object.

    A script reaches for the object before time 0 (see `HandScript.begin`), touches it at time 0 and
    goes on to move until `duration`, so that its last part cannot be guessed from rest; or hands
    arrive later, or let go before.

    Args:
        action: One of `ACTIONS`.
        body: The object as it lies on the ground.
        random: Decides where it is grasped, which way and how far it is moved, and the tremor.
        duration: Length of the recording [s].
        set_out: When hands set out for the object, which they touch no sooner than that [s]. They
            take 1.5 s to hold it; by default the recording begins then and holds the action alone.
        release: When hands begin to let go, which takes 0.8 s with going away [s]. None: never.
        side: Hand that does one-handed actions; stretching takes both.
        hands: The hands that will do it, so that their soft tissue is counted; None for bare ones.

    Returns:
        One script, or the right hand's and the left hand's.

    Raises:
        UsageError: There is no such action, or no time for it.
        SequenceError: The object is too large for the hand.
    """
    if action not in _WRITERS:
        raise UsageError(f"There is no action {action!r}. Choose one of {', '.join(ACTIONS)}.")
    hands = hands or {side: load_true_hand(side) for side in ("right", "left")}
    delay = set_out - SET_OUT
    until = duration if release is None else release
    is_timed = delay != 0.0 or release is not None
    if is_timed and (delay < 0.0 or until > duration or until - delay < _LEAST):
        raise UsageError(
            f"Hands that set out at {set_out:g} s have hold of the object at {delay:.2f} s. "
            f"Until {until:.2f} s of {duration:.2f} s, {until - delay:.2f} s are left for the "
            f"action, and it needs {_LEAST:g} s. Choose an earlier set_out from {SET_OUT:g} s on, "
            "a later release within the recording, or more frames."
        )
    task = _Task(body, random, until - delay, side, hands, lets_go=release is not None)
    return tuple(script.later(delay) for script in _WRITERS[action](task))


@dataclass(frozen=True, eq=False)
class _Task:
    """Inputs of an action."""

    body: Graspable
    random: Generator
    duration: float
    side: Side
    hands: Mapping[Side, TrueHand]
    lets_go: bool

    @property
    def extent(self) -> float:
        """Share of the path that fits the duration; hands move no faster in short recordings."""
        return min(self.duration / _WHOLE_WAY, 1.0)

    def handler(self, side: Side | None = None) -> Handler:
        hand = self.hands[side or self.side]
        return Handler(hand, self.body, self.random, lets_go=self.lets_go)


def _lift(task: _Task) -> tuple[HandScript, ...]:
    """Pinch the object near its rim and raise it, a little sideways and turned."""
    handler, random, duration = task.handler(), task.random, task.duration
    grasp = handler.take()
    height = task.extent * random.uniform(0.12, 0.18)
    aside = random.uniform(-0.04, 0.04) * grasp.across + random.uniform(0.0, 0.05) * grasp.forward
    aside = task.extent * aside
    turn = random.uniform(-0.3, 0.3)

    def carry(phase: float) -> tuple[ndarray, ndarray]:
        up = np.array([0.0, 0.0, height * phase])
        return up + aside * phase**2, np.array([0.0, 0.0, turn * phase])

    return (handler.script(grasp, [(0.0, duration, carry)]),)


def _fold(task: _Task) -> tuple[HandScript, ...]:
    """Pinch the object near its rim and lay it over towards the other side."""
    handler, random, duration = task.handler(), task.random, task.duration
    grasp = handler.take()
    radius = handler.distance_to_middle(grasp) * random.uniform(0.75, 0.95)
    angle = task.extent * random.uniform(2.45, 2.8)

    def carry(phase: float) -> tuple[ndarray, ndarray]:
        along = radius * (1 - np.cos(angle * phase))
        up = radius * np.sin(angle * phase)
        tilt = 0.35 * phase * np.cross(_UP, grasp.place.inwards)
        return along * grasp.place.inwards + np.array([0.0, 0.0, up]), tilt

    return (handler.script(grasp, [(0.0, duration, carry)]),)


def _stretch(task: _Task) -> tuple[HandScript, ...]:
    """Pinch the object at both ends, raise it with some slack, and pull it apart."""
    random, duration = task.random, task.duration
    slack = task.extent * random.uniform(0.025, 0.04)
    height = task.extent * random.uniform(0.04, 0.08)
    slacken = random.uniform(0.3, 0.4) * duration
    strain = task.extent * _STRETCH[task.body.name] * random.uniform(0.7, 1.3)
    scripts = []
    sides: tuple[Side, Side] = ("right", "left")
    for hand_side in sides:
        handler = task.handler(hand_side)
        grasp = handler.take(end=1.0 if hand_side == "right" else -1.0)
        outwards = -grasp.place.inwards
        pull = slack + strain * handler.distance_to_middle(grasp)

        def gather(phase: float, outwards: ndarray = outwards) -> tuple[ndarray, ndarray]:
            return phase * (height * _UP - slack * outwards), np.zeros(3)

        def part(
            phase: float, outwards: ndarray = outwards, pull: float = pull
        ) -> tuple[ndarray, ndarray]:
            return height * _UP + (phase * pull - slack) * outwards, np.zeros(3)

        moves = [(0.0, slacken, gather), (slacken, duration, part)]
        scripts.append(handler.script(grasp, moves))
    return tuple(scripts)


def _squeeze(task: _Task) -> tuple[HandScript, ...]:
    """Close all fingers, let go by half, and close them again, while the hand drifts aside."""
    handler, random = task.handler(), task.random
    grasp = handler.embrace()
    drift = random.uniform(0.03, 0.06) * grasp.forward + random.uniform(-0.03, 0.03) * grasp.across
    drift = task.extent * drift
    times = np.array([0.0, 0.4, 0.6, 1.0]) * task.duration
    return (handler.squeeze_script(grasp, times, ease=random.uniform(0.4, 0.6), drift=drift),)


def _wipe(task: _Task) -> tuple[HandScript, ...]:
    """Press the flat hand on the object and rub it to and fro."""
    handler, random, duration = task.handler(), task.random, task.duration
    grasp = handler.lay_flat()
    reach = task.extent * random.uniform(0.05, 0.08)
    # A rope is rolled, anything else rubbed from side to side.
    way = grasp.forward if task.body.dimension == 1 else grasp.across
    turn = random.uniform(-0.25, 0.25)
    legs = [(0.0, 0.3, 0.0, 1.0), (0.3, 0.7, 1.0, -0.6), (0.7, 1.0, -0.6, 0.7)]

    def rub(first: float, last: float) -> Callable[[float], tuple[ndarray, ndarray]]:
        def carry(phase: float) -> tuple[ndarray, ndarray]:
            share = first + phase * (last - first)
            return reach * share * way, np.array([0.0, 0.0, turn * share])

        return carry

    moves = [(a * duration, b * duration, rub(first, last)) for a, b, first, last in legs]
    return (handler.script(grasp, moves),)


def _push(task: _Task) -> tuple[HandScript, ...]:
    """Push the object over the ground with the index finger."""
    handler, random, duration = task.handler(), task.random, task.duration
    grasp = handler.point_at()
    distance = task.extent * random.uniform(0.08, 0.12)
    bow = task.extent * random.uniform(-0.02, 0.02)

    def carry(phase: float) -> tuple[ndarray, ndarray]:
        return phase * distance * grasp.forward + bow * phase**2 * grasp.across, np.zeros(3)

    return (handler.script(grasp, [(0.0, duration, carry)]),)


_WRITERS: dict[str, Callable[[_Task], tuple[HandScript, ...]]] = {
    "lift": _lift,
    "fold": _fold,
    "stretch": _stretch,
    "squeeze": _squeeze,
    "wipe": _wipe,
    "push": _push,
}
