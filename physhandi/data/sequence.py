"""A recorded interaction on disk: synchronised views, controls, markers and geometry."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from physhandi.data.atomic import read_array
from physhandi.data.sequence_schema import FILE, SequenceMeta, Side, read_meta
from physhandi.data.sequence_schema import ViewMeta as ViewMeta
from physhandi.data.sequence_validation import ARRAYS, check_layout, check_values
from physhandi.data.view import View as View
from physhandi.errors import SequenceError

_VIEW_PARTS = ("color", "depth", "mask", "keypoint", "track")


@dataclass(frozen=True)
class SequenceEntry:
    """One folder of a listing: its sequence, or why it cannot be used."""

    folder: Path
    sequence: "Sequence | None"
    error: str | None


class Sequence:
    """One recorded interaction; every part but ``sequence.yaml`` may be absent.

    The world is z-up and gravity points along -z. Use `Sequence.load`.
    """

    def __init__(self, folder: Path, meta: SequenceMeta) -> None:
        self.folder = folder
        self.meta = meta
        self.views: tuple[View, ...] = tuple(
            View(folder / "views" / view.name, meta.name, view.camera, meta.frame_count)
            for view in meta.views
        )

    def __repr__(self) -> str:
        return f"Sequence({str(self.folder)!r})"

    @classmethod
    def load(cls, folder: Path | str) -> "Sequence":
        """Open a sequence and check its description, its files and their shapes.

        Args:
            folder: Folder that holds ``sequence.yaml``.

        Raises:
            SequenceError: If something is wrong; names sequence, file and field.
        """
        path = Path(folder).resolve()
        sequence = cls(path, read_meta(path))
        check_layout(path, sequence.meta, sequence.views)
        return sequence

    @property
    def name(self) -> str:
        """Name of the sequence."""
        return self.meta.name

    @property
    def description(self) -> str:
        """What is to be seen."""
        return self.meta.description

    @property
    def label(self) -> str:
        """Free label of the user."""
        return self.meta.label

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return self.meta.frame_count

    @property
    def frame_rate(self) -> float:
        """Frames per second [Hz]."""
        return self.meta.frame_rate

    @property
    def metric(self) -> bool:
        """Whether lengths are metres."""
        return self.meta.metric

    @property
    def length_unit(self) -> str:
        """Name of the unit of all lengths."""
        return self.meta.length_unit

    @property
    def ground_height(self) -> float | None:
        """Height of the table or floor above z = 0 [m]; None if there is none."""
        return self.meta.ground_height

    @property
    def gravity(self) -> float:
        """Gravitational acceleration along -z [m/s²]."""
        return self.meta.gravity

    @property
    def hands(self) -> tuple[Side, ...]:
        """Hands that take part, in the order of the keypoints' hand axis."""
        return self.meta.hands

    @property
    def controlled_markers(self) -> tuple[int, ...]:
        """Markers that are fixed to a control, so that metrics do not score them."""
        return self.meta.controlled_markers

    @property
    def surface_node_count(self) -> int | None:
        """Number of leading object nodes that lie on the surface; None if that is not known."""
        return self.meta.surface_node_count

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Where the recording comes from."""
        return self.meta.provenance

    @property
    def reconstruction_frames(self) -> range:
        """Frames that are fitted."""
        return range(self.meta.reconstruction_count)

    @property
    def future_frames(self) -> range:
        """Frames that are held out for scoring the prediction."""
        return range(self.meta.reconstruction_count, self.frame_count)

    @cached_property
    def control(self) -> Float[ndarray, "frame control 3"] | None:
        """Point controllers that take the place of hands [m]."""
        return self._array("control.npy", np.float32)

    @cached_property
    def marker(self) -> Float[ndarray, "frame marker 3"] | None:
        """Identified observed points [m]; NaN where not seen."""
        return self._array("marker.npy", np.float32)

    @cached_property
    def marker_node(self) -> Int[ndarray, " marker"] | None:
        """Object node that each marker observes."""
        return self._array("marker_node.npy", np.int32)

    @cached_property
    def marker_motion_valid(self) -> Bool[ndarray, "frame marker"] | None:
        """Whether the motion of each marker from the frame before can be trusted."""
        return self._array("marker_motion_valid.npy", np.bool_)

    @cached_property
    def validation_track(self) -> Float[ndarray, "frame validation 3"] | None:
        """Annotated points that no stage may fit, for scoring [m]; NaN where not annotated."""
        return self._array("validation_track.npy", np.float32)

    @cached_property
    def object_node(self) -> Float[ndarray, "node 3"] | None:
        """Given object nodes of frame 0 [m]."""
        return self._array("object_node.npy", np.float32)

    @cached_property
    def rest_node(self) -> Float[ndarray, "node 3"] | None:
        """The same nodes in the shape without tension [m]."""
        return self._array("rest_node.npy", np.float32)

    def missing(self, *parts: str) -> list[str]:
        """Tell which of the named parts the sequence lacks.

        Args:
            parts: Of ``views hands color depth mask keypoint track control marker marker_node
                marker_motion_valid validation_track object_node rest_node``. A part
                of views counts as there if one view has it. ``object`` stands for what an object
                can be observed by (markers, or depth with masks) and moved by (hands or control).

        Returns:
            The parts that are not there, in the order asked for.
        """
        wanted: list[str] = []
        for part in parts:
            wanted.extend(self._object_parts() if part == "object" else [part])
        return [part for part in dict.fromkeys(wanted) if not self._has(part)]

    def validate(self, *, reads_color: bool = True) -> None:
        """Read every frame of every part and check its values.

        Args:
            reads_color: Whether color images are decoded too, which takes longest.

        Raises:
            SequenceError: At the first thing that is wrong; names file, frame and remedy.
        """
        check_values(self.folder, self.meta, self.views, reads_color=reads_color)

    @cached_property
    def _fingerprint(self) -> str:
        digest = hashlib.sha256()
        for path in sorted(self.folder.rglob("*")):
            name = path.relative_to(self.folder).as_posix()
            if not path.is_file() or any(part.startswith(".") for part in name.split("/")):
                continue
            digest.update(f"{name}\0{path.stat().st_size}\0".encode())
            if path.suffix in {".npy", ".yaml"}:
                with path.open("rb") as stream:
                    digest.update(hashlib.file_digest(stream, "sha256").digest())
        return digest.hexdigest()

    def fingerprint(self) -> str:
        """Compute a SHA-256 over all names and sizes, and the content of YAML and arrays."""
        return self._fingerprint

    def _object_parts(self) -> list[str]:
        seen = ["marker"] if self._has("marker") else ["depth", "mask"]
        return [*seen, "hands" if self.hands else "control"]

    def _has(self, part: str) -> bool:
        if part in {"views", "hands"}:
            return bool(getattr(self, part))
        if part in {"color", "depth", "mask"}:
            return any(getattr(view, f"has_{part}") for view in self.views)
        if part in _VIEW_PARTS:
            return any((view.folder / f"{part}.npy").is_file() for view in self.views)
        if f"{part}.npy" not in ARRAYS:
            raise ValueError(f"{part!r} is not a part of a sequence")
        return (self.folder / f"{part}.npy").is_file()

    def _array(self, file: str, kind: Any) -> Any:
        path = self.folder / file
        return read_array(path).astype(kind, copy=False) if path.is_file() else None


def find_sequences(folder: Path | str) -> list[SequenceEntry]:
    """List the sequences directly below a folder, by name.

    A damaged sequence is listed with its error; nothing is raised because of one.
    """
    root = Path(folder)
    entries: list[SequenceEntry] = []
    if not root.is_dir():
        return entries
    for path in sorted(root.iterdir()):
        if path.name.startswith(".") or not (path / FILE).is_file():
            continue
        try:
            entries.append(SequenceEntry(path, Sequence.load(path), None))
        except (SequenceError, OSError) as error:
            entries.append(SequenceEntry(path, None, str(error)))
    return entries
