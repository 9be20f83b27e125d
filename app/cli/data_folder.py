"""Checks of a data folder by `physhandi doctor`, and `physhandi reindex`."""

import os
from collections.abc import Iterator
from pathlib import Path

from app.cli.lookup import read_settings
from app.cli.output import AsJson, DataDir, show
from app.jobs.catalog import Catalog
from app.jobs.recordings.background import BackgroundTasks
from app.jobs.recordings.uploads import Uploads
from app.jobs.recovery.aside import moved_folders
from app.jobs.recovery.left_behind import find_left_behind
from app.jobs.recovery.recovery import damaged_folders
from app.jobs.scheduler import Scheduler, server_of
from app.jobs.storage.retention import Retention
from app.settings import ServerSettings
from physhandi.data.run_folder import read_mapping
from physhandi.errors import RunError


def reindex(*, data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """Make the index of runs anew from their folders, which hold all that must not be lost.

    Also while a server works on the data folder.
    """
    settings = read_settings(data_dir=data_dir)
    catalog = Catalog(settings)
    catalog.reindex()
    damaged = damaged_folders(catalog, Scheduler(settings, catalog))
    report = {
        "index": str(settings.index_path),
        "runs": sum(item.run is not None and not item.is_bundled for item in catalog.runs()),
        "damaged": {f"{folder.kind}/{folder.id}": folder.why for folder in damaged},
    }
    show(report, as_json=as_json)


def look_through(data_dir: Path | None) -> Iterator[tuple[bool, str]]:
    """Say what is in a data folder, a line each, and whether it is well; nothing is changed.

    Args:
        data_dir: The folder; none takes that of the settings.

    Yields:
        Whether the line tells of nothing damaged, and the line.
    """
    settings = read_settings(data_dir=data_dir)
    if not settings.data_dir.is_dir():
        yield True, f"ok    data folder: {settings.data_dir} is not there yet"
        return
    catalog = Catalog(settings)
    damaged = damaged_folders(catalog, Scheduler(settings, catalog))
    own = [item for item in catalog.runs() if not item.is_bundled]
    recordings = [item for item in catalog.sequences() if not item.is_bundled]
    yield (
        True,
        (
            f"ok    data folder: {settings.data_dir} has {len(own)} runs and {len(recordings)} "
            f"sequences, {len(damaged)} of them damaged"
        ),
    )
    for folder in damaged:
        yield False, f"FAIL  {folder.kind}/{folder.id}: {folder.why}"
    for problem in _other_problems(settings):
        yield False, f"FAIL  {problem}"
    for remark in (*_remarks(settings), *_expendable(settings, catalog)):
        yield True, f"note  {remark}"


def _other_problems(settings: ServerSettings) -> Iterator[str]:
    # Every command imports this file; these import what draws.
    from app.exports.shares import Shares
    from app.viewer.physics.edit_presets import EditPresetStore
    from app.viewer.physics.presets import PresetStore

    try:
        read_mapping(settings.launches_path)
    except RunError as error:
        yield f"keys of launches: {error}"
    folder = settings.data_dir / "presets"
    for store in (PresetStore(folder), EditPresetStore(folder)):
        yield from (f"{store.what}: {problem}" for problem in store.presets()[1])
    for problem in Shares(settings.data_dir / "shares").problems():
        yield f"shared page: {problem}"
    if not os.access(settings.data_dir, os.R_OK | os.W_OK | os.X_OK):
        yield f"{settings.data_dir}: files cannot be written here; change its permissions"


def _expendable(settings: ServerSettings, catalog: Catalog) -> Iterator[str]:
    """Say what a server with these settings would remove, by the rule that lets it go."""
    uploads = Uploads(settings, BackgroundTasks())
    scheduler = Scheduler(settings, catalog)
    retention = Retention(settings, catalog, scheduler, uploads, lambda _: None)
    items = retention.listed()
    for rule, limit in retention.rules.items():
        going = [item for item in items if item.rule == rule]
        if going:
            names = ", ".join(item.name for item in going[:5])
            size = sum(item.bytes for item in going) / 2**20
            yield (
                f"{len(going)} would be removed by a server, {size:.1f} MiB ({rule}={limit:g}): "
                f"{names}{', …' if len(going) > 5 else ''}"
            )


def _remarks(settings: ServerSettings) -> Iterator[str]:
    server = server_of(settings.data_dir)
    if server is not None:
        yield f"a server (process {server}) works on it"
    left = find_left_behind(settings)
    mends = "the next server that starts here"
    for paths, what in (
        (left.temporaries, f"were left unfinished by killed processes; {mends} removes them"),
        (left.claims, f"are claimed by processes that are gone; {mends} releases them"),
        (left.replaced, f"were about to be replaced; {mends} puts them back"),
        (left.imports, "are imports that can be gone on with"),
    ):
        if paths:
            names = ", ".join(path.relative_to(settings.data_dir).as_posix() for path in paths[:5])
            yield f"{len(paths)} {what}: {names}{', …' if len(paths) > 5 else ''}"
    aside = moved_folders(settings.damaged_dir)
    if aside:
        names = ", ".join(f"damaged/{moved.kind}/{moved.name}" for moved in aside[:5])
        yield f"{len(aside)} moved aside: {names}{', …' if len(aside) > 5 else ''}"
