"""MANO (Romero et al. 2017), from the user's own file as `physhandi import mano` converted it.

The model is registration-only: it is neither shipped nor downloaded. An articulation of zero is
its flat template; the file's mean pose is not added (`ManoHand.mean_articulation` has it).
"""

import os
import zipfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation
from torch import Tensor

from physhandi.errors import MissingInputError
from physhandi.hand.model import JOINT_COUNT, HandModel, HandPose
from physhandi.hand.names import HandSide
from physhandi.hand.open_hand import OpenHand
from physhandi.hand.skinning import blend, joint_turns, place, turn_bones

FOLDER_VARIABLE = "PHYSHANDI_HANDS"
MANO_JOINT = (13, 14, 15, 1, 2, 3, 4, 5, 6, 10, 11, 12, 7, 8, 9)
"""MANO's number of each joint in `JOINT_NAMES`: index, middle, pinky, ring, thumb follow its wrist.
"""
FINGERTIP_VERTEX = (744, 320, 443, 554, 671)
"""Vertices at the tips of thumb, index, middle, ring and pinky, for both sides.

MANO has no joint there; these are the ones in common use.
"""
_KEYPOINT = [0, *(index for f in range(5) for index in (3 * f + 1, 3 * f + 2, 3 * f + 3, 16 + f))]
"""Where each keypoint is in the wrist, the 15 joints and the 5 fingertips."""
_PALM = [0, 4, 7, 10, 13]
"""Bones that begin on the rigid palm: the wrist and four knuckles."""
_NAMES = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "f", "hands_mean")


def hands_folder() -> Path:
    """Folder of imported hand models: ``$PHYSHANDI_HANDS``, or else the user's data folder."""
    folder = os.environ.get(FOLDER_VARIABLE)
    return Path(folder) if folder else Path.home() / ".local/share/physhandi/hands"


@dataclass(frozen=True)
class _Bones:
    """The bones of one shape in a batch of poses, in the order of `JOINT_NAMES` after the palm."""

    joint: Float[Tensor, "16 3"]
    """Where each bone begins in the unposed hand [m]."""
    turn: Float[Tensor, "batch 15 3 3"]
    """Rotation of each joint against its parent, less the identity."""
    rotation: Float[Tensor, "batch 16 3 3"]
    """Rotation of each bone, less the identity."""
    moved: Float[Tensor, "batch 16 3"]
    """How far each bone's origin moved [m]."""


