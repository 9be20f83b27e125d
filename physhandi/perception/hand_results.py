"""Keypoints of hands that another method found, such as WiLoR or HaMeR, for a sequence on disk.

One file holds detections of any number of views, frames and hands: keypoints in pixels, joints in
space, or MANO's parameters. What is in space is projected into the views; the fit then takes it as
it takes what the built-in networks detect.
"""

import dataclasses
import hashlib
import json
import zipfile
from pathlib import Path
from typing import Any, NoReturn, cast

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

import physhandi
from physhandi.data.arrays import write_array
from physhandi.data.files import named_fields, write_yaml
from physhandi.data.length_unit import doubt_keypoints
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import FILE, SIDES
from physhandi.data.view import View
from physhandi.errors import ImportFailedError, UsageError
from physhandi.hand.mano import ManoHand
from physhandi.perception.keypoints import KeypointDetector, detect_view
from physhandi.progress import NullProgress, Progress

HANDS_FORMAT = "physhandi-hands/1"
"""Format name in a file of results."""
_MOST_BYTES = 1 << 30
"""Size of the largest file, unpacked, that is read [byte]."""
_PALMS = (0.04, 0.2)
"""Distance of the middle finger's knuckle from the wrist that a hand can have [m]."""
_MANO = ("global_orient", "hand_pose", "betas")
_TEXTS = ("side", "view")
_NUMBERS: dict[str, tuple[tuple[int, ...], ...]] = {
    "frame": ((),),
    "confidence": ((),),
    "keypoint": ((21, 3), (21, 2)),
    "joint": ((21, 3),),
    "global_orient": ((3,), (3, 3), (1, 3), (1, 3, 3)),
    "hand_pose": ((45,), (15, 3), (15, 3, 3)),
    "betas": ((10,),),
    "translation": ((3,),),
    "focal_length": ((),),
}
"""Shapes that a field of numbers may have for one detection."""


def import_hands(
    folder: Path | str,
    path: Path | str,
    progress: Progress | None = None,
    *,
    fills_gaps: bool = False,
    overwrite: bool = False,
) -> Sequence:
    """Take over the keypoints of a sequence's hands from a file of results.

    Every view that the file speaks of gets its ``keypoint.npy``; fits look into the others as
    before. ``provenance.keypoints`` says where they come from.

    Args:
        folder: Folder of the sequence.
        path: The results, ``.json`` or ``.npz`` (docs/formats.md, "Hands that another method
            found").
        progress: Told while gaps are filled; may cancel.
        fills_gaps: Whether the built-in networks look for hands where the file has none.
        overwrite: Whether keypoints may be replaced that did not come from such a file.

    Returns:
        The sequence as it is now.

    Raises:
        ImportFailedError: If the file is not what the format says; names file, field, detection.
        MissingInputError: If MANO's parameters are given and the user's MANO is missing.
        UsageError: If there are keypoints that came from elsewhere.
        CancelledError: If the user asked to stop; nothing was changed then.
    """
    sequence, path = Sequence.load(Path(folder)), Path(path)
    results = _Results(path, sequence)
    keypoints = results.keypoints()
    views = {view.name: view for view in sequence.views}
    for name, keypoint in keypoints.items():
        camera = views[name].camera
        doubt = doubt_keypoints(keypoint, camera.width, camera.height)
        if doubt is not None:
            (frame, hand, joint), what = doubt
            raise ImportFailedError(
                f"{path}: in view '{name}', frame {frame}, keypoint {joint} of the "
                f"{sequence.hands[hand]} hand {what}."
            )
    if not overwrite:
        _check_own_keypoints(sequence, list(keypoints))
    if fills_gaps:
        detector = KeypointDetector()
        for name, keypoint in keypoints.items():
            view = views[name]
            if view.has_color and np.isnan(keypoint).any():
                watch = progress or NullProgress()
                detected = detect_view(view, sequence.hands, watch, detector)
                is_gap = np.isnan(keypoint).all(axis=(2, 3))
                keypoint[is_gap] = detected[is_gap]
                view.close()
    for name, keypoint in keypoints.items():
        write_array(views[name].folder / "keypoint.npy", keypoint)
    about = {
        "source": results.source,
        "views": list(keypoints),
        "file_sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "gaps_filled": fills_gaps,
        "version": physhandi.__version__,
    }
    provenance = {**sequence.provenance, "keypoints": about}
    meta = dataclasses.replace(sequence.meta, provenance=provenance)
    write_yaml(sequence.folder / FILE, meta.to_dict())
    return Sequence.load(sequence.folder)


def _check_own_keypoints(sequence: Sequence, names: list[str]) -> None:
    about: Any = sequence.provenance.get("keypoints")
    own = about.get("views", []) if isinstance(about, dict) and "file_sha256" in about else []
    for view in sequence.views:
        if view.name in names and view.has_keypoint and view.name not in own:
            raise UsageError(
                f"Sequence '{sequence.name}': view '{view.name}' has a keypoint.npy that did not "
                "come from such a file. Allow overwriting to replace it."
            )


