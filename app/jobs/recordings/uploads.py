"""Recordings, sequences and runs that are sent by browsers and scripts, piece by piece.

An upload is announced with the names and sizes of its files; its pieces are appended where the
last one ended, so one that broke off goes on, also after a restart. When all of it is there, a
process of its own unpacks and checks it (`app.jobs.recordings.unpacking`) and puts it in place.
"""

import logging
import re
import secrets
import shutil
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypedDict

from app.jobs.catalog import NotFoundError
from app.jobs.recordings.background import BackgroundTask, BackgroundTasks, Work
from app.jobs.recordings.upload_names import check_names, is_left_out, quoted_name
from app.jobs.storage.room import NoRoomError, Room
from app.settings import ServerSettings
from physhandi.data.files import files_by_age, with_status, write_json
from physhandi.data.run_folder import Text, WholeNumber, checked, read_json
from physhandi.errors import RunError, UsageError

logger = logging.getLogger(__name__)

CHUNK = 2**20
"""Size of a piece at most [bytes]; no request may bring more."""
_WORKER = "app.jobs.recordings.unpacking"
_MOST_UPLOADS = 20
_KEPT_FREE = 0.05
"""Part of the disk that uploads leave to others."""
_ABOUT = "upload.json"


class UnknownUploadError(UsageError, NotFoundError):
    """There is no such upload."""


class _AboutFile(TypedDict):
    """``upload.json``: what was announced."""

    name: Text
    files: list[tuple[Text, WholeNumber]]


