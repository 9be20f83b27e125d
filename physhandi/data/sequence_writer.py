"""Building a sequence folder beside its final place and publishing it in one step."""

import json
import os
import shutil
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from jaxtyping import Integer
from numpy import ndarray

from physhandi.data.arrays import write_array
from physhandi.data.files import (
    is_abandoned,
    stopped_name,
    sweep_temporary,
    sync_folder,
    temporary_name,
    write_yaml,
)
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import FILE, SAFE_NAME, SequenceMeta
from physhandi.errors import CancelledError, SequenceError

_ORIGIN, _CHECKPOINTS = ".origin", ".checkpoints"
"""Files of a sequence that is being written: what it is made of, and how far it is."""


class SequenceWriter:
    """Collects the parts of a sequence; the folder appears only when it is whole and valid.

    Use it as a context manager: leaving it without `finish`, or by an exception, leaves nothing;
    but one that may be resumed keeps its hidden folder when the user stops it or it is killed.
    """

    def __init__(self, folder: Path | str, *, overwrite: bool = False, origin: str = "") -> None:
        """Start a sequence, or go on with one of the same origin.

        Args:
            folder: Where the sequence shall appear; its parent is made if needed.
            overwrite: Whether to replace a sequence that is there.
            origin: Names all that the sequence is made of, if it may be resumed (`checkpoints`);
                another origin starts afresh.

        Raises:
            SequenceError: If the folder exists and `overwrite` is false, or its name is unsafe.
        """
        self.folder = Path(folder).resolve()
        self._overwrite = overwrite
        self._origin = origin
        self._unnoted: list[str] = []
        if not SAFE_NAME.fullmatch(self.folder.name):
            raise SequenceError(
                f"'{self.folder.name}' cannot name a sequence; use 1-64 letters, digits, '_', '-'."
            )
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        self._check_target()
        self._temporary = self.folder.with_name(temporary_name(self.folder.name))
        self._checkpoints = self._take_over() if origin else []
        _recover(self.folder)
        self._check_target()
        if not self._temporary.exists():
            self._temporary.mkdir()
            if origin:
                (self._temporary / _ORIGIN).write_text(origin, encoding="utf-8")

    def __enter__(self) -> "SequenceWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        is_stopped = kind is not None and issubclass(kind, CancelledError | KeyboardInterrupt)
        if is_stopped and (self._temporary / _CHECKPOINTS).exists():
            self._temporary.rename(self.folder.with_name(stopped_name(self.folder.name)))
        else:
            shutil.rmtree(self._temporary, ignore_errors=True)

    @property
    def checkpoints(self) -> list[Any]:
        """States that `checkpoint` stored before this writer resumed; their files are all there."""
        return list(self._checkpoints)

    def checkpoint(self, state: Any) -> None:
        """Note that all files up to here are whole, to go on from here if the work is stopped.

        Args:
            state: Plain data that a later writer of the same origin needs.
        """
        files = {rel: self._path(rel).stat().st_size for rel in self._unnoted}
        self._unnoted.clear()
        with (self._temporary / _CHECKPOINTS).open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({"state": state, "files": files}) + "\n")

    def save_array(self, rel: str, array: ndarray) -> None:
        """Store an array, for example as ``control.npy``."""
        write_array(self._path(rel), array)
        self._unnoted.append(rel)

    def save_image(
        self,
        rel: str,
        image: Integer[ndarray, "row column *channel"],
        *,
        compression: int | None = None,
    ) -> None:
        """Store an image (RGB if it has three channels), for example ``views/a/mask/00000.png``.

        Args:
            rel: File inside of the sequence; its ending tells the format.
            image: The image.
            compression: Effort that goes into a small PNG, 0 to 9; None takes OpenCV's own.

        Raises:
            SequenceError: If such an image cannot be stored in that format.
            OSError: If the disk does not take it.
        """
        path = self._path(rel)
        pixels = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.shape[2:] == (3,) else image
        options = [] if compression is None else [cv2.IMWRITE_PNG_COMPRESSION, compression]
        is_encoded, code = cv2.imencode(path.suffix, np.ascontiguousarray(pixels), options)
        if not is_encoded:
            raise SequenceError(f"Sequence '{self.folder.name}': {rel} could not be written.")
        with _naming(path):
            path.write_bytes(code.tobytes())
        self._unnoted.append(rel)

    def save_yaml(self, rel: str, value: Any) -> None:
        """Store plain data, for example as ``truth/views/a/camera.yaml``."""
        write_yaml(self._path(rel), value)
        self._unnoted.append(rel)

    def copy(self, rel: str, path: Path | str) -> None:
        """Take over a file as it is, for example a video."""
        target = self._path(rel)
        with _naming(target):
            shutil.copyfile(path, target)
        self._unnoted.append(rel)

    def make_folder(self, rel: str) -> None:
        """Make a folder, for example ``views/a`` of a camera that recorded nothing."""
        self._path(rel).mkdir(exist_ok=True)

    def finish(self, meta: SequenceMeta) -> Sequence:
        """Write ``sequence.yaml``, check everything and publish the folder.

        Raises:
            SequenceError: If what was written is not a valid sequence; nothing is published.
        """
        for name in (_ORIGIN, _CHECKPOINTS):
            (self._temporary / name).unlink(missing_ok=True)
        write_yaml(self._temporary / FILE, meta.to_dict())
        written = Sequence.load(self._temporary)
        written.validate()
        self._check_target()
        replaced: Path | None = None
        if self.folder.exists():
            replaced = self.folder.with_name("." + self.folder.name + ".replaced")
            self.folder.replace(replaced)
        self._temporary.replace(self.folder)
        sync_folder(self.folder.parent)
        if replaced is not None:
            shutil.rmtree(replaced)
        return Sequence(self.folder, written.meta)

    def _take_over(self) -> list[Any]:
        """Continue in the folder of a writer of the same origin that was stopped or killed."""
        for path in self.folder.parent.glob(f".{self.folder.name}.*.tmp"):
            try:
                if is_abandoned(path) and (path / _ORIGIN).read_text("utf-8") == self._origin:
                    path.rename(self._temporary)
                    return self._read_checkpoints()
            except OSError:  # It has none, or another process was faster.
                continue
        return []

    def _read_checkpoints(self) -> list[Any]:
        """Read what can be trusted: whole lines whose files have the size that was noted."""
        path = self._temporary / _CHECKPOINTS
        text = path.read_text("utf-8") if path.is_file() else ""
        lines: list[str] = []
        states: list[Any] = []
        for line in text.splitlines():
            try:
                entry = json.loads(line)
                files: dict[str, int] = entry["files"]
                is_whole = all((self._temporary / f).stat().st_size == n for f, n in files.items())
            except (ValueError, KeyError, OSError):
                break
            if not is_whole:
                break
            lines.append(line + "\n")
            states.append(entry["state"])
        path.write_text("".join(lines), "utf-8")
        return states

    def _path(self, rel: str) -> Path:
        parts = PurePosixPath(rel).parts
        if not parts or any(part in {"..", "/"} or part.startswith(".") for part in parts):
            raise SequenceError(f"{rel!r} is not a file name inside a sequence.")
        path = self._temporary.joinpath(*parts)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _check_target(self) -> None:
        if not self.folder.exists():
            return
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            return
        if not self._overwrite:
            raise SequenceError(
                f"{self.folder} exists already. Choose another folder, or give --overwrite."
            )
        if not (self.folder / FILE).is_file():
            raise SequenceError(f"{self.folder} is not a sequence, so it is not overwritten.")


