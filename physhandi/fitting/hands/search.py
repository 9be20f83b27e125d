"""Finds how a hand that one view shows is turned and bent: fits many starts and chooses a chain.

One view's keypoints say little about depth, and a hand that is fitted to them alone ends where the
measured surface cannot bring it back. So a pose is fitted to keypoints and depth together, in some
frames, from several starts each; of what comes out, a chain over the frames is chosen.
"""

from collections.abc import Callable
from collections.abc import Sequence as Many
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from physhandi.data.camera import PinholeCamera
from physhandi.fitting.config import HandFitConfig
from physhandi.fitting.hands.losses import (
    REFRESH,
    correspond,
    distance_costs,
    keypoint_costs,
    limit_costs,
)
from physhandi.fitting.hands.observed import DepthTarget, KeypointTarget
from physhandi.fitting.hands.poses import (
    NARROWS,
    PosedHands,
    doubt_breadth,
    hand_optimizer,
    step_share,
)
from physhandi.fitting.hands.wrist_guess import WristGuess, bridge, mirrored_pose, ways_to_depth
from physhandi.hand.model import HandModel

_BENDS = (-0.1, -0.8, -1.4)
"""Angles by which every joint of the fingers is bent in the starts [rad]."""
_GAP = 0.1
"""Time between two frames that are searched [s]."""
_RATE = 0.05
"""First step size of the joints [rad]."""
_SHORTENED = 0.5
"""Share of a distance along the view that counts when corresponding vertices are looked for: aside,
keypoints put the hand right from the beginning; depth is what is to be found."""
_STEP = 0.02
"""Mean motion of the keypoints in `_GAP` that costs 1 in a chain [m]."""
_MOST_COST = 50.0
"""Most that such a motion costs."""


@dataclass(frozen=True, eq=False)
class SearchedHand:
    """Inputs of the search for one hand."""

    cameras: Many[PinholeCamera]
    """Camera of each view."""
    keypoint: Float[ndarray, "view frame 21 3"]
    """Pixel x, pixel y and confidence; NaN where not seen [px]."""
    target: KeypointTarget
    """The same, without lens distortion."""
    depth: DepthTarget
    """Measured points."""
    guess: WristGuess
    """Where the palm is, as it is or mirrored in depth."""
    model: HandModel
    """Model of the hand."""
    frame_rate: float
    """Frames in a second."""


def search_hand(
    hand: SearchedHand, config: HandFitConfig, report: Callable[[int, Tensor], None]
) -> dict[str, Tensor]:
    """Fit a hand from several starts in every tenth of a second, and choose a chain of the ends.

    The starts of a frame are the guessed palm and its mirror image, with fingers bent little, half
    and to a fist. Nothing ties frames to each other but one shape.

    Args:
        hand: What is seen of the hand, and the first guess.
        config: Settings of the fit; `search_iterations` updates are made.
        report: Receives the number of each update and its loss, summed over starts.

    Returns:
        Shape of the hand; articulation, rotation (as a quaternion) and translation of all frames.
        Frames between those that were searched are interpolated.
    """
    frames = _searched_frames(hand.guess.is_known, hand.frame_rate)
    starts = _Starts(hand, frames, config)
    for iteration in range(config.search_iterations):
        report(iteration + 1, starts.update(iteration))
    cost, keypoint = starts.outcome()
    chosen = cheapest_chain(cost, keypoint, np.diff(frames) / hand.frame_rate)
    rows = torch.from_numpy(np.arange(len(frames)) * cost.shape[1] + chosen)
    parameters = {name: value.detach() for name, value in starts.parameters.items()}
    frame_count = len(hand.guess.is_known)
    is_searched = np.zeros(frame_count, dtype=bool)
    is_searched[frames] = True
    rotation, other = np.zeros((frame_count, 4)), np.zeros((frame_count, 48))
    rotation[frames] = parameters["rotation"][rows].numpy()
    rotation[frames] /= np.linalg.norm(rotation[frames], axis=1, keepdims=True)
    other[frames, :3] = parameters["translation"][rows].numpy()
    other[frames, 3:] = parameters["articulation"][rows].flatten(1).numpy()
    rotation, other = bridge(rotation, other, is_searched)
    return {
        "shape": parameters["shape"],
        "articulation": torch.tensor(other[:, 3:], dtype=torch.float32).unflatten(1, (15, 3)),
        "rotation": torch.tensor(rotation, dtype=torch.float32),
        "translation": torch.tensor(other[:, :3], dtype=torch.float32),
    }


def _searched_frames(is_known: Bool[ndarray, " frame"], frame_rate: float) -> Int[ndarray, " some"]:
    """Choose frames in which the palm was seen, about `_GAP` apart."""
    seen = np.flatnonzero(is_known)
    wanted = np.arange(seen[0], seen[-1] + 1, max(1, round(_GAP * frame_rate)))
    return np.unique(seen[np.abs(seen - wanted[:, None]).argmin(axis=1)])