class ManoHand(HandModel):
    """MANO's shape and pose blend shapes with linear blend skinning of 778 vertices.

    The template's frame is MANO's, with the origin in the wrist (MANO's own lies elsewhere, so
    its translation is ``wrist_translation - wrist``). Faces are the file's 1,538, open at the
    wrist. A joint's rotation vector is expressed in the axes that the open hand has there, laid
    onto MANO's bones: about x it curls (negative flexes), about y it spreads, about z it twists,
    and limits and priors hold for both hands. `mano_pose` gives MANO's own rotation vectors.
    """

    kind = "mano"

    def __init__(self, arrays: dict[str, ndarray], side: HandSide) -> None:
        """Arrange MANO's arrays in the order of `JOINT_NAMES`.

        Args:
            arrays: What the imported file holds, by MANO's names [m].
            side: Which hand it is.
        """
        bone = [0, *MANO_JOINT]
        regressor = arrays["J_regressor"][bone]
        posedirs = arrays["posedirs"].reshape(-1, 3, JOINT_COUNT, 9)
        posedirs = posedirs[:, :, [joint - 1 for joint in MANO_JOINT]].reshape(-1, 3, 135)
        wrist = regressor[0] @ arrays["v_template"]
        self.side: HandSide = side
        self.faces = arrays["f"].astype(np.int64)
        self.vertex_count = len(arrays["v_template"])
        self.weight = arrays["weights"][:, bone]
        self.wrist = wrist
        self.template = arrays["v_template"] - wrist
        self.joint_position = regressor[1:] @ self.template
        tip = self.template[list(FINGERTIP_VERTEX)]
        bone_origin = np.concatenate([np.zeros((1, 3)), self.joint_position])
        self.joint_axes = _axes(bone_origin, side)
        self.keypoint_position = np.concatenate([bone_origin, tip])[_KEYPOINT]
        self._shape_change = arrays["shapedirs"]
        self._joint_change = np.einsum("jv,vck->jck", regressor, arrays["shapedirs"])
        self._pose_change = posedirs
        mean = arrays["hands_mean"].reshape(JOINT_COUNT, 3)[[j - 1 for j in MANO_JOINT]]
        self.mean_articulation = np.einsum("jca,jc->ja", self.joint_axes, mean)
        self._tensors: dict[torch.dtype, dict[str, Tensor]] = {}

    @staticmethod
    def load(side: HandSide) -> "ManoHand":
        """Load the user's MANO of one side.

        Raises:
            MissingInputError: If it was not imported, or its file is damaged; says what to do.
        """
        path = hands_folder() / f"mano_{side}.npz"
        try:
            changed = path.stat().st_mtime_ns
        except OSError:
            raise MissingInputError(
                f"The {side} hand's MANO model is missing ({path}). Register at "
                f"https://mano.is.tue.mpg.de, download MANO_{side.upper()}.pkl and run "
                f"`physhandi import mano MANO_{side.upper()}.pkl`, or use the hand model 'open'."
            ) from None
        return _read(path, changed, side)

    def __call__(
        self,
        shape: Float[Tensor, " 10"],
        articulation: Float[Tensor, "batch 15 3"],
        wrist_rotation: Float[Tensor, "batch 3"],
        wrist_translation: Float[Tensor, "batch 3"],
        scale: float | Float[Tensor, ""] = 1.0,
    ) -> HandPose:
        """Pose surface and keypoints; see `HandModel`."""
        bones = self._pose_bones(shape, articulation)
        vertex, tip = (self._skin(part, shape, bones) for part in ("", "tip_"))
        keypoint = torch.cat([bones.joint + bones.moved, tip], 1)[:, _KEYPOINT]
        wrist = (wrist_rotation, wrist_translation, scale)
        return HandPose(place(vertex, *wrist), place(keypoint, *wrist))

    def local_vertices(
        self, shape: Float[Tensor, " 10"], articulation: Float[Tensor, "batch 15 3"]
    ) -> Float[Tensor, "batch vertex 3"]:
        """Pose the surface in the wrist's frame; see `HandModel`."""
        return self._skin("", shape, self._pose_bones(shape, articulation))

    def local_keypoints(
        self, shape: Float[Tensor, " 10"], articulation: Float[Tensor, "batch 15 3"]
    ) -> Float[Tensor, "batch 21 3"]:
        """Pose the keypoints in the wrist's frame; see `HandModel`."""
        bones = self._pose_bones(shape, articulation)
        tip = self._skin("tip_", shape, bones)
        return torch.cat([bones.joint + bones.moved, tip], 1)[:, _KEYPOINT]

    def chosen_vertices(
        self,
        index: Int[Tensor, "batch point"],
        shape: Float[Tensor, " 10"],
        articulation: Float[Tensor, "batch 15 3"],
    ) -> Float[Tensor, "batch point 3"]:
        """Pose some vertices of each surface alone; see `HandModel`."""
        fixed, bones = self._constants(shape), self._pose_bones(shape, articulation)
        still = fixed["vertex"] + fixed["shape_change"] @ shape - fixed["joint_change"][0] @ shape
        change = fixed["pose_change"].unflatten(1, (-1, 3)).movedim(0, 2)
        shaped, weight, change = (
            part.index_select(0, index.flatten()).unflatten(0, index.shape)
            for part in (still, fixed["weight"], change)
        )
        shaped = shaped + torch.einsum("bpck,bk->bpc", change, bones.turn.flatten(1))
        return blend(shaped, weight, bones.joint, bones.rotation, bones.moved)

    def bone_origins(self, shape: Float[Tensor, " 10"]) -> Float[Tensor, "16 3"]:
        """Compute where the bones begin in the unposed hand: the wrist, then the 15 joints [m]."""
        fixed = self._constants(shape)
        joint = fixed["joint"] + fixed["joint_change"] @ shape
        return joint - joint[:1]

    def wrist_position(self, shape: Float[ndarray, " 10"]) -> Float[ndarray, " 3"]:
        """Compute where the wrist of the unposed hand is in MANO's own frame [m].

        MANO turns about it, so a wrist's translation is this plus MANO's ``transl``.
        """
        return self.wrist + self._joint_change[0] @ shape

    def mano_pose(self, articulation: Float[ndarray, "frame 15 3"]) -> Float[ndarray, "frame 45"]:
        """Convert an articulation to MANO's pose (axis-angle, MANO's frame and order) [rad]."""
        turned = np.einsum("jca,fja->fjc", self.joint_axes, articulation)
        order = np.argsort(MANO_JOINT)
        return turned[:, order].reshape(len(articulation), 45)

    def articulation(self, mano_pose: Float[ndarray, "frame 45"]) -> Float[ndarray, "frame 15 3"]:
        """Convert MANO's pose to an articulation, the inverse of `mano_pose` [rad]."""
        turned = mano_pose.reshape(-1, JOINT_COUNT, 3)[:, [joint - 1 for joint in MANO_JOINT]]
        return np.einsum("jca,fjc->fja", self.joint_axes, turned)

    def _pose_bones(
        self, shape: Float[Tensor, " 10"], articulation: Float[Tensor, "batch 15 3"]
    ) -> _Bones:
        axes = self._constants(articulation)["joint_axes"]
        turn = joint_turns(articulation, axes)
        joint = self.bone_origins(shape)
        return _Bones(joint, turn, *turn_bones(turn, joint))

    def _skin(
        self, part: str, shape: Float[Tensor, " 10"], bones: _Bones
    ) -> Float[Tensor, "batch point 3"]:
        fixed = self._constants(bones.turn)
        # The wrist moves with the shape; the hand stays where its wrist is.
        wrist = fixed["joint_change"][0] @ shape
        shaped = fixed[f"{part}vertex"] + fixed[f"{part}shape_change"] @ shape - wrist
        bulge = bones.turn.flatten(1) @ fixed[f"{part}pose_change"]
        shaped = shaped + bulge.unflatten(1, (-1, 3))
        return blend(shaped, fixed[f"{part}weight"], bones.joint, bones.rotation, bones.moved)

    def _constants(self, like: Tensor) -> dict[str, Tensor]:
        if like.dtype not in self._tensors:
            joint = np.concatenate([np.zeros((1, 3)), self.joint_position])
            arrays = {"joint": joint, "joint_change": self._joint_change}
            arrays["joint_axes"] = self.joint_axes
            for part, chosen in (("", slice(None)), ("tip_", list(FINGERTIP_VERTEX))):
                change = self._pose_change[chosen]
                arrays |= {
                    f"{part}vertex": self.template[chosen],
                    f"{part}weight": self.weight[chosen],
                    f"{part}shape_change": self._shape_change[chosen],
                    f"{part}pose_change": change.reshape(-1, 135).T.copy(),
                }
            self._tensors[like.dtype] = {
                name: torch.as_tensor(array).to(like) for name, array in arrays.items()
            }
        return self._tensors[like.dtype]


