"""Routes of the machine's load, of previews, and of fits with other settings."""

import asyncio
import time
from collections.abc import Iterable
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse, StreamingResponse
from pydantic import BaseModel, ConfigDict, Field, JsonValue

from app.jobs.catalog import Catalog, NotFoundError
from app.jobs.describe import describe_sequence
from app.jobs.preview import preview_bytes
from app.jobs.scheduler import Scheduler
from app.jobs.streams import News, Streams
from app.monitor.overview import Overview, check_order, describe_settings
from app.pages import Pages
from physhandi.fitting.profile import load_profile, profile_names

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
        profiles=[(name, load_profile(name).description) for name in profile_names()],
        groups=groups,
        sequences=sequences,
        chosen=chosen,
        missing=missing,
    )
