"""Building a sequence folder beside its final place and publishing it in one step."""

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

from physhandi.data.files import (
    is_abandoned,
    sweep_temporary,
    sync_folder,
    temporary_name,
    write_array,
    write_yaml,
)
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import FILE, SAFE_NAME, SequenceMeta
from physhandi.errors import SequenceError


class SequenceWriter:
    """Collects the parts of a sequence; the folder appears only when it is whole and valid.

    Use it as a context manager: leaving it without `finish`, or by an exception, leaves nothing.
    """

    def __init__(self, folder: Path | str, *, overwrite: bool = False) -> None:
        """Start a sequence.

        Args:
            folder: Where the sequence shall appear; its parent is made if needed.
            overwrite: Whether to replace a sequence that is there.

        Raises:
            SequenceError: If the folder exists and `overwrite` is false, or its name is unsafe.
        """
        self.folder = Path(folder).resolve()
        self._overwrite = overwrite
        if not SAFE_NAME.fullmatch(self.folder.name):
            raise SequenceError(
                f"'{self.folder.name}' cannot name a sequence; use 1-64 letters, digits, '_', '-'."
            )
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        _recover(self.folder)
        self._check_target()
        self._temporary = self.folder.with_name(temporary_name(self.folder.name))
        self._temporary.mkdir()

    def __enter__(self) -> "SequenceWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        shutil.rmtree(self._temporary, ignore_errors=True)

    def save_array(self, rel: str, array: ndarray) -> None:
        """Store an array, for example as ``control.npy``."""
        write_array(self._path(rel), array)

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
        pixels = image[..., ::-1] if image.ndim == 3 else image
        options = [] if compression is None else [cv2.IMWRITE_PNG_COMPRESSION, compression]
        is_encoded, code = cv2.imencode(path.suffix, np.ascontiguousarray(pixels), options)
        if not is_encoded:
            raise SequenceError(f"Sequence '{self.folder.name}': {rel} could not be written.")
        with _naming(path):
            path.write_bytes(code.tobytes())

    def save_yaml(self, rel: str, value: Any) -> None:
        """Store plain data, for example as ``truth/views/a/camera.yaml``."""
        write_yaml(self._path(rel), value)

    def copy(self, rel: str, path: Path | str) -> None:
        """Take over a file as it is, for example a video."""
        target = self._path(rel)
        with _naming(target):
            shutil.copyfile(path, target)

    def make_folder(self, rel: str) -> None:
        """Make a folder, for example ``views/a`` of a camera that recorded nothing."""
        self._path(rel).mkdir(exist_ok=True)

    def finish(self, meta: SequenceMeta) -> Sequence:
        """Write ``sequence.yaml``, check everything and publish the folder.

        Raises:
            SequenceError: If what was written is not a valid sequence; nothing is published.
        """
        write_yaml(self._temporary / FILE, meta.to_dict())
        Sequence.load(self._temporary).validate()
        self._check_target()
        replaced: Path | None = None
        if self.folder.exists():
            replaced = self.folder.with_name("." + self.folder.name + ".replaced")
            self.folder.replace(replaced)
        self._temporary.replace(self.folder)
        sync_folder(self.folder.parent)
        if replaced is not None:
            shutil.rmtree(replaced)
        return Sequence.load(self.folder)

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
                f"{self.folder} exists already. Choose another folder, or allow overwriting."
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
