"""The REST interface below /api/v1: nothing but translation."""

import asyncio
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.responses import FileResponse, StreamingResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.background import BackgroundTask
from starlette.exceptions import HTTPException

from app.jobs.catalog import Catalog, NotFoundError
from app.jobs.describe import (
    describe_results,
    describe_run,
    describe_sequence,
    follow_run,
    frame_errors,
    loss_curves,
)
from app.jobs.feed import Feed
from app.jobs.listing import RunQuery, page_of, select_runs
from app.jobs.log import open_log
from app.jobs.scheduler import Scheduler
from app.jobs.streams import News, Streams
from app.jobs.watch import Watch
from physhandi.data.exporters import export_run
from physhandi.errors import RunError
from physhandi.fitting.profile import load_profile, profile_names

Id = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
ExportFormat = Literal["ply", "gltf", "npz", "csv", "yaml"]


class OpenScene(Protocol):
    """A live scene that is open."""

    def prefer_dark(self, *, on: bool) -> None:
        """Follow the browser's color scheme."""
        ...


class SessionOpener(Protocol):
    """The part of the live viewer that the API needs."""

    def open(self, kind: Literal["run", "sequence"], target: str, owner: str) -> str:
        """Open a live scene and return its id."""
        ...

    def close(self, session_id: str) -> bool:
        """Close a live scene."""
        ...

    def find(self, session_id: str, owner: str) -> OpenScene | None:
        """Find a live scene of an owner."""
        ...


class NewRun(BaseModel):
    """A fit to launch."""

    model_config = ConfigDict(extra="forbid")

    sequences: Annotated[list[Id], Field(min_length=1, max_length=64)]
    profile: Id = "quick"
    name: Annotated[str, Field(max_length=120)] = ""


class NewSession(BaseModel):
    """A live scene to open."""

    model_config = ConfigDict(extra="forbid")

    kind: Literal["run", "sequence"]
    id: Id


class SessionWishes(BaseModel):
    """What a browser asks of a live scene."""

    model_config = ConfigDict(extra="forbid")

    dark: bool


def create_api(
    catalog: Catalog, scheduler: Scheduler, feed: Feed, sessions: SessionOpener
) -> APIRouter:
    """Make the routes.

    Args:
        catalog: Finds sequences and runs.
        scheduler: Launches and cancels fits.
        feed: Tells what changed.
        sessions: Opens live scenes.
    """
    router = APIRouter(prefix="/api/v1")
    _add_listings(router, catalog, scheduler)
    _add_jobs(router, catalog, scheduler)
    _add_sessions(router, sessions)
    _add_streams(router, catalog, scheduler, feed)
    return router


def _add_listings(router: APIRouter, catalog: Catalog, scheduler: Scheduler) -> None:
    @router.get("/sequences")
    def list_sequences() -> dict[str, Any]:
        return {"sequences": [describe_sequence(item) for item in catalog.sequences()]}

    @router.get("/sequences/{sequence_id}")
    def show_sequence(sequence_id: Id) -> dict[str, Any]:
        return describe_sequence(catalog.sequence_item(sequence_id))

    @router.get("/runs")
    def list_runs(query: Annotated[RunQuery, Query()]) -> dict[str, Any]:
        runs = select_runs([describe_run(item, scheduler) for item in catalog.runs()], query)
        return {"runs": page_of(runs, query), "total": len(runs)}

    @router.get("/runs/{run_id}")
    def show_run(run_id: Id) -> dict[str, Any]:
        item = catalog.run_item(run_id)
        results = describe_results(item.run) if item.run else {}
        return follow_run(item, scheduler) | {"results": results}

    @router.get("/runs/{run_id}/losses")
    def show_losses(run_id: Id) -> dict[str, Any]:
        losses, number = loss_curves(catalog.run(run_id))
        return {"losses": losses, "seq": number}

    @router.get("/runs/{run_id}/frame_errors")
    def show_frame_errors(run_id: Id) -> dict[str, Any]:
        return {"sequences": frame_errors(catalog.run(run_id))}

    @router.get("/runs/{run_id}/log")
    def show_log(run_id: Id) -> Response:
        log = open_log(catalog.run_item(run_id).folder)
        headers = {"Content-Disposition": f'attachment; filename="{run_id}_log.txt"'}
        if log is None:
            raise NotFoundError(f"Run '{run_id}' has no log yet.")
        content = iter(lambda: log.read(2**16), b"")
        clean_up = BackgroundTask(log.close)
        return StreamingResponse(
            content, media_type="text/plain; charset=utf-8", headers=headers, background=clean_up
        )

    @router.get("/profiles")
    def list_profiles() -> dict[str, Any]:
        names = profile_names()
        return {
            "profiles": [
                {"name": name, "description": load_profile(name).description} for name in names
            ]
        }


