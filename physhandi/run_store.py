"""Stores of published runs beside run folders: whatever fsspec reaches, as object storage.

A run in a store has the files of a run folder, so that any copy of it is a run: first all results,
then their manifest, and last the line that names the attempt. Until that line is there, nobody sees
the run. Leases, locks, checkpoints and progress need a file system, and stay in the run's folder.
"""

import shutil
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec

from physhandi.data.files import temporary_name
from physhandi.data.run import RunFolder
from physhandi.data.run_folder import (
    ATTEMPTS,
    CURRENT,
    JOB,
    MANIFEST,
    OUT,
    RUN,
    SAFE_ID,
    STAGES_FILE,
    ManifestFile,
    checked,
    inside,
)
from physhandi.errors import PhysHandiError, RunError, UsageError, describe
from physhandi.typed import decode_json

_BEAT_S = 5.0


class RunStore:
    """A place for published runs that fsspec reaches."""

    def __init__(self, url: str) -> None:
        """Find the place; nothing is read or written yet.

        Args:
            url: Address that fsspec understands, as ``s3://BUCKET/FOLDER`` or ``file:///FOLDER``.
                What it takes to come in is told by the environment, never by the address.

        Raises:
            UsageError: If fsspec does not know the address, a package is missing for it, or it
                holds a password.
        """
        if urlsplit(url).password is not None:
            raise UsageError("The address of a store must hold no password: it is seen by others.")
        try:
            opened: tuple[Any, Any] = import_module("fsspec.core").url_to_fs(url)
        except (ImportError, ValueError) as error:
            raise UsageError(f"The store {url} cannot be used: {describe(error)}") from None
        self._files = opened[0]
        self._root = str(opened[1])
        self.url = url.rstrip("/")
        """Its address."""

    def put_files(
        self, run_folder: Path, number: int, files: Mapping[str, Any], beat: Callable[[], None]
    ) -> None:
        """Put the results of an attempt into the store; nobody sees them yet.

        Args:
            run_folder: The run.
            number: Number of the attempt.
            files: Record of each result by its name.
            beat: Is called between files, a few times a minute.

        Raises:
            RunError: If the store does not take them.
        """
        attempt = f"{ATTEMPTS}/{number}"
        renewed = time.monotonic()
        with self._trouble(f"Results of run '{run_folder.name}' could not be put into"):
            for name in (JOB, RUN, f"{attempt}/{STAGES_FILE}"):
                if (run_folder / name).is_file():
                    self._put(run_folder, name)
            for rel, record in files.items():
                size = self._put(run_folder, f"{attempt}/{OUT}/{rel}")
                if size != record["size"]:
                    raise RunError(f"{rel} has {size} bytes in it instead of {record['size']}.")
                if time.monotonic() - renewed > _BEAT_S:
                    renewed = time.monotonic()
                    beat()

    def publish(self, run_folder: Path, number: int, manifest: Mapping[str, Any]) -> None:
        """Let the results of an attempt, which are all there, be seen.

        Raises:
            RunError: If the store does not take it.
        """
        place = self._place(run_folder.name)
        with self._trouble(f"Run '{run_folder.name}' could not be published in"):
            content = msgspec.json.encode(dict(manifest))
            self._files.pipe_file(f"{place}/{ATTEMPTS}/{number}/{MANIFEST}", content)
            self._files.pipe_file(f"{place}/{CURRENT}", f"{number}\n".encode())

    def runs(self) -> list[str]:
        """List the ids of published runs.

        Raises:
            RunError: If the store cannot be read.
        """
        with self._trouble("Runs cannot be listed in"):
            if not self._files.exists(self._root):
                return []
            names = [str(path).rsplit("/", 1)[-1] for path in self._files.ls(self._root, False)]
            return sorted(
                name
                for name in names
                if SAFE_ID.fullmatch(name) and self._files.exists(f"{self._place(name)}/{CURRENT}")
            )

    def fetch(self, run_id: str, folder: Path) -> RunFolder:
        """Copy a published run into a folder, where it appears when it is known to be whole.

        Args:
            run_id: Its id.
            folder: Where the run shall be.

        Raises:
            RunError: If there is no such run, the folder exists, or a file is missing or is not
                what its hash says; then nothing is left.
        """
        if not SAFE_ID.fullmatch(run_id):
            raise RunError(f"{run_id!r} is no id of a run.")
        if folder.exists():
            raise RunError(f"{folder} exists already. Choose another folder.")
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = folder.with_name(temporary_name(folder.name))
        try:
            with self._trouble(f"Run '{run_id}' could not be read from"):
                self._copy(self._place(run_id), temporary)
            temporary.replace(folder)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
        return RunFolder.open(folder)

    def _copy(self, place: str, folder: Path) -> None:
        if not self._files.exists(f"{place}/{CURRENT}"):
            raise RunError("there is none that is published.")
        number = int(self._files.cat_file(f"{place}/{CURRENT}"))
        for name in self._listed(place, f"{ATTEMPTS}/{number}"):
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            self._files.get_file(f"{place}/{name}", str(target))
        RunFolder.open(folder).verify()

    def _listed(self, place: str, attempt: str) -> Iterator[str]:
        """Name the files of a published run below its place."""
        name = f"{attempt}/{MANIFEST}"
        content = decode_json(self._files.cat_file(f"{place}/{name}"), Any)
        manifest = checked(content, ManifestFile, name)
        yield from (JOB, RUN, CURRENT, name)
        if self._files.exists(f"{place}/{attempt}/{STAGES_FILE}"):
            yield f"{attempt}/{STAGES_FILE}"
        for rel in manifest["files"]:
            inside(Path(), rel)
            yield f"{attempt}/{OUT}/{rel}"

    def _put(self, run_folder: Path, name: str) -> int:
        target = f"{self._place(run_folder.name)}/{name}"
        self._files.makedirs(target.rsplit("/", 1)[0], exist_ok=True)
        self._files.put_file(str(run_folder / name), target)
        return int(self._files.info(target)["size"])

    def _place(self, run_id: str) -> str:
        return f"{self._root.rstrip('/')}/{run_id}"

    @contextmanager
    def _trouble(self, what: str) -> Generator[None]:
        try:
            yield
        except PhysHandiError as error:
            raise RunError(f"{what} {self.url}: {error}") from error
        except Exception as error:  # Stores raise whatever their libraries do.
            raise RunError(f"{what} {self.url}: {describe(error)}") from error
