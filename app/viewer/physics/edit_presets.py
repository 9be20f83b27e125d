"""Edits of single springs and nodes that users keep under a name, for every object like theirs."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from app.viewer.physics.kept_files import KeptFiles, checked_kept_name
from app.viewer.physics.presets import AS_FITTED, BY_HAND, OWN
from physhandi.data.files import write_bytes
from physhandi.errors import UsageError
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.edits import Edits, apply_edits, decode_edits, encode_edits
from physhandi.typed import decode_json

EDIT_PRESET_FORMAT = "physhandi-edit-preset/1"
_TAKEN = frozenset({AS_FITTED, BY_HAND})
_MOST_BYTES = 4 << 20
_Count = Annotated[int, Meta(ge=0, le=2**31 - 1)]


class _Fields(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Description of an object or a recording in a file."""


class ObjectMark(_Fields, frozen=True, kw_only=True):
    """Identification of an object, which tells whether edits mean the same on another one."""

    nodes: _Count
    """Number of its object nodes."""
    springs: _Count
    """Number of its object springs before all edits."""
    sha256: Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
    """Hash of the nodes that these springs join; see `ObjectMark.of`."""

    @classmethod
    def of(cls, fitted: ObjectRollout) -> "ObjectMark":
        """Describe an object as it was fitted: its springs as pairs of nodes in rising order."""
        model = fitted.model if fitted.unedited is None else fitted.unedited
        pair = np.sort(model.spring_nodes[: model.object_spring_count], axis=1)
        pair = pair[np.lexsort(pair.T[::-1])]
        digest = hashlib.sha256(np.ascontiguousarray(pair, "<i4").tobytes()).hexdigest()
        return cls(nodes=model.node_count, springs=len(pair), sha256=digest)


class RecordingMark(_Fields, frozen=True, kw_only=True):
    """Identification of a recording, which tells whether its places and frames mean the same."""

    name: str
    """Name of the recording."""
    frames: _Count
    """Number of its frames."""
    controls: _Count
    """Number of its control nodes."""

    @classmethod
    def of(cls, fitted: ObjectRollout, name: str) -> "RecordingMark":
        """Describe the recording in which an object was fitted."""
        moving = fitted.model.control_count - fitted.model.pin_count
        return cls(name=name, frames=fitted.frame_count, controls=moving)


class _Stored(_Fields, frozen=True, kw_only=True):
    format: Literal["physhandi-edit-preset/1"]
    name: str
    object: ObjectMark
    recording: RecordingMark
    edits: msgspec.Raw


@dataclass(frozen=True, kw_only=True)
class EditPreset:
    """Edits under a name, and the object on which they were made."""

    name: str
    """Its name for people."""
    edits: Edits
    """All edits of the object, its stored ones included."""
    object: ObjectMark
    """On which object they were made."""
    recording: RecordingMark
    """In which recording."""
    is_own: bool = True
    """Whether a user keeps it, so that it can be deleted."""

    @property
    def label(self) -> str:
        """Its entry in the list."""
        return f"{OWN}{self.name}" if self.is_own else self.name

    def misfit(self, object_: ObjectMark, recording: RecordingMark) -> str:
        """Say why it cannot be applied to an object; empty if it can."""
        its = self.object
        for what, there, here in (
            ("nodes", its.nodes, object_.nodes),
            ("springs", its.springs, object_.springs),
        ):
            if there != here:
                return f"it was made on an object with {there} {what}, and this one has {here}."
        if its.sha256 != object_.sha256:
            return f"this object has {its.springs} springs, too, but they join other nodes."
        bound = next((edit for edit in self.edits if edit.is_of_recording), None)
        if bound is None or self.recording == recording:
            return ""
        there = self.recording
        belongs = f"“{bound.title}” belongs to the recording '{there.name}'"
        if there.name != recording.name:
            return f"{belongs}, and this one is '{recording.name}'."
        return (
            f"{belongs} with {there.frames} frames and {there.controls} control nodes, and here it "
            f"has {recording.frames} and {recording.controls}."
        )

    def check(self, fitted: ObjectRollout, recording_name: str) -> None:
        """Refuse to be applied to an object that is another one.

        Args:
            fitted: The object's fitted rollout.
            recording_name: What its recording is called.

        Raises:
            UsageError: If the edits mean something else on it, or cannot be made; says why.
        """
        misfit = self.misfit(ObjectMark.of(fitted), RecordingMark.of(fitted, recording_name))
        if misfit:
            raise UsageError(f"“{self.name}” cannot be applied: {misfit}")
        unedited = fitted.model if fitted.unedited is None else fitted.unedited
        apply_edits(unedited, self.edits, fitted.parameters)


class EditPresetStore(KeptFiles[EditPreset]):
    """The edits that users of a server have kept, as JSON."""

    what = "preset of edits"
    kinds = frozenset({".json"})
    new_kind = ".json"

    def __init__(self, presets: Path) -> None:
        """Prepare; the folder is made when the first edits are kept.

        Args:
            presets: Where presets are kept; those of edits have a folder in it.
        """
        super().__init__(presets / "edits", f"{presets.name}/edits")

    def read(self, path: Path) -> EditPreset:
        """Read a file; see `KeptFiles.read`."""
        if path.stat().st_size > _MOST_BYTES:
            raise UsageError(f"it has more than {_MOST_BYTES >> 20} MiB. Keep fewer edits in one.")
        try:
            stored = decode_json(path.read_bytes(), _Stored)
        except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
            raise UsageError(
                f"it holds no preset of edits: {error}. Expected the fields of "
                f"'{EDIT_PRESET_FORMAT}' (docs/formats.md)."
            ) from None
        edits = decode_edits(bytes(stored.edits), "field 'edits'")
        if not edits:
            raise UsageError("field 'edits' is empty; expected one edit at least.")
        return EditPreset(
            name=checked_kept_name(stored.name, _TAKEN, self.what),
            edits=edits,
            object=stored.object,
            recording=stored.recording,
        )

    def save(self, preset: EditPreset) -> EditPreset:
        """Keep edits; those of the same name are replaced.

        Raises:
            UsageError: If the name cannot be used, or there are no edits, too many or too large.
        """
        name = checked_kept_name(preset.name, _TAKEN, self.what)
        if not preset.edits:
            raise UsageError("There are no edits yet, so none can be kept. Edit something first.")
        stored = _Stored(
            format=EDIT_PRESET_FORMAT,
            name=name,
            object=preset.object,
            recording=preset.recording,
            edits=msgspec.Raw(encode_edits(preset.edits)),
        )
        content = msgspec.json.encode(stored)
        if len(content) > _MOST_BYTES:
            raise UsageError(
                f"These edits take more than {_MOST_BYTES >> 20} MiB, which no preset may. Save "
                "them as a run."
            )
        self._put(name, lambda path: write_bytes(path, content))
        return replace(preset, name=name)