class _Starts:
    """Hands that are fitted side by side: in each frame, one from every start."""

    def __init__(
        self, hand: SearchedHand, frames: Int[ndarray, " some"], config: HandFitConfig
    ) -> None:
        self._model, self._config, self._frame_count = hand.model, config, len(frames)
        poses = []
        for frame in frames:
            pose = hand.guess.pose(int(frame))
            poses += [pose, mirrored_pose(hand.cameras, hand.keypoint[:, frame], hand.model, pose)]
        rotation = np.repeat([pose[0].as_quat() for pose in poses], len(_BENDS), axis=0)
        translation = np.repeat([pose[1] for pose in poses], len(_BENDS), axis=0)
        articulation = torch.zeros(len(rotation), 15, 3)
        articulation[:, 3:, 0] = torch.tensor(_BENDS).repeat(len(poses))[:, None]
        self.parameters = {
            "shape": torch.zeros(10),
            "articulation": articulation,
            "rotation": torch.tensor(rotation, dtype=torch.float32),
            "translation": torch.tensor(translation, dtype=torch.float32),
        }
        self._hands = PosedHands(hand.model, self.parameters)
        rows = torch.from_numpy(frames).repeat_interleave(2 * len(_BENDS))
        seen, depth = hand.target, hand.depth
        self._target = replace(seen, pixel=seen.pixel[:, rows], weight=seen.weight[:, rows])
        point, ray, weight = depth.point[rows], depth.towards_camera[rows], depth.weight[rows]
        self._depth = DepthTarget(point, ray, weight)
        self._way = torch.nn.functional.normalize(ray.sum(1, keepdim=True), dim=-1)
        self._place()
        self._optimizer = hand_optimizer(self.parameters, _RATE)

    def update(self, iteration: int) -> Tensor:
        """Descend once; returns the loss before that."""
        config, iterations = self._config, self._config.search_iterations
        if iteration % REFRESH == 0:
            self._look()
        self._optimizer.zero_grad()
        cost = self._costs(doubt_breadth(config.doubt, iteration, NARROWS * iterations))
        shape = self.parameters["shape"]
        loss = cost.sum() / self._frame_count + config.shape_weight * (shape**2).sum()
        loss.backward()
        self._optimizer.step(step_share(iteration, iterations))
        return loss.detach()

    @torch.no_grad()
    def outcome(self) -> tuple[Float[ndarray, "frame start"], Float[ndarray, "frame start 21 3"]]:
        """Compute what each hand costs now, and its keypoints [m]."""
        self._look()
        cost, point = self._costs(self._config.doubt), self._hands.keypoints()
        parts = (self._frame_count, -1)
        return cost.unflatten(0, parts).double().numpy(), point.unflatten(0, parts).numpy()

    @torch.no_grad()
    def _place(self) -> None:
        """Move each palm along the view to where depth was measured, as with half bent fingers."""
        half = slice(len(_BENDS) // 2, None, len(_BENDS))
        surface = self._hands.surface()
        vertex, normal = surface[half].numpy(), self._hands.normals(surface)[half].numpy()
        depth = self._depth
        target = DepthTarget(depth.point[half], depth.towards_camera[half], depth.weight[half])
        way = np.nan_to_num(ways_to_depth(vertex, normal, target)).repeat(len(_BENDS), axis=0)
        self.parameters["translation"] += torch.tensor(way, dtype=torch.float32)

    @torch.no_grad()
    def _look(self) -> None:
        """Look for the vertices that measured points correspond to."""
        vertex, target = self._hands.surface(), self._depth
        normal = self._hands.normals(vertex)
        shortened = replace(target, point=self._shortened(target.point))
        target.vertex = correspond(self._shortened(vertex), normal, shortened)
        target.normal = normal.gather(1, target.vertex[..., None].expand(-1, -1, 3))

    def _shortened(self, point: Float[Tensor, "hand point 3"]) -> Float[Tensor, "hand point 3"]:
        """Shorten all distances along the view."""
        along = (point * self._way).sum(-1, keepdim=True)
        return point - (1 - _SHORTENED) * along * self._way

    def _costs(self, breadth: float) -> Float[Tensor, " hand"]:
        """Compute what each hand costs by itself, with the weights of the fit that follows."""
        config, target = self._config, self._depth
        assert target.vertex is not None  # noqa: S101 - `_look` comes first
        assert target.normal is not None  # noqa: S101
        articulation = self.parameters["articulation"]
        offset = target.point - self._hands.vertices(target.vertex)
        far = distance_costs(offset, target.normal, target.weight, config.depth_noise)
        return (
            keypoint_costs(self._hands.keypoints(), self._target, breadth).sum((0, 2))
            + config.depth_weight * far.sum(1)
            + config.limit_weight * limit_costs(articulation, self._model).sum((1, 2))
            + config.pose_weight * (articulation**2).sum((1, 2))
        )


def cheapest_chain(
    cost: Float[ndarray, "frame start"],
    keypoint: Float[ndarray, "frame start 21 3"],
    time: Float[ndarray, " step"],
) -> Int[ndarray, " frame"]:
    """Choose one hand of every frame, so that hands and the ways between them cost least (Viterbi).

    Args:
        cost: What each hand costs.
        keypoint: Its keypoints [m].
        time: From each frame to the next [s].
    """
    total, source = cost[0], []
    for frame in range(1, len(cost)):
        way = keypoint[frame][:, None] - keypoint[frame - 1]
        motion = np.linalg.norm(way, axis=-1).mean(-1) * _GAP / time[frame - 1]
        ways = total + np.minimum((motion / _STEP) ** 2, _MOST_COST)
        source.append(ways.argmin(axis=1))
        total = cost[frame] + ways.min(axis=1)
    chain = [int(total.argmin())]
    for before in reversed(source):
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])
