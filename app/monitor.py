"""What there is to say about the machine, the queue and the program, as plain data."""

import asyncio
import time
from collections.abc import Iterable
from dataclasses import asdict
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse, StreamingResponse
from pydantic import BaseModel, ConfigDict, Field, JsonValue

from app.jobs.catalog import Catalog, NotFoundError
from app.jobs.eta import Forecast
from app.jobs.machine import Machine
from app.jobs.order import settings_of_run, shown_value
from app.jobs.scheduler import Scheduler
from app.jobs.streams import News, Streams
from app.jobs.views import describe_run, describe_sequence
from app.jobs.watch import preview_bytes
from app.pages import Pages
from app.settings import Settings
from physhandi.data.environment import describe_environment
from physhandi.errors import SettingsError, UsageError
from physhandi.fitting.config import (
    GROUPS,
    all_settings,
    apply_overrides,
    named_profile,
    overrides_of,
    profile_names,
    values_of,
)


class Overview:
    """Describes the machine, its queue and the program."""

    def __init__(
        self, settings: Settings, catalog: Catalog, scheduler: Scheduler, machine: Machine
    ) -> None:
        """Prepare.

        Args:
            settings: What the server was told.
            catalog: Finds runs and sequences.
            scheduler: Knows what is at work and in line.
            machine: Measures the load.
        """
        self._settings = settings
        self._catalog = catalog
        self._scheduler = scheduler
        self._machine = machine
        about = describe_environment(settings.device)
        self._program = {
            name: about[name] for name in ("packages", "python", "system", "commit", "started")
        }

    def whole(self) -> dict[str, Any]:
        """Describe everything: `moving`, and what stays.

        Returns:
            `moving` with ``program`` (``packages python system commit started``), ``device`` of
            fits and ``data_dir``.
        """
        return self.moving() | {
            "program": self._program,
            "device": self._settings.device,
            "data_dir": str(self._settings.data_dir),
        }

    def moving(self) -> dict[str, Any]:
        """Describe what changes all the time.

        Returns:
            ``machine`` (see `Machine.load`), ``slots`` (``used total``), and the runs ``running``
            and ``waiting`` (see `describe_run`), the running ones with ``load`` (see
            `Machine.of_run`).
        """
        running: list[dict[str, Any]] = []
        for run in self._scheduler.at_work():
            described = describe_run(self._catalog.run_item(run.id), self._scheduler)
            running.append(described | {"load": self._machine.of_run(run.folder)})
        waiting = [
            describe_run(self._catalog.run_item(run.id), self._scheduler)
            for run in self._scheduler.in_line()
        ]
        return {
            "machine": self._machine.load(),
            "slots": {"used": len(running), "total": self._scheduler.slots},
            "running": running,
            "waiting": waiting,
        }


def describe_settings(catalog: Catalog, profile: str | None, run_id: str | None) -> dict[str, Any]:
    """List all settings with their values, to be changed one by one.

    Args:
        catalog: Finds the run.
        profile: Values of this profile; none takes the run's, else the quick one.
        run_id: A run whose own values are given beside those of its profile.

    Returns:
        ``profile``, ``parent`` (the run's id, else none), ``description`` and ``settings``: rows
        of all that a `Setting` has, with ``base`` (the profile's value) and ``value``.

    Raises:
        UsageError: If there is no such profile, or the run has no settings that can be changed.
    """
    own: dict[str, Any] = {}
    if run_id is not None:
        run = catalog.run(run_id)
        config = settings_of_run(run)
        if config is None:
            raise UsageError(
                f"Run '{run_id}' cannot be fitted again with changes: it is a simulation, or "
                "another version of the program made it. Launch a new fit of its sequence."
            )
        # A profile of the user's own is not among those offered; the run holds all its settings.
        of_run = config.profile if config.profile in profile_names() else "default"
        if profile in {None, of_run}:
            profile, own = of_run, values_of(config)
    base = named_profile(profile or "quick")
    before = values_of(base)
    return {
        "profile": base.profile,
        "parent": run_id,
        "description": base.description,
        "settings": [
            asdict(setting)
            | {
                "group_name": GROUPS[setting.group],
                "base": before[setting.path],
                "base_text": shown_value(before[setting.path]),
                "value": own.get(setting.path, before[setting.path]),
            }
            for setting in all_settings()
        ],
    }


def check_order(
    catalog: Catalog,
    forecast: Forecast,
    sequence_ids: list[str],
    profile: str,
    overrides: dict[str, Any],
) -> dict[str, Any]:
    """Tell what a fit would be, without launching it.

    Returns:
        ``problems`` (``field message`` of each setting that is wrong), ``overrides`` that differ
        from the profile, and ``expected``: ``seconds basis``, none if no earlier fit is known.

    Raises:
        UsageError: If there is no such profile.
        SequenceError: If a sequence is unknown or damaged.
    """
    base = named_profile(profile)
    sequences = [catalog.sequence(sequence_id) for sequence_id in sequence_ids]
    try:
        config = apply_overrides(base, overrides)
    except SettingsError as error:
        problems = [{"field": path, "message": told} for path, told in error.fields.items()]
        return {"problems": problems, "overrides": {}, "expected": None}
    expected = forecast.of_order(config.to_dict(), sequences)
    return {"problems": [], "overrides": overrides_of(config, base), "expected": expected}


