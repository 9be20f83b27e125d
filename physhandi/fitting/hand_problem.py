"""One hand of a sequence: what was seen of it, and the parameters that explain it."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation
from torch import Tensor

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence
from physhandi.errors import FitError
from physhandi.fitting.hand_config import HandFitConfig
from physhandi.fitting.hand_depth import DepthTarget, depth_loss, depth_target
from physhandi.fitting.hand_initialisation import WristGuess, guess_wrist
from physhandi.fitting.hand_losses import (
    KeypointTarget,
    acceleration_loss,
    keypoint_target,
    limit_loss,
    reprojection_loss,
    velocity_loss,
)
from physhandi.hand.model import HandModel
from physhandi.hand.motion import HandMotion
from physhandi.hand.rotation import quaternion_matrix
from physhandi.progress import Preview, Progress

STAGE = "hand_reconstruction"


@dataclass(frozen=True, eq=False)
class SolvedHand:
    """The fit of one hand."""

    motion: HandMotion
    """Its motion."""
    loss_before: float
    """Loss of the first guess, without depth."""
    loss_after: float
    """Loss of the result, without depth."""
    curve: list[tuple[int, float]]
    """Loss of every tenth iteration."""


class HandProblem:
    """One hand: what was seen of it, and the parameters that explain it."""

    def __init__(
        self,
        sequence: Sequence,
        keypoint: Float[ndarray, "view frame 21 3"],
        model: HandModel,
        config: HandFitConfig,
    ) -> None:
        self.model, self.config, self.metric = model, config, sequence.metric
        cameras: list[PinholeCamera] = [view.camera for view in sequence.views]
        self.target: KeypointTarget = keypoint_target(cameras, keypoint, config.keypoint_noise)
        tolerance = config.agreement * float(self.target.noise.max())
        guess = guess_wrist(cameras, keypoint, model, metric=sequence.metric, tolerance=tolerance)
        self.frame_rate = sequence.frame_rate
        self.parameters = _parameters(guess, len(keypoint[0]))
        self.name = sequence.name
        self.joints: Tensor | None = None
        """The 21 keypoints of every frame, as the latest loss saw them."""
        self.depth: DepthTarget | None = None
        if sequence.metric and config.depth_iterations:
            self.depth = depth_target(sequence, model.side, config.depth_points)

    def hand(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Shape, wrist rotation, wrist position [m] and scale."""
        p = self.parameters
        rotation = quaternion_matrix(p["rotation"])
        return 3 * torch.tanh(p["shape"] / 3), rotation, p["translation"], p["log_scale"].exp()

    def loss(self, breadth: float) -> Tensor:
        """Compute the loss without depth."""
        config, articulation = self.config, self.parameters["articulation"]
        shape, rotation, translation, scale = self.hand()
        still = torch.zeros_like(translation)
        local = self.model.keypoints(shape, articulation, still, still)
        metres = local @ rotation.transpose(-1, -2) + translation[:, None]
        self.joints = (metres * scale).detach()
        reach = config.acceleration_noise / self.frame_rate**2
        turn = config.turn_noise * 30 / self.frame_rate
        return (
            reprojection_loss(metres * scale, self.target, breadth)
            + config.limit_weight * limit_loss(articulation, self.model)
            + config.pose_weight * (articulation**2).sum() / len(articulation)
            + config.shape_weight * (self.parameters["shape"] ** 2).sum()
            + acceleration_loss(metres) / reach**2
            + velocity_loss(articulation) / turn**2
        )

    def depth_term(self, target: DepthTarget) -> Tensor:
        """Compute the weighted depth loss."""
        shape, rotation, translation, _ = self.hand()
        still = torch.zeros_like(translation)
        local = self.model(shape, self.parameters["articulation"], still, still).vertex
        vertex = local @ rotation.transpose(-1, -2) + translation[:, None]
        faces = torch.from_numpy(self.model.faces)
        return self.config.depth_weight * depth_loss(vertex, faces, target, self.config.depth_noise)

    def solve(self, progress: Progress) -> SolvedHand:
        """Fit to keypoints, then to keypoints and depth."""
        config = self.config
        with torch.no_grad():
            before = float(self.loss(config.doubt))
        curve: list[tuple[int, float]] = []
        total = config.iterations + (config.depth_iterations if self.depth else 0)

        def widening(iteration: int) -> float:
            share = min(iteration / (0.6 * config.iterations), 1.0)
            return config.doubt * 10 ** (1 - share)

        def step(iteration: int, loss: Tensor) -> None:
            progress.check_cancelled()
            if iteration % 10 == 0 or iteration == total:
                value = float(loss.detach())
                curve.append((iteration, value))
                message = f"{self.model.side.capitalize()} hand"
                progress.report(STAGE, iteration, total, value, message)
                self._show(value, progress)

        with _one_thread():
            self._descend(
                config.iterations, config.learning_rate, lambda i: self.loss(widening(i)), step, 0
            )
            if self.depth is not None:
                depth = self.depth
                self._descend(
                    config.depth_iterations,
                    config.learning_rate / 4,
                    lambda _: self.loss(config.doubt) + self.depth_term(depth),
                    step,
                    config.iterations,
                )
        with torch.no_grad():
            after = float(self.loss(config.doubt))
        if not math.isfinite(after):
            raise FitError(
                f"The fit of the {self.model.side} hand did not stay finite (loss {after})."
            )
        return SolvedHand(self._motion(), before, after, curve)

    def _show(self, loss: float, progress: Progress) -> None:
        """Let people see the hand as it is."""
        joints = self.joints
        if joints is not None and progress.wants_preview():
            progress.preview(
                lambda: Preview(
                    stage=STAGE,
                    sequence=self.name,
                    loss=loss,
                    frame_rate=self.frame_rate,
                    points={"joints": joints.numpy()},
                )
            )

    def _descend(
        self,
        iterations: int,
        rate: float,
        loss_at: Callable[[int], Tensor],
        step: Callable[[int, Tensor], None],
        first: int,
    ) -> None:
        share = {
            "shape": 2.0,
            "articulation": 1.0,
            "rotation": 0.3,
            "translation": 0.1,
            "log_scale": 0.1,
        }
        groups = [
            {"params": [value.requires_grad_()], "lr": rate * share[name]}
            for name, value in self.parameters.items()
            if not (self.metric and name == "log_scale")
        ]
        optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda i: 0.05 + 0.475 * (1 + math.cos(math.pi * i / iterations))
        )
        for iteration in range(iterations):
            optimizer.zero_grad()
            loss = loss_at(iteration)
            loss.backward()
            optimizer.step()
            schedule.step()
            step(first + iteration + 1, loss)

    def _motion(self) -> HandMotion:
        with torch.no_grad():
            shape, rotation, translation, scale = self.hand()
        turn = Rotation.from_matrix(rotation.numpy()).as_rotvec()
        return HandMotion(
            side=self.model.side,
            model=self.model.kind,
            shape=shape.numpy().astype(np.float32),
            articulation=self.parameters["articulation"].detach().numpy().copy(),
            wrist_rotation=_without_jumps(turn).astype(np.float32),
            wrist_translation=translation.detach().numpy().copy(),
            scale=1.0 if self.metric else float(scale),
        )


@contextmanager
def _one_thread() -> Iterator[None]:
    """Keep torch from spreading small tensors over busy cores, which costs more than it gains."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _parameters(guess: WristGuess, frame_count: int) -> dict[str, Tensor]:
    articulation = torch.zeros(frame_count, 15, 3)
    articulation[:, 3:, 0] = -0.3
    return {
        "shape": torch.zeros(10),
        "articulation": articulation,
        "rotation": torch.tensor(guess.rotation, dtype=torch.float32),
        "translation": torch.tensor(guess.translation, dtype=torch.float32),
        "log_scale": torch.tensor(math.log(guess.scale), dtype=torch.float32),
    }


def _without_jumps(vector: Float[ndarray, "frame 3"]) -> Float[ndarray, "frame 3"]:
    """Describe each rotation by whichever of its two vectors is nearer to the frame before."""
    vector = vector.copy()
    for frame in range(1, len(vector)):
        angle = np.linalg.norm(vector[frame])
        other = vector[frame] * (1 - 2 * np.pi / max(angle, 1e-9))
        near, far = (np.linalg.norm(v - vector[frame - 1]) for v in (vector[frame], other))
        if far < near and angle > 1e-3:
            vector[frame] = other
    return vector
