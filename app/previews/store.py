"""Folder of previews, and the thread that has missing ones drawn."""

import hashlib
import logging
import signal
import threading
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from app.jobs.catalog import Catalog, NotFoundError, RunItem
from app.previews.files import MOVING, NONE, SECONDS_EACH, STILL
from app.settings import ServerSettings
from physhandi.child import Child, ChildEndedError
from physhandi.data.files import files_by_age, write_bytes
from physhandi.data.run_folder import CURRENT
from physhandi.data.sequence_meta import FILE
from physhandi.errors import PhysHandiError

logger = logging.getLogger(__name__)

PreviewKind = Literal["run", "sequence"]
_VERSION = 2
_BATCH = 8
_FAULTLESS = (0, -signal.SIGTERM, -signal.SIGINT)
"""Exit codes of a process that is not to blame for what is missing: a regular end, or a signal."""
_PATIENCE = 10.0
"""Time that a preview may take by the clock, in its processor time."""
_MOST_WAITING = 400
_MOST_FILES = 4_000
_PAUSE_S = 1.0


@dataclass(frozen=True)
class PreviewPictures:
    """The preview of a run or a sequence."""

    state: Literal["ready", "pending", "none"]
    """Whether it is there, is being made, or cannot be made."""
    still: str = ""
    """Address of the still picture, which is made first; empty if it is not there."""
    moving: str = ""
    """Address of the moving picture; empty if it is not there."""


@dataclass(frozen=True)
class _Source:
    """Source of a preview, and the name of its files, which changes whenever the source does."""

    kind: PreviewKind
    id: str
    folder: Path
    stamp: int

    @property
    def prefix(self) -> str:
        return f"{self.kind}-{self.id}-"

    @property
    def key(self) -> str:
        text = f"{_VERSION}\0{self.folder}\0{self.stamp}"
        return self.prefix + hashlib.sha256(text.encode()).hexdigest()[:16]