Id = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
Path = Annotated[str, Field(max_length=200)]
_INTERVAL_S = 1.0


class Draft(BaseModel):
    """A fit that is not launched yet."""

    model_config = ConfigDict(extra="forbid")

    sequences: Annotated[list[Id], Field(max_length=64)] = []
    profile: Id = "quick"
    overrides: Annotated[dict[Path, JsonValue], Field(max_length=200)] = {}


def create_monitor(
    catalog: Catalog, scheduler: Scheduler, overview: Overview, pages: Pages
) -> APIRouter:
    """Make the routes.

    Args:
        catalog: Finds sequences and runs.
        scheduler: Knows earlier fits and their times.
        overview: Describes machine and queue.
        pages: Renders.
    """
    router = APIRouter()
    _add_system(router, overview, pages)
    _add_drafts(router, catalog, scheduler, pages)

    @router.get("/api/v1/runs/{run_id}/preview")
    def show_preview(run_id: Id) -> Response:
        """Give what a running fit shows of itself: few frames, few points (safetensors)."""
        content = preview_bytes(catalog.run_item(run_id).folder)
        if content is None:
            raise NotFoundError(f"Run '{run_id}' has shown nothing yet.")
        headers = {"Cache-Control": "no-store"}
        return Response(content, media_type="application/octet-stream", headers=headers)

    return router


def _add_system(router: APIRouter, overview: Overview, pages: Pages) -> None:
    streams = Streams()

    @router.get("/api/v1/system")
    def show_system() -> dict[str, Any]:
        return overview.whole()

    @router.get("/api/v1/system/events")
    async def watch_system(request: Request) -> StreamingResponse:
        known: dict[str, Any] = {}
        looked = 0.0

        def news() -> Iterable[News]:
            nonlocal known, looked
            if time.monotonic() - looked < _INTERVAL_S:
                return
            looked = time.monotonic()
            found = overview.moving()
            if found != known:
                known = found
                yield "0", "system", found

        return streams.answer(request, news)

    @router.get("/system", include_in_schema=False)
    def system() -> HTMLResponse:
        return pages.render("system.html", system=overview.whole())


def _add_drafts(router: APIRouter, catalog: Catalog, scheduler: Scheduler, pages: Pages) -> None:
    @router.get("/api/v1/settings")
    def show_settings(profile: Id | None = None, run: Id | None = None) -> dict[str, Any]:
        """List all settings of a profile, or of a run beside its profile."""
        return describe_settings(catalog, profile, run)

    @router.post("/api/v1/runs/check")
    def check(draft: Draft) -> dict[str, Any]:
        """Tell what differs from the profile and how long the fit would take."""
        return check_order(
            catalog, scheduler.forecast, draft.sequences, draft.profile, draft.overrides
        )

    @router.get("/launch", include_in_schema=False)
    async def launch(
        run: Annotated[Id | None, Query()] = None,
        profile: Annotated[Id | None, Query()] = None,
        sequence: Annotated[Id | None, Query()] = None,
    ) -> HTMLResponse:
        return await asyncio.to_thread(_launch_page, catalog, pages, run, profile, sequence)


def _launch_page(
    catalog: Catalog, pages: Pages, run_id: str | None, profile: str | None, sequence: str | None
) -> HTMLResponse:
    found = describe_settings(catalog, profile, run_id)
    sequences = [entry for s in catalog.sequences() if not (entry := describe_sequence(s))["error"]]
    item = catalog.run_item(run_id) if run_id else None
    chosen: set[str | None] = {sequence}
    missing: list[str] = []
    if item is not None and item.run is not None:
        folders = {str(s.folder): s.id for s in catalog.sequences()}
        names = {entry["name"]: entry["id"] for entry in sequences}
        for folder, name in zip(item.run.sequences, item.run.sequence_names, strict=True):
            known = folders.get(folder, names.get(name))
            if known is None:
                missing.append(name)
            chosen.add(known)
    groups: dict[str, list[dict[str, Any]]] = {}
    for setting in found["settings"]:
        groups.setdefault(setting["group_name"], []).append(setting)
    return pages.render(
        "launch.html",
        parent=item and {"id": item.id, "name": item.run.name if item.run else item.id},
        profile=found["profile"],
        description=found["description"],
        profiles=[(name, named_profile(name).description) for name in profile_names()],
        groups=groups,
        sequences=sequences,
        chosen=chosen,
        missing=missing,
    )