@cache
def _read(path: Path, _changed: int, side: HandSide) -> ManoHand:
    """Read an imported file; `_changed`, its time of change, keys the cache."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            return ManoHand({name: stored[name] for name in _NAMES}, side)
    except (OSError, ValueError, KeyError, IndexError, zipfile.BadZipFile) as error:
        raise MissingInputError(
            f"The {side} hand's MANO model {path} is damaged ({error}); import it again with "
            f"`physhandi import mano MANO_{side.upper()}.pkl`."
        ) from error


def _axes(bone_origin: Float[ndarray, "16 3"], side: HandSide) -> Float[ndarray, "15 3 3"]:
    """Lay the open hand's axes onto other bones: with the palm, then along each bone.

    A thumb's axes cannot be told from its bones alone, so they come from a hand that has them. A
    last bone goes on as the one before it, since a vertex at the tip is not the bone's end.
    """
    pattern = OpenHand.load(side)
    origin = np.concatenate([np.zeros((1, 3)), pattern.joint_position])
    centred = [points[_PALM] - points[_PALM].mean(0) for points in (bone_origin, origin)]
    palm = Rotation.align_vectors(*centred)[0].as_matrix()
    bones, laid = (np.diff(points[1:].reshape(5, 3, 3), axis=1) for points in (origin, bone_origin))
    axes = np.empty((5, 3, 3, 3))
    for finger, frames in enumerate(pattern.joint_axes.reshape(5, 3, 3, 3)):
        for link in range(3):
            bone = min(link, 1)
            before, after = palm @ bones[finger, bone], laid[finger, bone]
            aligned = Rotation.align_vectors(after[None], before[None])[0].as_matrix()
            axes[finger, link] = aligned @ palm @ frames[link]
    return axes.reshape(JOINT_COUNT, 3, 3)
