"""Ground truth of a recording, for scoring only: the optional folder ``truth/``.

No stage of a fit reads it. Simulated recordings can have it, and recordings of a better sensor.
Views that are held out lie in it too, with a ``camera.yaml`` each, so that what copies a recording
without its truth cannot give them away.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Bool, Float, Int
from numpy import ndarray

from physhandi.data.arrays import read_array
from physhandi.data.camera import PinholeCamera
from physhandi.data.files import named_fields, parse_yaml
from physhandi.data.sequence_meta import SIDES, Side
from physhandi.data.view import View
from physhandi.errors import SequenceError

TRUTH_FOLDER = "truth"
"""Folder of a sequence that holds the truth."""
HELD_OUT_FOLDER = f"{TRUTH_FOLDER}/views"
"""Folder of a sequence that holds the views that are held out."""
ANNOTATION_FOLDER = f"{TRUTH_FOLDER}/annotation"
"""Folder of a sequence that may hold masks and tracks of each view without any error."""
HELD_OUT_CAMERA = "camera.yaml"
"""File of such a view that holds its calibration, in the fields that ``sequence.yaml`` has."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Truth:
    """True hands, object and contact of one sequence; any part may be absent."""

    hand_keypoint: Mapping[Side, Float[ndarray, "frame 21 3"]]
    """Keypoints of each hand whose truth is known [m]."""
    hand_vertex: Mapping[Side, Float[ndarray, "frame _ 3"]]
    """Surface vertices of the same hands, in the order of whatever mesh they come from [m]."""
    contact_point: Float[ndarray, "point 3"] | None = None
    """Places on the object in frame 0 whose contact is known [m]."""
    contact: Bool[ndarray, "frame point"] | None = None
    """Whether a hand touches that place in a frame."""
    object_point: Float[ndarray, "frame point 3"] | None = None
    """Where the same places are in every frame [m]."""
    object_face: Int[ndarray, "face 3"] | None = None
    """Triangles of the true surface between these places."""


def read_truth(folder: Path) -> Truth:
    """Read the truth of the sequence in a folder; what is not there is left out.

    Args:
        folder: Folder of a sequence that `Sequence.load` accepts, so that shapes are right.
    """

    def read(file: str) -> Any:
        path = folder / TRUTH_FOLDER / file
        return read_array(path) if path.is_file() else None

    def of_hands(part: str) -> dict[Side, Any]:
        arrays: dict[Side, Any] = {side: read(f"hand_{side}_{part}.npy") for side in SIDES}
        return {side: array for side, array in arrays.items() if array is not None}

    return Truth(
        hand_keypoint=of_hands("keypoint"),
        hand_vertex=of_hands("vertex"),
        contact_point=read("contact_point.npy"),
        contact=read("contact.npy"),
        object_point=read("object_point.npy"),
        object_face=read("object_face.npy"),
    )


def read_held_out_views(folder: Path, name: str, frame_count: int) -> tuple[View, ...]:
    """Open the views of a sequence that are held out for scoring, by name.

    Args:
        folder: Folder of the sequence.
        name: Name of the sequence, for errors.
        frame_count: Number of its frames.

    Raises:
        SequenceError: If a view has no calibration, or an invalid one.
    """
    views: list[View] = []
    for path in sorted((folder / HELD_OUT_FOLDER).glob("*/")):
        file = path / HELD_OUT_CAMERA
        where = f"Sequence '{name}': {file.relative_to(folder).as_posix()}"
        try:
            fields = named_fields(parse_yaml(file.read_text(encoding="utf-8"))) or {}
            camera = PinholeCamera.from_dict(fields)
        except FileNotFoundError:
            raise SequenceError(f"{where} is missing. Add it, or remove the view.") from None
        except (ValueError, OSError) as error:
            raise SequenceError(f"{where} is not the calibration of a camera: {error}.") from error
        views.append(View(path, name, camera, frame_count))
    return tuple(views)