def _add_jobs(router: APIRouter, catalog: Catalog, scheduler: Scheduler) -> None:
    @router.post("/runs", status_code=201)
    def launch(new: NewRun) -> dict[str, Any]:
        run = scheduler.launch(new.sequences, new.profile, new.name)
        return describe_run(catalog.run_item(run.id), scheduler)

    @router.post("/runs/{run_id}/cancel")
    def cancel(run_id: Id) -> dict[str, Any]:
        scheduler.cancel(run_id)
        return describe_run(catalog.run_item(run_id), scheduler)

    @router.post("/runs/{run_id}/resume")
    def resume(run_id: Id) -> dict[str, Any]:
        scheduler.resume(run_id)
        return describe_run(catalog.run_item(run_id), scheduler)

    @router.delete("/runs/{run_id}", status_code=204)
    def delete(run_id: Id) -> Response:
        scheduler.delete(run_id)
        return Response(status_code=204)

    @router.get("/runs/{run_id}/export")
    def export(
        run_id: Id,
        kind: Annotated[ExportFormat, Query(alias="format")],
        sequence: Annotated[str | None, Query(max_length=200)] = None,
    ) -> FileResponse:
        return _export(catalog, run_id, kind, sequence)


def _add_sessions(router: APIRouter, sessions: SessionOpener) -> None:
    @router.post("/sessions", status_code=201)
    def open_session(new: NewSession, request: Request) -> dict[str, str]:
        session_id = sessions.open(new.kind, new.id, request.state.owner)
        return {"id": session_id, "url": f"/live/{session_id}"}

    def find(session_id: str, request: Request) -> OpenScene:
        scene = sessions.find(session_id, request.state.owner)
        if scene is None:
            raise HTTPException(404, "This live scene was closed, or it is not yours.")
        return scene

    @router.get("/sessions/{session_id}")
    def show_session(session_id: Id, request: Request) -> dict[str, str]:
        find(session_id, request)
        return {"id": session_id, "url": f"/live/{session_id}"}

    @router.patch("/sessions/{session_id}", status_code=204)
    def change_session(session_id: Id, wishes: SessionWishes, request: Request) -> Response:
        find(session_id, request).prefer_dark(on=wishes.dark)
        return Response(status_code=204)

    @router.delete("/sessions/{session_id}", status_code=204)
    def close_session(session_id: Id, request: Request) -> Response:
        if sessions.find(session_id, request.state.owner) is not None:
            sessions.close(session_id)
        return Response(status_code=204)


def _add_streams(router: APIRouter, catalog: Catalog, scheduler: Scheduler, feed: Feed) -> None:
    streams = Streams()

    @router.get("/events")
    async def follow_runs(
        request: Request,
        since: Annotated[str | None, Query(max_length=64)] = None,
        last_event_id: Annotated[str | None, Header(max_length=64)] = None,
    ) -> StreamingResponse:
        last = last_event_id or since or await asyncio.to_thread(feed.cursor)

        def news() -> Iterable[News]:
            nonlocal last
            for change in feed.since(last):
                last = change.id
                yield change.id, change.event, change.data

        return streams.answer(request, news)

    @router.get("/runs/{run_id}/events")
    async def watch_run(
        request: Request,
        run_id: Id,
        since: Annotated[str | None, Query(max_length=64)] = None,
        last_event_id: Annotated[str | None, Header(max_length=64)] = None,
    ) -> StreamingResponse:
        item = await asyncio.to_thread(catalog.run_item, run_id)
        watch = Watch(item.folder, lambda: follow_run(item, scheduler), last_event_id or since)
        return streams.answer(request, watch.news)


def _export(
    catalog: Catalog, run_id: str, kind: ExportFormat, sequence: str | None
) -> FileResponse:
    run = catalog.run(run_id)
    if not run.is_published:
        raise RunError(f"Run '{run_id}' is {run.state}: there is nothing to export yet.")
    run.verify(allows_more=True)
    folder = Path(tempfile.mkdtemp(prefix="physhandi-export-"))
    try:
        suffix = "glb" if kind == "gltf" else kind
        name = f"{run_id}_{kind}" if kind == "ply" else f"{run_id}.{suffix}"
        path = export_run(run, kind, folder / name, sequence=sequence)
        if path.is_dir():
            path = Path(shutil.make_archive(str(path), "zip", path))
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    clean_up = BackgroundTask(shutil.rmtree, folder, ignore_errors=True)
    return FileResponse(path, filename=path.name, background=clean_up)
