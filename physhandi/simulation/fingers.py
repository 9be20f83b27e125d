"""The fingers of a steered hand: each bends by itself, and follows its tip within its joints.

A finger is a chain of three joints that bend, the first of which also swings to the sides. Its pose
is known for each of `CURLS`, in which all fingers close together; bends come on top of that. Points
are moved by the product of exponentials of Brockett (1984), about axes as they are before the bend.
A tip is followed by the method of Levenberg and Marquardt (damped least squares) on the four angles
of its finger, of which those that stand at a limit and push against it are left out.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation

CURLS = np.linspace(-1.0, 1.0, 17)
"""Curls of the fingers for which the shape of a hand is known; in between it is interpolated."""
FINGERS = ("thumb", "index finger", "middle finger", "ring finger", "little finger")
"""Fingers in the order of their joints."""
BENDS = 20
"""Angles by which fingers are bent: of each its swing to the side, then its three joints from the
knuckle on."""
_MOST_STEPS, _LONGEST_STEP = 100, 0.2
"""Steps of following a tip, and how far a joint turns in one at most [rad]: farther, a finger that
shall go back would roll up instead, from where no small turn brings it nearer."""
_THERE, _STILL = 1e-5, 1e-7
"""A tip that is nearer to its target than this part of its finger's length has arrived, and so has
one whose joints turn by less than this in a step [rad]."""
_LEAST_DAMPING, _MOST_DAMPING = 1e-9, 1e6
"""Of a step, as parts of the squared lengths of the finger's links."""


def curled(shapes: Float[ndarray, "curl point 3"], curl: float) -> Float[ndarray, "point 3"]:
    """Interpolate points of a hand between `CURLS` [m].

    Args:
        shapes: The points for each of `CURLS`, or one row for a hand whose fingers do not move [m].
        curl: How far the fingers are closed.
    """
    if len(shapes) == 1:
        return shapes[0]
    place = float(np.interp(curl, CURLS, np.arange(len(CURLS))))
    low = min(int(place), len(CURLS) - 2)
    share = place - low
    # One of the two alone where the curl is a sample, so that a hand that is not curled keeps bits.
    if share in {0.0, 1.0}:
        return shapes[low + int(share)]
    return (1.0 - share) * shapes[low] + share * shapes[low + 1]