class Previews:
    """Keeps small pictures in a folder beside the data, which may be deleted at any time.

    One process at a time draws them, out of the way of all else; a page is never kept waiting.
    """

    def __init__(self, settings: ServerSettings, catalog: Catalog) -> None:
        """Prepare; `start` begins to draw.

        Args:
            settings: Tells the data folder.
            catalog: Finds sequences and runs.
        """
        self._catalog = catalog
        self._folder = settings.preview_dir
        self._lock = threading.Condition()
        self._waiting: OrderedDict[str, _Source] = OrderedDict()
        self._child: Child | None = None
        self._is_closed = False
        self._thread = threading.Thread(target=self._work, name="previews", daemon=True)

    def start(self) -> None:
        """Begin to draw what pages have asked for."""
        self._thread.start()

    def shutdown(self) -> None:
        """Stop drawing at once."""
        with self._lock:
            self._is_closed = True
            self._lock.notify_all()
            if self._child is not None:
                self._child.kill()
        if self._thread.is_alive():
            self._thread.join(timeout=5)

    def look(self, kind: PreviewKind, item_id: str) -> PreviewPictures:
        """Tell whether there is a preview, and have it drawn if there is none.

        A run without results shows its first sequence.

        Raises:
            NotFoundError: If there is no such run or sequence.
        """
        source = self._source(kind, item_id)
        if source is None:
            return PreviewPictures("none")
        address, version = f"{source.kind}s/{source.id}", source.key[-16:]
        still = f"{address}/still?v={version}" if self._path(source, STILL).is_file() else ""
        if still and self._path(source, MOVING).is_file():
            return PreviewPictures("ready", still, f"{address}/preview?v={version}")
        if self._path(source, NONE).is_file():
            return PreviewPictures("none")
        with self._lock:
            # What was asked for last is on a screen now, so it is drawn first.
            self._waiting.setdefault(source.key, source)
            while len(self._waiting) > _MOST_WAITING:
                self._waiting.popitem(last=False)
            self._lock.notify_all()
        return PreviewPictures("pending", still)

    def file(self, kind: PreviewKind, item_id: str, *, is_moving: bool) -> Path | None:
        """Give the file of a preview; None if it is not there.

        Raises:
            NotFoundError: If there is no such run or sequence.
        """
        source = self._source(kind, item_id)
        if source is None:
            return None
        path = self._path(source, MOVING if is_moving else STILL)
        return path if path.is_file() else None

    def _source(self, kind: PreviewKind, item_id: str) -> _Source | None:
        if kind == "sequence":
            item = self._catalog.sequence_item(item_id)
            return _source("sequence", item_id, item.folder, FILE) if item.sequence else None
        run_item = self._catalog.run_item(item_id)
        return _source("run", item_id, run_item.folder, CURRENT) or self._first_sequence(run_item)

    def _first_sequence(self, item: RunItem) -> _Source | None:
        for name in item.run.sequence_names if item.run else ():
            try:
                return self._source("sequence", name)
            except NotFoundError:
                continue  # It is elsewhere, or was deleted since.
        return None

    def _path(self, source: _Source, ending: str) -> Path:
        return self._folder / f"{source.key}{ending}"

    def _work(self) -> None:
        while batch := self._next_batch():
            try:
                self._folder.mkdir(parents=True, exist_ok=True)
                self._draw(batch)
                self._tidy(batch)
            except OSError as error:
                # Pages ask again for what is missing; a full disk must not be asked all the time.
                logger.warning("some previews were not made: %s", error)
                with self._lock:
                    self._lock.wait_for(lambda: self._is_closed, timeout=_PAUSE_S)

    def _next_batch(self) -> list[_Source]:
        with self._lock:
            while not self._waiting and not self._is_closed:
                self._lock.wait()
            if self._is_closed:
                return []
            count = min(_BATCH, len(self._waiting))
            return [self._waiting.popitem(last=True)[1] for _ in range(count)]

    def _draw(self, batch: list[_Source]) -> None:
        missing = [source for source in batch if not self._is_settled(source)]
        orders = [
            {"kind": s.kind, "folder": str(s.folder), "target": str(self._folder / s.key)}
            for s in missing
        ]
        with self._lock:
            if self._is_closed or not orders:
                return
            self._child = child = Child(
                "app.previews.worker",
                threads=1,
                time_limit_s=_PATIENCE * SECONDS_EACH * len(orders),
            )
        code = 0
        with child:
            for order in orders:
                child.send(order)
            child.end_requests()
            try:
                for _ in child.messages():
                    pass
            except PhysHandiError as error:
                code = error.code if isinstance(error, ChildEndedError) else 1
                logger.info("%s", error)
        self._child = None
        undone = [s for s in missing if not self._is_settled(s)]
        if undone and code not in _FAULTLESS and not self._is_closed:
            # The first one ended the process or kept it too long; the others are tried again.
            guilty = next((s for s in undone if not self._path(s, STILL).is_file()), undone[0])
            logger.warning("the preview of %s %s could not be drawn", guilty.kind, guilty.id)
            write_bytes(self._path(guilty, NONE), f"Its process ended with {code}.".encode())
            with self._lock:
                others = {source.key: source for source in undone if source is not guilty}
                self._waiting.update(others)

    def _is_settled(self, source: _Source) -> bool:
        # One of the two pictures may have been cleared away.
        is_drawn = all(self._path(source, ending).is_file() for ending in (STILL, MOVING))
        return is_drawn or self._path(source, NONE).is_file()

    def _tidy(self, batch: list[_Source]) -> None:
        """Remove previews of what has changed since, and the oldest ones if there are too many."""
        files = [path for _, _, path in files_by_age(self._folder.iterdir())]
        current = {source.prefix: source.key for source in batch}
        _remove(path for path in files if _is_stale(path.name, current))
        _remove(files[: max(0, len(files) - _MOST_FILES)])


def _source(kind: PreviewKind, item_id: str, folder: Path, watched: str) -> _Source | None:
    try:
        return _Source(kind, item_id, folder, (folder / watched).stat().st_mtime_ns)
    except OSError:
        return None


def _is_stale(name: str, current: dict[str, str]) -> bool:
    stem = name.split(".", 1)[0]
    prefix = f"{stem.rpartition('-')[0]}-"
    return prefix in current and stem != current[prefix]


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        path.unlink(missing_ok=True)