class Uploads:
    """Takes the pieces of uploads, and has whole ones put in place."""

    def __init__(
        self,
        settings: ServerSettings,
        tasks: BackgroundTasks,
        room: Room | None = None,
        *,
        worker: str = _WORKER,
    ) -> None:
        """Prepare.

        Args:
            settings: Tell the folders and how much may be sent.
            tasks: Has whole uploads unpacked and checked, one at a time.
            room: Tells whether the data folder has room; None makes one for the settings.
            worker: Module of the process.
        """
        self._folder = settings.data_dir / "incoming"
        self._most = int(settings.upload_gib * 2**30)
        self._kept_days = settings.keep_uploads_days
        self._places = {
            "captures": settings.capture_dir,
            "sequences": settings.sequence_dir,
            "runs": settings.run_dir,
        }
        self._tasks = tasks
        self._data = room or Room(settings)
        self._worker = worker
        self._lock = threading.Lock()
        self._listed: dict[str, tuple[str, list[tuple[str, int]]]] = {}
        """Name and files of uploads; what is announced stays as it is, and is read but once."""

    def begin(self, name: str, files: Sequence[tuple[str, int]]) -> dict[str, Any]:
        """Announce an upload.

        Args:
            name: What it is to be called: 1 to 64 letters, digits, ``_`` and ``-``.
            files: Name, with slashes, below the folder that is sent, and size of each [bytes];
                those that systems leave behind are not taken.

        Returns:
            `describe` of it.

        Raises:
            UsageError: If names or sizes are refused, or too many uploads are unfinished.
            NoRoomError: If the disk has no room for it.
        """
        wanted = [(path, size) for path, size in files if not is_left_out(path)]
        check_names(path for path, _ in wanted)
        if not wanted:
            raise UsageError("It holds no files.")
        total = sum(size for _, size in wanted)
        if total > self._most:
            raise UsageError(
                f"It has {total / 2**30:.1f} GiB; this server takes {self._most / 2**30:g} GiB at "
                "most (PHYSHANDI_UPLOAD_GIB). Copy it into the data folder instead."
            )
        with self._lock:
            self._forget_old()
            unfinished = self.unfinished()
            if len(unfinished) >= _MOST_UPLOADS:
                raise UsageError(f"{_MOST_UPLOADS} uploads are unfinished. Remove some of them.")
            waiting = sum(one["total"] - one["received"] for one in unfinished)
            self._data.require("The upload, with others that are unfinished,", total + waiting)
            self._require_room(total + waiting)
            upload_id = secrets.token_hex(8)
            folder = self._folder / upload_id
            folder.mkdir(parents=True)
            write_json(folder / _ABOUT, {"name": name, "files": wanted})
        return self.describe(upload_id)

    def unfinished(self) -> list[dict[str, Any]]:
        """Describe all that are not being checked, the oldest first."""
        uploads: list[dict[str, Any]] = []
        # What was never announced goes with the old ones.
        for _, _, about in files_by_age(self._folder.glob(f"*/{_ABOUT}")):
            with suppress(UnknownUploadError):
                uploads.append(self.describe(about.parent.name))
        return [one for one in uploads if "files" in one]

    def describe(self, upload_id: str) -> dict[str, Any]:
        """Tell how far an upload is.

        Returns:
            ``id name files received total chunk state reason``; each file as
            ``path size received``. ``state`` is receiving, failed (with ``reason``), checking (then
            only ``id state progress`` are told) or done (then ``id state result``: ``kind`` and
            ``name`` of what it became).

        Raises:
            UnknownUploadError: If there is none.
        """
        task = self._tasks.task("upload", upload_id)
        if task.state == "done":
            self._listed.pop(upload_id, None)
            return {"id": upload_id, "state": "done", "result": task.result}
        if task.state == "running":  # Its files are on their way to their place.
            return {"id": upload_id, "state": "checking", "progress": task.progress}
        name, files = self._read(upload_id)
        received = [self._received(upload_id, path) for path, _ in files]
        return {
            "id": upload_id,
            "name": name,
            "files": [
                {"path": path, "size": size, "received": here}
                for (path, size), here in zip(files, received, strict=True)
            ],
            "received": sum(received),
            "total": sum(size for _, size in files),
            "chunk": CHUNK,
            "state": "failed" if task.state == "failed" else "receiving",
            "reason": task.reason,
        }

    def append(self, upload_id: str, number: int, offset: int, piece: bytes) -> int:
        """Take a piece of a file.

        Args:
            upload_id: The upload.
            number: Which of its files, counted from 0.
            offset: Where the piece begins: where the last one ended.
            piece: The piece.

        Returns:
            How much of the file there is now [bytes].

        Raises:
            UnknownUploadError: If there is no such upload or file.
            UsageError: If it is larger than announced.
            RunError: If it begins elsewhere, or the upload is being checked.
            OSError: If the disk is full; then the piece can be sent again.
        """
        with self._lock:
            self._require_still(upload_id)
            _, files = self._read(upload_id)
            if not 0 <= number < len(files):
                raise UnknownUploadError(f"The upload has {len(files)} files; {number} is none.")
            path, size = files[number]
            received = self._received(upload_id, path)
            if offset != received:
                raise RunError(f"{quoted_name(path)} goes on at byte {received}, not at {offset}.")
            if received + len(piece) > size:
                raise UsageError(
                    f"{quoted_name(path)} was announced with {size} bytes; this is more."
                )
            self._require_room(len(piece))
            target = self._path(upload_id, path)
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("ab") as out:
                try:
                    out.write(piece)
                    out.flush()
                except OSError:
                    out.truncate(received)
                    raise
            return received + len(piece)

    def finish(self, upload_id: str, name: str | None = None) -> BackgroundTask:
        """Have a whole upload checked and put in place.

        Args:
            upload_id: The upload.
            name: Another name than it was announced with; None for that one.

        Raises:
            UnknownUploadError: If there is none.
            RunError: If something of it is missing, or something else is being worked on.
        """
        with self._lock:
            self._require_still(upload_id)
            announced, files = self._read(upload_id)
            here = 0
            for path, size in files:
                received = self._received(upload_id, path)
                here += received
                if received < size:
                    raise RunError(
                        f"{quoted_name(path)} has {received} of {size} bytes; send the rest."
                    )
                if size == 0:
                    self._path(upload_id, path).parent.mkdir(parents=True, exist_ok=True)
                    self._path(upload_id, path).touch()
            name = name or announced
            work = Work("upload", upload_id, f"'{name}' was sent and is being checked.")
            order = {
                "folder": str(self._folder / upload_id),
                "name": name,
                # What is here already does not need the data folder's room a second time.
                "most_bytes": min(self._most, self._room(), max(0, self._data.left() + here)),
                "places": {kind: str(path) for kind, path in self._places.items()},
            }
            return self._tasks.start(work, self._worker, order)

    def remove(self, upload_id: str) -> None:
        """Forget an upload with all that was sent of it.

        Raises:
            UnknownUploadError: If there is none.
            RunError: If it is being checked; `cancel` stops that.
        """
        with self._lock:
            self._require_still(upload_id)
            self._read(upload_id)
            shutil.rmtree(self._folder / upload_id)

    def cancel(self, upload_id: str) -> None:
        """Stop checking an upload, which can be asked for again; does nothing if it is not."""
        self._tasks.cancel("upload", upload_id)

    def left_alone(self) -> list[tuple[str, Path, float]]:
        """List unfinished uploads, and what was never announced.

        Returns:
            Of each its id, its folder, and when something of it came last [s since 1970].
        """
        if not self._folder.is_dir():
            return []
        uploads = list[tuple[str, Path, float]]()
        for path in sorted(self._folder.iterdir()):
            if self._tasks.task("upload", path.name).state != "running":
                parts = with_status((path, *path.rglob("*")))
                if times := [status.st_mtime for _, status in parts]:
                    uploads.append((path.name, path, max(times)))
        return uploads

    def remove_folder(self, upload_id: str) -> None:
        """Remove what is left of an upload, announced or not.

        Raises:
            UnknownUploadError: If nothing is there.
            RunError: If it is being checked.
        """
        with self._lock:
            self._require_still(upload_id)
            if upload_id not in {name for name, _, _ in self.left_alone()}:
                raise UnknownUploadError(f"There is no upload '{upload_id}'.")
            self._listed.pop(upload_id, None)
            shutil.rmtree(self._folder / upload_id, ignore_errors=True)

    def _forget_old(self) -> None:
        if self._kept_days is None:
            return
        for name, folder, touched in self.left_alone():
            if time.time() - touched > self._kept_days * 86_400.0:
                logger.warning("upload %s was left alone and is removed", name)
                shutil.rmtree(folder, ignore_errors=True)

    def _require_still(self, upload_id: str) -> None:
        if self._tasks.task("upload", upload_id).state == "running":
            raise RunError("The upload is being checked; nothing of it can change now.")

    def _require_room(self, size: int) -> None:
        if size > self._room():
            raise NoRoomError(
                f"The disk has no room for {size / 2**20:.0f} MiB more: uploads leave "
                f"{_KEPT_FREE:.0%} of it free. Free some space."
            )

    def _room(self) -> int:
        folder = self._folder if self._folder.exists() else self._folder.parent
        disk = shutil.disk_usage(folder)
        return max(0, disk.free - int(_KEPT_FREE * disk.total))

    def _path(self, upload_id: str, path: str) -> Path:
        return self._folder / upload_id / "files" / path

    def _received(self, upload_id: str, path: str) -> int:
        try:
            return self._path(upload_id, path).stat().st_size
        except OSError:
            return 0

    def _read(self, upload_id: str) -> tuple[str, list[tuple[str, int]]]:
        unknown = UnknownUploadError(f"There is no upload '{upload_id}'.")
        about = self._folder / upload_id / _ABOUT
        if not re.fullmatch(r"[0-9a-f]{16}", upload_id) or not about.is_file():
            self._listed.pop(upload_id, None)
            raise unknown
        if upload_id not in self._listed:
            try:
                content = checked(read_json(about), _AboutFile, about)
                files = [(path, size) for path, size in content["files"]]
                check_names(path for path, _ in files)
            except (RunError, UsageError):
                raise unknown from None
            self._listed[upload_id] = content["name"], files
        return self._listed[upload_id]