@dataclass(frozen=True, kw_only=True, eq=False)
class Fingers:
    """Joints of the five fingers of a hand, its wrist in the pose of zero, and what hangs on them.

    Joints follow each other finger by finger, from the knuckle to the tip.
    """

    origin: Float[ndarray, "curl joint 3"]
    """Where each of the 15 joints is, for each of `CURLS` [m]."""
    axis: Float[ndarray, "curl joint 3"]
    """Unit axis about which it bends; a positive angle closes the finger."""
    swing_axis: Float[ndarray, "finger 3"]
    """Unit axis about which each finger swings to the side at its first joint; a positive angle
    takes it away from the thumb."""
    tip: Float[ndarray, "curl finger 3"]
    """Where the fingertips are [m]."""
    turn: Float[ndarray, "curl joint"]
    """How far each joint is turned by a curl [rad]."""
    low: Float[ndarray, " bend"]
    """How far each of the `BENDS` goes back at most, together with what the curl turns [rad]."""
    high: Float[ndarray, " bend"]
    """How far it goes on at most, likewise [rad]."""
    weight: Float[ndarray, "point joint"]
    """How much each point moves with each joint; what is left of one stays with the palm."""

    def __post_init__(self) -> None:
        curls, points = len(CURLS), len(self.weight)
        shapes = {
            "origin": (curls, 15, 3),
            "axis": (curls, 15, 3),
            "swing_axis": (5, 3),
            "tip": (curls, 5, 3),
            "turn": (curls, 15),
            "low": (BENDS,),
            "high": (BENDS,),
            "weight": (points, 15),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(
                    f"{name} of fingers has shape {value.shape} or values that are not finite; "
                    f"expected {shape}."
                )

    @property
    def back(self) -> Float[ndarray, " 3"]:
        """Unit vector out of the back of the hand: away from where its fingers close."""
        origin, axis = curled(self.origin, 0.0), curled(self.axis, 0.0)
        # Fingers bend about axes that look to the thumb in a right hand and away in a left one.
        is_right = axis[3::3].sum(axis=0) @ (origin[3] - origin[12]) > 0.0
        across = self.swing_axis[1:].sum(axis=0)
        return (-1.0 if is_right else 1.0) * across / np.linalg.norm(across)

    def of_points(self, index: Int[ndarray, " point"]) -> "Fingers":
        """Keep some of the points."""
        return replace(self, weight=self.weight[index])

    def limits(self, curl: float) -> tuple[Float[ndarray, " bend"], Float[ndarray, " bend"]]:
        """Tell how far fingers can be bent back and on [rad]; zero is never outside.

        Args:
            curl: How far all fingers are closed already.
        """
        turn = np.zeros((5, 4))
        turn[:, 1:] = curled(self.turn[:, :, None], curl).reshape(5, 3)
        turned = turn.ravel()
        return np.minimum(self.low - turned, 0.0), np.maximum(self.high - turned, 0.0)

    def bent(
        self, point: Float[ndarray, "point 3"], curl: float, bend: Float[ndarray, " bend"]
    ) -> Float[ndarray, "point 3"]:
        """Bend the fingers of a hand whose wrist is in the pose of zero.

        Args:
            point: Where its points are after the curl [m].
            curl: How far all fingers are closed already.
            bend: How far each finger is bent on top of that [rad].
        """
        turned, moved = self._motion(curl, bend)
        away = turned[:, 1:].reshape(-1, 3, 3) - np.eye(3)
        blended = np.tensordot(self.weight, away, 1)
        place = np.asarray(point, np.float64)
        return (
            place + (blended @ place[..., None])[..., 0] + self.weight @ moved[:, 1:].reshape(-1, 3)
        )

    def tips(self, curl: float, bend: Float[ndarray, " bend"]) -> Float[ndarray, "finger 3"]:
        """Tell where the fingertips are, with the arguments of `bent` [m]."""
        turned, moved = self._motion(curl, bend)
        tip = curled(self.tip, curl)
        return (turned[:, -1] @ tip[..., None])[..., 0] + moved[:, -1]

    def nails(self, curl: float, bend: Float[ndarray, " bend"]) -> Float[ndarray, "finger 3"]:
        """Tell where the backs of the tips look, with the arguments of `bent`: unit vectors."""
        last, axis = curled(self.origin, curl)[2::3], curled(self.axis, curl)[2::3]
        away = np.cross(curled(self.tip, curl) - last, axis)
        turned, _ = self._motion(curl, bend)
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        return (turned[:, -1] @ away[..., None])[..., 0]

    def follow(
        self,
        finger: int,
        target: Float[ndarray, " 3"],
        curl: float,
        bend: Float[ndarray, " bend"],
    ) -> Float[ndarray, " bend"]:
        """Bend one finger so that its tip is where it shall be, or as near as its joints let it.

        Args:
            finger: Which of `FINGERS`.
            target: Where its tip shall be, the wrist being in the pose of zero [m].
            curl: How far all fingers are closed already.
            bend: How far fingers are bent now, from which the way is looked for [rad].

        Returns:
            The bends; those of other fingers are as they were.
        """
        own = slice(4 * finger, 4 * finger + 4)
        low, high = (limit[own] for limit in self.limits(curl))
        bent = np.array(bend, np.float64)
        bent[own] = np.clip(bent[own], low, high)
        tip = curled(self.tip, curl)[finger]
        size = float(np.sum((tip - curled(self.origin, curl)[3 * finger]) ** 2))
        damping = 1e-3
        missing, jacobian = self._aim(finger, tip, target, curl, bent)
        for _ in range(_MOST_STEPS):
            if missing @ missing < _THERE**2 * size:
                break
            now = bent[own].copy()
            wish = jacobian.T @ missing
            is_free = ~(((now <= low) & (wish < 0.0)) | ((now >= high) & (wish > 0.0)))
            part = jacobian[:, is_free]
            damped = part.T @ part + damping * size * np.eye(part.shape[1])
            step = np.zeros(4)
            step[is_free] = np.linalg.solve(damped, wish[is_free])
            step *= min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), _STILL))
            bent[own] = np.clip(now + step, low, high)
            turned = float(np.abs(bent[own] - now).max())
            then = self._aim(finger, tip, target, curl, bent)
            if then[0] @ then[0] < missing @ missing:
                missing, jacobian = then
                damping = max(0.3 * damping, _LEAST_DAMPING)
            else:
                bent[own] = now
                damping *= 4.0
            if turned < _STILL or damping > _MOST_DAMPING:
                break
        return bent

    def _aim(
        self,
        finger: int,
        tip: Float[ndarray, " 3"],
        target: Float[ndarray, " 3"],
        curl: float,
        bend: Float[ndarray, " bend"],
    ) -> tuple[Float[ndarray, " 3"], Float[ndarray, "3 4"]]:
        """Tell how far a tip is from its target [m], and how each angle moves it [m/rad]."""
        turned, moved = (its[finger] for its in self._motion(curl, bend))
        place = turned[-1] @ tip + moved[-1]
        own = slice(3 * finger, 3 * finger + 3)
        origin, axis = curled(self.origin, curl)[own], curled(self.axis, curl)[own]
        # A joint is where those before it have brought it.
        columns = [np.cross(self.swing_axis[finger], place - origin[0])]
        columns += [
            np.cross(
                turned[joint] @ axis[joint] / np.linalg.norm(axis[joint]),
                place - turned[joint] @ origin[joint] - moved[joint],
            )
            for joint in range(3)
        ]
        return target - place, np.stack(columns, axis=1)

    def _motion(
        self, curl: float, bend: Float[ndarray, " bend"]
    ) -> tuple[Float[ndarray, "finger 4 3 3"], Float[ndarray, "finger 4 3"]]:
        """Tell how points behind each angle of each finger move: ``turned @ point + moved``."""
        origin = curled(self.origin, curl).reshape(5, 3, 3)
        axis = curled(self.axis, curl).reshape(5, 3, 3)
        axis = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
        origin = np.concatenate([origin[:, :1], origin], axis=1)
        vector = np.concatenate([self.swing_axis[:, None], axis], axis=1)
        vector = vector * np.reshape(bend, (5, 4, 1))
        turn = Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix().reshape(5, 4, 3, 3)
        shift = origin - (turn @ origin[..., None])[..., 0]
        turned, moved = [turn[:, 0]], [shift[:, 0]]
        for angle in range(1, 4):
            moved.append(moved[-1] + (turned[-1] @ shift[:, angle, :, None])[..., 0])
            turned.append(turned[-1] @ turn[:, angle])
        return np.stack(turned, axis=1), np.stack(moved, axis=1)

    def to_tensors(self) -> dict[str, ndarray]:
        """Give its arrays by their names."""
        return {each.name: np.ascontiguousarray(getattr(self, each.name)) for each in fields(self)}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, ndarray]) -> "Fingers":
        """Rebuild them from the arrays of `to_tensors`.

        Raises:
            ValueError: If an array is missing, unknown or inconsistent.
        """
        names = {each.name for each in fields(cls)}
        if set(tensors) != names:
            raise ValueError(
                f"Fingers need the arrays {', '.join(sorted(names))}; "
                f"got {', '.join(sorted(tensors))}."
            )
        return cls(**{name: np.asarray(tensors[name], np.float64) for name in names})