def write_sequence(
    folder: Path | str,
    meta: SequenceMeta,
    arrays: Mapping[str, ndarray] | None = None,
    *,
    images: Mapping[str, ndarray] | None = None,
    overwrite: bool = False,
) -> Sequence:
    """Write a whole sequence at once.

    Args:
        folder: Where the sequence shall appear.
        meta: Content of ``sequence.yaml``.
        arrays: Arrays by file, for example ``{"control.npy": …, "views/a/keypoint.npy": …}``.
        images: Images by file, for example ``{"views/a/depth/00000.png": …}``.
        overwrite: Whether to replace a sequence that is there.

    Raises:
        SequenceError: If the folder exists, or the parts do not fit together.
    """
    with SequenceWriter(folder, overwrite=overwrite) as writer:
        for rel, array in (arrays or {}).items():
            writer.save_array(rel, array)
        for rel, image in (images or {}).items():
            writer.save_image(rel, image)
        return writer.finish(meta)


@contextmanager
def _naming(path: Path) -> Generator[None, None, None]:
    """Name what is being written, which a full disk does not."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def can_be_gone_on_with(temporary: Path) -> bool:
    """Tell whether a hidden folder that nobody writes any more holds a part of an import."""
    return (temporary / _CHECKPOINTS).is_file()


def interrupted_replacements(root: Path) -> list[Path]:
    """Find sequences that a writer moved out of the way before it was killed.

    Args:
        root: Folder of the sequences.

    Returns:
        Where they belong; they lie beside that as ``.<name>.replaced``.
    """
    folders: list[Path] = []
    for replaced in sorted(root.glob(".*.replaced")):
        folder = root / replaced.name.removeprefix(".").removesuffix(".replaced")
        is_written = any(not is_abandoned(path) for path in root.glob(f".{folder.name}.*.tmp"))
        if not folder.exists() and not is_written:
            folders.append(folder)
    return folders


def _recover(folder: Path) -> None:
    """Undo what a killed writer of the same folder left behind."""
    sweep_temporary(
        path for path in folder.parent.glob(f".{folder.name}.*.tmp") if is_abandoned(path)
    )
    replaced = folder.with_name("." + folder.name + ".replaced")
    if replaced.is_dir():
        if folder.exists():
            shutil.rmtree(replaced)
        else:
            os.replace(replaced, folder)  # noqa: PTH105 - the move that the killed writer began
