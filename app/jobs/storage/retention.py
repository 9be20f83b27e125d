"""Retention: what is removed from a data folder after a time or beyond a size; nothing by default.

No rule touches what a run was asked for, how it ended, or what it has published, so every run,
shared page and link stays what it is. What goes is what can be computed again, or tells how an
ended fit went.
"""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from app.jobs.catalog import Catalog, NotFoundError
from app.jobs.recordings.uploads import Uploads
from app.jobs.scheduler import Scheduler
from app.settings import ServerSettings
from physhandi.data.attempt import PREVIEW
from physhandi.data.files import files_by_age
from physhandi.data.run_folder import ATTEMPTS, EXIT, LOG
from physhandi.errors import PhysHandiError, describe
from physhandi.run import Run

logger = logging.getLogger(__name__)

_INTERVAL_S = 3600.0
_DAY_S = 86_400.0
ExpendableKind = Literal["attempts", "log", "cache", "upload"]


@dataclass(frozen=True)
class Expendable:
    """Something that may go."""

    kind: ExpendableKind
    """Attempts of a run, its log and last preview, a file of the cache, or an upload."""
    name: str
    """Its path in the data folder."""
    bytes: int
    """Space that is free afterwards."""
    days: float
    """For how long nothing has changed or used it."""
    rule: str
    """Setting that lets it go."""
    id: str = ""
    """Id of the run or upload."""


class Retention:
    """Lists what may go by the settings, and removes it."""

    def __init__(
        self,
        settings: ServerSettings,
        catalog: Catalog,
        scheduler: Scheduler,
        uploads: Uploads,
        note: Callable[[Mapping[str, Any]], None],
        *,
        clock: Callable[[], float] = time.time,
    ) -> None:
        """Prepare; `start` begins to remove.

        Args:
            settings: Tell the data folder and the rules.
            catalog: Finds runs.
            scheduler: Keeps runs from being started while something of them is removed.
            uploads: Knows what was sent.
            note: Is told of everything that was removed.
            clock: Tells the time [s since 1970].
        """
        self._settings = settings
        self._catalog = catalog
        self._scheduler = scheduler
        self._uploads = uploads
        self._note = note
        self._clock = clock
        self._removing = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._work, name="retention", daemon=True)

    def start(self) -> None:
        """Remove what may go, now and every hour."""
        self._thread.start()

    def shutdown(self) -> None:
        """Stop; what is removed just now is removed as a whole."""
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5)

    @property
    def rules(self) -> dict[str, float | None]:
        """The settings by their names, none if that rule is off."""
        settings = self._settings
        return {
            "PHYSHANDI_KEEP_ATTEMPTS_DAYS": settings.keep_attempts_days,
            "PHYSHANDI_KEEP_LOGS_DAYS": settings.keep_logs_days,
            "PHYSHANDI_KEEP_CACHE_DAYS": settings.keep_cache_days,
            "PHYSHANDI_CACHE_GIB": settings.cache_gib,
            "PHYSHANDI_KEEP_UPLOADS_DAYS": settings.keep_uploads_days,
        }

    def listed(self) -> list[Expendable]:
        """List what would go now, without changing anything."""
        now = self._clock()
        expendable = list(self._of_runs(now))
        expendable += self._of_cache(now)
        limit = self._settings.keep_uploads_days
        for upload_id, folder, touched in self._uploads.left_alone():
            if limit is not None and (days := (now - touched) / _DAY_S) > limit:
                rule, size = "PHYSHANDI_KEEP_UPLOADS_DAYS", freed_by([folder])
                expendable.append(
                    Expendable("upload", self._named(folder), size, days, rule, upload_id)
                )
        return expendable

    def describe(self) -> dict[str, Any]:
        """Tell what would go now.

        Returns:
            ``rules`` (see `rules`), ``items`` (see `Expendable`) and their ``bytes``.
        """
        items = self.listed()
        total = sum(item.bytes for item in items)
        return {"rules": self.rules, "items": [asdict(item) for item in items], "bytes": total}

    def remove(self) -> list[Expendable]:
        """Remove what may go, and note it; gives what went."""
        with self._removing:
            gone: list[Expendable] = []
            for item in self.listed():
                try:
                    is_gone = self._remove(item)
                except (PhysHandiError, OSError) as error:
                    logger.warning("%s stays: %s", item.name, describe(error))
                    continue
                if is_gone:
                    gone.append(item)
                    what = {"run_id": item.id} if item.kind in {"attempts", "log"} else {}
                    about = {"name": item.name, "bytes": item.bytes, "rule": item.rule}
                    self._note({"what": f"remove {item.kind}", **what, **about})
            return gone

    def _of_runs(self, now: float) -> Iterator[Expendable]:
        attempts, logs = self._settings.keep_attempts_days, self._settings.keep_logs_days
        if attempts is None and logs is None:
            return
        for item in self._catalog.runs():
            run = item.run
            if run is None or item.is_bundled or not self._scheduler.has_ended(item):
                continue
            try:
                days = (now - (item.folder / EXIT).stat().st_mtime) / _DAY_S
            except OSError:
                continue  # It was deleted since.
            if attempts is not None and days > attempts:
                size, place = freed_by(unneeded_attempts(run)), item.folder / ATTEMPTS
                if size:
                    rule = "PHYSHANDI_KEEP_ATTEMPTS_DAYS"
                    yield Expendable("attempts", self._named(place), size, days, rule, item.id)
            files = [path for path in _log_files(run) if path.exists()]
            if logs is not None and days > logs and files:
                size, rule = freed_by(files), "PHYSHANDI_KEEP_LOGS_DAYS"
                yield Expendable("log", self._named(files[0]), size, days, rule, item.id)

    def _of_cache(self, now: float) -> Iterator[Expendable]:
        days, most = self._settings.keep_cache_days, self._settings.cache_gib
        if days is None and most is None:
            return
        # The index of runs is no picture or export of which there may be too many.
        folders = (self._settings.data_dir / "cache" / place for place in ("previews", "exports"))
        files = files_by_age(path for folder in folders for path in folder.glob("[!.]*"))
        over = -1.0 if most is None else sum(size for _, size, _ in files) - most * 2**30
        for used, size, path in files:
            age = (now - used) / _DAY_S
            if days is not None and age > days:
                yield Expendable("cache", self._named(path), size, age, "PHYSHANDI_KEEP_CACHE_DAYS")
                over -= size
            elif over > 0:
                yield Expendable("cache", self._named(path), size, age, "PHYSHANDI_CACHE_GIB")
                over -= size

    def _remove(self, item: Expendable) -> bool:
        if item.kind == "cache":
            (self._settings.data_dir / item.name).unlink()
            return True
        if item.kind == "upload":
            try:
                self._uploads.remove_folder(item.id)
            except NotFoundError:
                return False
            return True
        do = _remove_attempts if item.kind == "attempts" else _remove_log_files
        return self._scheduler.do_if_ended(item.id, do)

    def _named(self, path: Path) -> str:
        return path.relative_to(self._settings.data_dir).as_posix()

    def _work(self) -> None:
        while True:
            try:
                gone = self.remove()
                if gone:
                    freed = sum(item.bytes for item in gone) / 2**20
                    logger.info("%d things were removed, %.0f MiB", len(gone), freed)
            except Exception:
                logger.exception("what may go could not be removed; it is tried again")
            if self._closed.wait(_INTERVAL_S):
                return


