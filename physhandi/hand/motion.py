"""A hand's motion: one shape, and the pose of every frame."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from physhandi.hand.model import HandModel
from physhandi.hand.names import HandKind, HandSide

_BATCH = 128
_SIDES: tuple[HandSide, HandSide] = ("right", "left")
_MODELS: tuple[HandKind, HandKind] = ("open", "mano")


@dataclass(frozen=True, kw_only=True, eq=False)
class HandMotion:
    """Shape, articulation and wrist pose of one hand over all frames of a sequence."""

    side: HandSide
    """Which hand it is."""
    shape: Float[ndarray, " 10"]
    """Shape coefficients, constant over the sequence."""
    articulation: Float[ndarray, "frame 15 3"]
    """Rotation vector of every joint in its bone's frame [rad]."""
    wrist_rotation: Float[ndarray, "frame 3"]
    """Rotation vector of the hand about the wrist [rad]."""
    wrist_translation: Float[ndarray, "frame 3"]
    """Position of the wrist in the world frame [m, before `scale`]."""
    scale: float = 1.0
    """Length units of the sequence per metre; 1 when it is metric."""
    model: HandKind = "open"
    """Hand model whose shape and articulation these are; `load_hand_model` takes it."""

    @property
    def frame_count(self) -> int:
        """Frames that the motion covers."""
        return len(self.articulation)

    def vertices(self, model: HandModel) -> Float[ndarray, "frame vertex 3"]:
        """Compute the surface in every frame [length unit of the sequence], in float32."""
        return self._posed(model, lambda *pose: model(*pose).vertex)

    def keypoints(self, model: HandModel) -> Float[ndarray, "frame 21 3"]:
        """Compute the keypoints in every frame [length unit of the sequence], in float32."""
        return self._posed(model, model.keypoints)

    def _posed(self, model: HandModel, points: Callable[..., Tensor]) -> ndarray:
        """Compute points of all frames, some frames at a time."""
        if model.side != self.side:
            raise ValueError(
                f"the motion of a {self.side} hand was given a {model.side} hand model"
            )
        if model.kind != self.model:
            raise ValueError(
                f"the motion of the hand model '{self.model}' was given the model '{model.kind}'"
            )
        arrays = (self.articulation, self.wrist_rotation, self.wrist_translation)
        shape = torch.from_numpy(self.shape.astype(np.float32))
        with torch.no_grad():
            batches = [
                points(
                    shape,
                    *(
                        torch.from_numpy(a[start : start + _BATCH].astype(np.float32))
                        for a in arrays
                    ),
                    self.scale,
                )
                for start in range(0, self.frame_count, _BATCH)
            ]
        return np.concatenate([batch.numpy() for batch in batches])

    def to_tensors(self) -> dict[str, ndarray]:
        """Describe the motion as arrays, as a run's ``hand_<side>.safetensors`` holds it."""
        return {
            "side": np.array(_SIDES.index(self.side), dtype=np.int32),
            "shape": self.shape.astype(np.float32),
            "articulation": self.articulation.astype(np.float32),
            "wrist_rotation": self.wrist_rotation.astype(np.float32),
            "wrist_translation": self.wrist_translation.astype(np.float32),
            "scale": np.array(self.scale, dtype=np.float64),
            "model": np.array(_MODELS.index(self.model), dtype=np.int32),
        }

    @classmethod
    def from_tensors(cls, tensors: dict[str, ndarray]) -> "HandMotion":
        """Build a motion from what `to_tensors` returned.

        Without ``model``, as runs of version 0.1 stored it, the motion is the open hand's.

        Raises:
            ValueError: If an array is missing, has the wrong shape or is not finite.
        """
        names = ("side", "shape", "articulation", "wrist_rotation", "wrist_translation", "scale")
        model = tensors.get("model", np.array(0))
        missing = [name for name in names if name not in tensors]
        if missing:
            raise ValueError(f"hand motion lacks the array {missing[0]!r}")
        frame_count = len(np.atleast_1d(tensors["articulation"]))
        shapes = ((), (10,), (frame_count, 15, 3), (frame_count, 3), (frame_count, 3), ())
        for name, expected in zip(names, shapes, strict=True):
            array = tensors[name]
            if array.shape != expected or not np.isfinite(array).all():
                raise ValueError(
                    f"hand motion's {name!r} must be finite numbers of shape {expected}, "
                    f"not of shape {array.shape}"
                )
        if int(tensors["side"]) not in {0, 1}:
            raise ValueError(f"hand motion's 'side' must be 0 or 1, not {int(tensors['side'])}")
        if model.shape != () or int(model) not in {0, 1}:
            raise ValueError(f"hand motion's 'model' must be 0 or 1, not {model}")
        return cls(
            model=_MODELS[int(model)],
            side=_SIDES[int(tensors["side"])],
            shape=tensors["shape"],
            articulation=tensors["articulation"],
            wrist_rotation=tensors["wrist_rotation"],
            wrist_translation=tensors["wrist_translation"],
            scale=float(tensors["scale"]),
        )


def control_trajectory(
    motions: Sequence[HandMotion], models: Sequence[HandModel]
) -> Float[ndarray, "frame control 3"]:
    """Join the vertices of all hands into one trajectory of control nodes.

    Args:
        motions: Motion of each hand, in the order of the sequence's hands.
        models: Model of each hand, in the same order.

    Returns:
        Positions of the control nodes, hands in order [length unit of the sequence].

    Raises:
        ValueError: If there is no hand, or the hands cover different numbers of frames.
    """
    frames = [motion.frame_count for motion in motions]
    if not frames or min(frames) != max(frames):
        raise ValueError(f"control nodes need hands that cover the same frames, not {frames}")
    vertices = [motion.vertices(model) for motion, model in zip(motions, models, strict=True)]
    return np.concatenate(vertices, axis=1)