class _Results:
    """The detections of a file."""

    def __init__(self, path: Path, sequence: Sequence) -> None:
        self._path, self._sequence = path, sequence
        fields = _read(path)
        if str(fields.pop("format", "")) != HANDS_FORMAT:
            self._fail("format", None, f"must be '{HANDS_FORMAT}'")
        self.source = str(fields.pop("source", "") or "another method")
        self._mirrors = bool(fields.pop("left_is_mirrored_right", False))
        unknown = sorted(set(fields) - {*_TEXTS, *_NUMBERS})
        if unknown:
            self._fail(unknown[0], None, "is not a field of this format")
        for name in ("frame", "side"):
            if name not in fields:
                self._fail(name, None, "is missing; every detection needs it")
        self._count = int(np.size(np.asarray(fields["frame"], dtype=object)))
        if self._count == 0:
            self._fail("frame", None, "is empty: there is no detection")
        self._text = {name: self._texts(name, fields[name]) for name in _TEXTS if name in fields}
        self._number = {
            name: self._numbers(name, fields[name]) for name in _NUMBERS if name in fields
        }
        self._kind = self._chosen_kind()
        self._check()

    def _chosen_kind(self) -> str:
        """Tell what the detections are made of, if all that belongs to it is there."""
        kinds = [name for name in ("keypoint", "joint", "hand_pose") if name in self._number]
        if len(kinds) != 1:
            self._fail(
                "keypoint", None, "or joint, or hand_pose is needed, and only one of the three"
            )
        for name in _MANO if kinds[0] == "hand_pose" else ():
            if name not in self._number:
                self._fail(name, None, "is missing; MANO needs it")
        if kinds[0] == "keypoint" and "view" not in self._text:
            self._fail("view", None, "is missing; pixels need it")
        if "focal_length" in self._number and "view" not in self._text:
            self._fail("view", None, "is missing; a focal length belongs to a view's camera")
        return kinds[0]

    def keypoints(self) -> dict[str, Float[ndarray, "frame hand 21 3"]]:
        """Lay the detections out as sequences keep them; of two of one hand the surer counts."""
        views = {view.name: view for view in self._sequence.views}
        named = self._text.get("view")
        shown = list(dict.fromkeys(named)) if named is not None else list(views)
        shape = (self._sequence.frame_count, len(self._sequence.hands), 21, 3)
        keypoints = {name: np.full(shape, np.nan, dtype=np.float32) for name in shown}
        best = {name: np.full(shape[:2], -1.0) for name in shown}
        sure = self._number.get("confidence", np.ones(self._count))
        joint = None if self._kind == "keypoint" else self._joints()
        for number in range(self._count):
            frame = int(self._number["frame"][number])
            hand = self._sequence.hands.index(cast("Any", self._text["side"][number]))
            for name in [named[number]] if named is not None else shown:
                if sure[number] <= best[name][frame, hand]:
                    continue
                if joint is None:
                    pixel = self._number["keypoint"][number]
                else:
                    pixel = self._projected(views[name], joint[number], number)
                    if np.isnan(pixel).any():
                        continue
                best[name][frame, hand] = sure[number]
                keypoints[name][frame, hand, :, :2] = pixel[:, :2]
                keypoints[name][frame, hand, :, 2] = (
                    pixel[:, 2] if pixel.shape[1] == 3 else sure[number]
                )
        return keypoints

    def _projected(
        self, view: View, joint: Float[ndarray, "21 3"], number: int
    ) -> Float[ndarray, "21 2"]:
        """Find the pixels of joints; NaN if they are behind a camera that they do not belong to."""
        if "view" not in self._text:
            return view.camera.project(joint)
        if (joint[:, 2] <= 0).any():
            self._fail(
                self._kind, number, "lies behind the camera; x is right, y down and z forward"
            )
        if "focal_length" in self._number:
            middle = np.array([view.camera.width, view.camera.height]) / 2
            return self._number["focal_length"][number] * joint[:, :2] / joint[:, 2:] + middle
        pose = view.camera.T_world_camera
        return view.camera.project(joint @ pose[:3, :3].T + pose[:3, 3])

    def _joints(self) -> Float[ndarray, "detection 21 3"]:
        if self._kind == "joint":
            joint = self._number["joint"]
            shift = self._number.get("translation")
            joint = joint if shift is None else joint + shift[:, None]
        else:
            joint = self._posed()
        palm = np.linalg.norm(joint[:, 9] - joint[:, 0], axis=1)
        is_metric = "view" in self._text or self._sequence.length_unit == "m"
        wrong = np.flatnonzero((palm < _PALMS[0]) | (palm > _PALMS[1])) if is_metric else []
        if len(wrong):
            self._fail(
                self._kind,
                int(wrong[0]),
                f"makes a palm of {palm[wrong[0]]:.3g} m; are these metres, and joints in the "
                "order wrist, thumb, index, middle, ring, pinky?",
            )
        return joint

    def _posed(self) -> Float[ndarray, "detection 21 3"]:
        """Pose the user's MANO."""
        turn, pose = (self._rotations(name) for name in ("global_orient", "hand_pose"))
        shift = self._number.get("translation", np.zeros((self._count, 3)))
        joint = np.empty((self._count, 21, 3))
        for side in dict.fromkeys(self._text["side"]):
            mirrors = self._mirrors and side == "left"
            model = ManoHand.load(cast("Any", "right" if mirrors else side))
            for number in np.flatnonzero(np.array(self._text["side"]) == side):
                shape = self._number["betas"][number]
                given = (
                    shape,
                    model.articulation(pose[number].reshape(1, 45)),
                    turn[number].reshape(1, 3),
                    model.wrist_position(shape)[None],
                )
                with torch.no_grad():
                    posed = model.keypoints(*(torch.from_numpy(value) for value in given))
                joint[number] = posed[0].numpy() * ([-1, 1, 1] if mirrors else 1)
        return joint + shift[:, None]

    def _rotations(self, name: str) -> Float[ndarray, "detection rotation 3"]:
        """Read rotations that are vectors or matrices as vectors [rad]."""
        value = self._number[name]
        count = 1 if name == "global_orient" else 15
        if value[0].size == 3 * count:
            return value.reshape(-1, count, 3)
        matrix = value.reshape(-1, 3, 3)
        error = np.abs(matrix @ matrix.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        if error.max() > 1e-2:
            self._fail(name, int(error.argmax()) // count, "holds a matrix that is no rotation")
        return Rotation.from_matrix(matrix).as_rotvec().reshape(-1, count, 3)

    def _check(self) -> None:
        """Check what detections say against the sequence."""
        self._check_texts()
        frame, last = self._number["frame"], self._sequence.frame_count - 1
        for number in np.flatnonzero((frame != np.round(frame)) | (frame < 0) | (frame > last)):
            self._fail("frame", int(number), f"is {frame[number]:g}; there are 0 to {last}")
        sure = self._number.get("confidence", np.ones(1))
        for number in np.flatnonzero((sure < 0) | (sure > 1)):
            self._fail("confidence", int(number), f"is {sure[number]:g}; it is 0 to 1")

    def _check_texts(self) -> None:
        names = [view.name for view in self._sequence.views]
        for number, side in enumerate(self._text["side"]):
            if side not in SIDES:
                self._fail("side", number, f"is '{side}'; right or left is expected")
            if side not in self._sequence.hands:
                self._fail(
                    "side",
                    number,
                    f"is '{side}', a hand that 'hands' in sequence.yaml does not name; add it",
                )
        for number, view in enumerate(self._text.get("view", [])):
            if view not in names:
                self._fail("view", number, f"is '{view}'; there are {', '.join(names)}")

    def _texts(self, name: str, value: Any) -> list[str]:
        array = np.atleast_1d(np.asarray(value, dtype=object))
        if len(array) == 1:
            array = np.repeat(array, self._count)
        if array.shape != (self._count,) or not all(isinstance(text, str) for text in array):
            self._fail(name, None, f"must be {self._count} texts, one a detection")
        return [str(text) for text in array]

    def _numbers(self, name: str, value: Any) -> ndarray:
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            self._fail(name, None, "must be numbers, equally many for each detection")
        if not any(array.shape == (self._count, *shape) for shape in _NUMBERS[name]):
            shapes = " or ".join(str((self._count, *shape)) for shape in _NUMBERS[name])
            self._fail(name, None, f"has the shape {array.shape}; expected {shapes}")
        may_lack = name == "keypoint"
        bad = np.isinf(array) if may_lack else ~np.isfinite(array)
        if bad.any():
            self._fail(name, int(np.argwhere(bad)[0][0]), "is not a finite number")
        return array

    def _fail(self, field: str, number: int | None, reason: str) -> NoReturn:
        at = "" if number is None else f", detection {number}"
        raise ImportFailedError(f"{self._path}: {field}{at} {reason}. See docs/formats.md.")


def _read(path: Path) -> dict[str, Any]:
    """Read the fields of a file without executing anything of it."""
    try:
        if path.suffix == ".npz":
            with zipfile.ZipFile(path) as archive:
                size = sum(entry.file_size for entry in archive.infolist())
            if size > _MOST_BYTES:
                raise ImportFailedError(f"{path}: unpacks to {size} bytes, which is no hands file.")
            with np.load(path, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            # Text comes as arrays of NumPy's text.
            return {
                name: array.tolist() if array.dtype.kind in "US" else array
                for name, array in arrays.items()
            }
        if path.suffix == ".json":
            if path.stat().st_size > _MOST_BYTES:
                raise ImportFailedError(f"{path}: is too large for a hands file.")
            fields = named_fields(json.loads(path.read_text(encoding="utf-8")))
            if fields is not None:
                return fields
            raise ImportFailedError(f"{path}: must be a JSON object with the field 'format'.")
    except FileNotFoundError:
        raise ImportFailedError(f"{path} is not a file.") from None
    except (ValueError, OSError, zipfile.BadZipFile, RecursionError, EOFError) as error:
        raise ImportFailedError(f"{path}: cannot be read as {path.suffix} ({error}).") from None
    raise ImportFailedError(f"{path}: is neither .json nor .npz. See docs/formats.md.")