def unneeded_attempts(run: Run) -> list[Path]:
    """List the attempts of an ended run that have not published its results."""
    published = run.out.parent if run.is_published else None
    folder = run.folder / ATTEMPTS
    attempts = sorted(folder.iterdir()) if folder.is_dir() else []
    return [path for path in attempts if path != published]


def freed_by(paths: Iterable[Path]) -> int:
    """Add up what is free once some files and folders are gone [bytes].

    A file that also has a name elsewhere, as in the attempt that went on from another one, stays.
    """
    names: Counter[tuple[int, int]] = Counter()
    files: dict[tuple[int, int], tuple[int, int]] = {}
    for path in paths:
        for file in (path, *path.rglob("*")):
            status = file.lstat()
            if not file.is_dir():
                key = (status.st_dev, status.st_ino)
                names[key] += 1
                files[key] = (status.st_nlink, status.st_size)
    return sum(size for key, (links, size) in files.items() if names[key] >= links)


def _remove_attempts(run: Run) -> None:
    if run.is_published:
        run.forget_attempts()
    else:
        run.start_over()


def _remove_log_files(run: Run) -> None:
    for path in _log_files(run):
        path.unlink(missing_ok=True)


def _log_files(run: Run) -> tuple[Path, Path]:
    """Name the files that tell how an ended fit went, but for its losses."""
    return run.folder / LOG, run.folder / PREVIEW
