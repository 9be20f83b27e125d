"""A hand of two sticks that closes and lifts, to try engines without the real hand."""

from dataclasses import dataclass

import numpy as np

from physhandi.synthetic.hands.true_hand import Capsule, TrueHandPose


@dataclass(frozen=True)
class Gripper:
    """Two sticks along y, one at each side of the origin in x; bend moves both to the middle."""

    gap: float
    length: float = 0.04
    radius: float = 0.008

    @property
    def capsules(self):
        half = np.array([0.0, self.length / 2, 0.0])
        return tuple(
            Capsule(bone=bone, start=middle - half, end=middle + half, radius=self.radius)
            for bone, middle in enumerate(self._middles())
        )

    def _middles(self):
        offset = np.array([self.gap / 2 + self.radius, 0.0, 0.0])
        return -offset, offset

    def bone_transforms(self, pose):
        transforms = np.tile(np.eye(4), (2, 1, 1))
        transforms[:, :3, 3] = pose.position
        transforms[0, 0, 3] += pose.bend[0, 0]
        transforms[1, 0, 3] -= pose.bend[0, 0]
        return transforms


@dataclass(frozen=True)
class PinchAndLift:
    """Close by `squeeze` within 0.2 s, then rise by `height` until `end`."""

    place: tuple[float, float, float]
    squeeze: float
    height: float
    end: float = 1.0
    side: str = "right"
    begin: float = 0.0

    def at(self, time):
        closed = self.squeeze * smooth(time / 0.2)
        rise = self.height * smooth((time - 0.3) / (self.end - 0.3))
        return TrueHandPose(
            orientation=np.zeros(3),
            position=np.add(self.place, [0.0, 0.0, rise]),
            bend=np.array([[closed, 0.0, 0.0]]),
        )


def smooth(phase):
    phase = np.clip(phase, 0.0, 1.0)
    return phase**3 * (10 - 15 * phase + 6 * phase**2)
