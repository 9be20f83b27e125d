"""Whether the data folder and its disk have room for anything new."""

import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from app.settings import ServerSettings
from physhandi.errors import PhysHandiError

_KEPT_S = 30.0
"""Time for which the size of the data folder is taken to be what it was [s]."""
_SHARE = 0.05
"""Most of the time that measuring it may take."""


class NoRoomError(PhysHandiError):
    """There is no room for what was asked for."""


class Room:
    """Refuses what is new where there is no room, before anything of it is written."""

    def __init__(
        self, settings: ServerSettings, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Prepare; nothing is measured yet.

        Args:
            settings: Tell the data folder, how large it may be and what stays free.
            clock: Tells the time [s].
        """
        self._folder = settings.data_dir
        self._most = None if settings.data_gib is None else int(settings.data_gib * 2**30)
        self._kept_free = int(settings.keep_free_gib * 2**30)
        self._clock = clock
        self._lock = threading.Lock()
        self._size = 0
        self._next = -1.0

    def left(self) -> int:
        """Give how much more may be written [bytes]; below 0 if it is too much already."""
        left = _free_at(self._folder) - self._kept_free
        return left if self._most is None else min(left, self._most - self.size())

    def require(self, what: str, size: int = 0) -> None:
        """Refuse something new if there is no room for it.

        Args:
            what: What it is, as the beginning of a sentence.
            size: Its size, as far as that is known [bytes].

        Raises:
            NoRoomError: If there is none; tells the numbers.
        """
        needs = f"{what} needs {_text(size)}" if size else f"{what} is not begun"
        free = _free_at(self._folder)
        if free - size < self._kept_free:
            raise NoRoomError(
                f"{needs}: the disk has {_text(free)} free, of which {_text(self._kept_free)} are "
                "kept (PHYSHANDI_KEEP_FREE_GIB). Free some space."
            )
        if self._most is not None and (used := self.size()) + size >= self._most:
            raise NoRoomError(
                f"{needs}: the data folder has {_text(used)}, of at most {_text(self._most)} "
                "(PHYSHANDI_DATA_GIB). Delete runs or recordings, or let what is not needed be "
                "removed (page Recovery)."
            )

    def size(self) -> int:
        """Measure the data folder, or give what was measured a moment ago [bytes]."""
        with self._lock:
            begin = self._clock()
            if begin >= self._next:
                self._size = sum(size for _, size in files_in(self._folder))
                end = self._clock()
                self._next = end + max(_KEPT_S, (end - begin) / _SHARE)
            return self._size


def files_in(folder: Path) -> Iterator[tuple[Path, int]]:
    """List the files below a folder with their sizes [bytes]; what has several names counts once.

    Links lead nowhere, and what vanishes meanwhile is left out.
    """
    counted: set[tuple[int, int]] = set()
    for parent, _, names in os.walk(folder):
        for name in names:
            path = Path(parent, name)
            try:
                status = path.lstat()
            except OSError:
                continue
            if status.st_nlink > 1:
                key = (status.st_dev, status.st_ino)
                if key in counted:
                    continue
                counted.add(key)
            yield path, status.st_size


def _free_at(folder: Path) -> int:
    existing = next(place for place in (folder, *folder.parents) if place.exists())
    return shutil.disk_usage(existing).free


def _text(size: int) -> str:
    return f"{size / 2**30:.2f} GiB" if size >= 0.1 * 2**30 else f"{size / 2**20:.1f} MiB"
