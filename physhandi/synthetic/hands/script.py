"""Motion of a scripted hand: smooth moves between key poses, with a permanent tremor."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from physhandi.data.sequence_meta import Side
from physhandi.synthetic.hands.true_hand import BONE_COUNT, TrueHandPose

TREMOR_FREQUENCY = 6.0
"""Centre frequency of the tremor [Hz]."""
_TREMOR_BAND = 1.5
_TREMOR_WAVES = 5
_TREMOR_POSITION = 0.0003
_TREMOR_ORIENTATION = 0.003
_TREMOR_BEND = 0.004


def minimum_jerk(
    time: Float[ndarray, " frame"], start: float, end: float
) -> Float[ndarray, " frame"]:
    """Move from 0 to 1 between two times as smoothly as a reaching hand does."""
    phase = np.clip((time - start) / (end - start), 0.0, 1.0)
    return phase**3 * (10 - 15 * phase + 6 * phase**2)


class Tremor:
    """Small oscillations of a hand around 6 Hz, independent in every degree of freedom."""

    def __init__(self, random: Generator, *, level: float = 1.0) -> None:
        """Draw the waves.

        Args:
            random: Decides frequencies and phases.
            level: 1 shakes by 0.3 mm and 0.003 rad (root mean square); 0 not at all.
        """
        freedom = 6 + BONE_COUNT
        spread = random.uniform(-_TREMOR_BAND, _TREMOR_BAND, (_TREMOR_WAVES, freedom))
        self._frequency = TREMOR_FREQUENCY + spread
        self._phase = random.uniform(0, 2 * np.pi, (_TREMOR_WAVES, freedom))
        amplitude = np.repeat(
            [_TREMOR_POSITION, _TREMOR_ORIENTATION, _TREMOR_BEND], [3, 3, BONE_COUNT]
        )
        amplitude[6] = 0.0  # bone 0 is the wrist: it has no joint to shake in
        self._amplitude = level * amplitude

    def shake(self, pose: TrueHandPose, time: float) -> TrueHandPose:
        """Add the tremor at one time [s] to a pose."""
        wave = np.cos(2 * np.pi * self._frequency * time + self._phase).sum(axis=0)
        shift = self._amplitude * np.sqrt(2 / _TREMOR_WAVES) * wave
        turn = Rotation.from_rotvec(shift[3:6]) * Rotation.from_rotvec(pose.orientation)
        bend = pose.bend.copy()
        bend[:, 0] += shift[6:]
        return TrueHandPose(
            orientation=turn.as_rotvec(), position=pose.position + shift[:3], bend=bend
        )


@dataclass(frozen=True)
class HandMove:
    """One smooth move, at rest at both ends."""

    start: float
    """When it begins [s]."""
    end: float
    """When it ends [s]."""
    poses: Sequence[TrueHandPose]
    """Poses that are passed, the first and the last included, evenly along the way."""


class HandScript:
    """The motion of one hand as a function of time.

    A recording starts at time 0. What happens from `begin` up to then (reaching for the object and
    closing the fingers, unless the hand is late) belongs to the simulation but is not recorded.
    Before the first move and after `end` the hand stays where it is and only trembles.
    """

    def __init__(self, side: Side, moves: Sequence[HandMove], tremor: Tremor) -> None:
        """Chain moves.

        Args:
            side: Which hand moves.
            moves: Moves in the order of time; between two of them the hand waits.
            tremor: What is laid over them.

        Raises:
            ValueError: There is no move, a move lasts no time, or moves overlap.
        """
        if not moves or any(move.end <= move.start for move in moves):
            raise ValueError("A hand script needs moves that each last some time.")
        if any(after.start < before.end - 1e-9 for before, after in pairwise(moves)):
            raise ValueError("The moves of a hand script overlap.")
        self.side: Side = side
        """Which hand moves."""
        self.begin = min(moves[0].start, 0.0)
        """When the hand starts to move [s]; 0 if that is within the recording."""
        self.end = moves[-1].end
        """When it has arrived [s]."""
        self._moves = tuple(moves)
        self._paths = tuple(_Path(move.poses) for move in moves)
        self._tremor = tremor

    def later(self, delay: float) -> "HandScript":
        """Do the same so much later [s]; until then the hand waits where it begins."""
        moves = [replace(m, start=m.start + delay, end=m.end + delay) for m in self._moves]
        return HandScript(self.side, moves, self._tremor)

    def at(self, time: float) -> TrueHandPose:
        """Compute the hand's pose at a time [s]."""
        number = max(sum(move.start <= time for move in self._moves) - 1, 0)
        move = self._moves[number]
        phase = float(minimum_jerk(np.array([time]), move.start, move.end)[0])
        return self._tremor.shake(self._paths[number].at(phase), time)


class _Path:
    """A smooth curve through poses, the orientations relative to the first one."""

    def __init__(self, poses: Sequence[TrueHandPose]) -> None:
        self._first = Rotation.from_rotvec(poses[0].orientation)
        relative = [
            (Rotation.from_rotvec(pose.orientation) * self._first.inv()).as_rotvec()
            for pose in poses
        ]
        values = np.stack(
            [
                np.concatenate([turn, pose.position, np.ravel(pose.bend)])
                for turn, pose in zip(relative, poses, strict=True)
            ]
        )
        self._fixed = values[0]
        knots = np.linspace(0.0, 1.0, len(values))
        degree = min(3, len(values) - 1)
        self._curve = make_interp_spline(knots, values, k=degree) if degree else None

    def at(self, phase: float) -> TrueHandPose:
        value = self._fixed if self._curve is None else self._curve(phase)
        return TrueHandPose(
            orientation=(Rotation.from_rotvec(value[:3]) * self._first).as_rotvec(),
            position=value[3:6].copy(),
            bend=value[6:].reshape(BONE_COUNT, 3).copy(),
        )
