"""The REST interface below /api/v1: nothing but translation."""

import asyncio
import json
import shutil
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

from fastapi import APIRouter, Header, Request, Response
from fastapi.responses import FileResponse, StreamingResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.background import BackgroundTask

from app.describe import describe_results, describe_run, describe_sequence
from app.jobs.catalog import Catalog
from app.jobs.scheduler import Scheduler
from physhandi.data.exporters import export_run
from physhandi.data.run import read_events
from physhandi.errors import RunError
from physhandi.fitting.profile import load_profile, profile_names

Id = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
_POLL_S = 0.5
_PING_S = 15.0


class SessionOpener(Protocol):
    """The part of the live viewer that the API needs."""

    def open(self, kind: Literal["run", "sequence"], target: str, owner: str) -> str:
        """Open a live scene and return its id."""
        ...

    def close(self, session_id: str) -> bool:
        """Close a live scene."""
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


def create_api(catalog: Catalog, scheduler: Scheduler, sessions: SessionOpener) -> APIRouter:
    """Make the routes.

    Args:
        catalog: Finds sequences and runs.
        scheduler: Launches and cancels fits.
        sessions: Opens live scenes.
    """
    router = APIRouter(prefix="/api/v1")

    @router.get("/sequences")
    def list_sequences() -> dict[str, Any]:
        return {"sequences": [describe_sequence(item) for item in catalog.sequences()]}

    @router.get("/runs")
    def list_runs() -> dict[str, Any]:
        return {"runs": [describe_run(item, scheduler) for item in catalog.runs()]}

    @router.get("/runs/{run_id}")
    def show_run(run_id: Id) -> dict[str, Any]:
        item = catalog.run_item(run_id)
        return describe_run(item, scheduler) | {"results": describe_results(item)}

    @router.get("/profiles")
    def list_profiles() -> dict[str, Any]:
        return {
            "profiles": [
                {"name": name, "description": load_profile(name).description}
                for name in profile_names()
            ]
        }

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
        format: Literal["ply", "npz", "csv", "yaml"],
        sequence: Id | None = None,  # noqa: A002  # the query's name
    ) -> FileResponse:
        return _export(catalog, run_id, format, sequence)

    @router.post("/sessions", status_code=201)
    def open_session(new: NewSession) -> dict[str, str]:
        session_id = sessions.open(new.kind, new.id, "browser")
        return {"id": session_id, "url": f"/live/{session_id}"}

    @router.delete("/sessions/{session_id}", status_code=204)
    def close_session(session_id: Id) -> Response:
        sessions.close(session_id)
        return Response(status_code=204)

    @router.get("/events")
    async def stream_runs(request: Request) -> StreamingResponse:
        return _stream(_run_changes(request, catalog, scheduler))

    @router.get("/runs/{run_id}/events")
    async def stream_log(
        request: Request, run_id: Id, last_event_id: Annotated[str | None, Header()] = None
    ) -> StreamingResponse:
        folder = (await asyncio.to_thread(catalog.run_item, run_id)).folder
        seen = int(last_event_id) if (last_event_id or "").isdigit() else -1
        return _stream(_run_events(request, folder, seen))

    return router


def _export(catalog: Catalog, run_id: str, kind: Any, sequence: str | None) -> FileResponse:
    run = catalog.run(run_id)
    if not run.is_published:
        raise RunError(f"Run '{run_id}' is {run.state}: there is nothing to export yet.")
    folder = Path(tempfile.mkdtemp(prefix="physhandi-export-"))
    try:
        name = f"{run_id}_{kind}" if kind == "ply" else f"{run_id}.{kind}"
        path = export_run(run, kind, folder / name, sequence=sequence)
        if path.is_dir():
            path = Path(shutil.make_archive(str(path), "zip", path))
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    clean_up = BackgroundTask(shutil.rmtree, folder, ignore_errors=True)
    return FileResponse(path, filename=path.name, background=clean_up)


def _stream(events: AsyncIterator[str]) -> StreamingResponse:
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(events, media_type="text/event-stream", headers=headers)


async def _run_changes(
    request: Request, catalog: Catalog, scheduler: Scheduler
) -> AsyncIterator[str]:
    """Send the list of runs whenever it changes; each event is the whole list."""
    known, quiet = "", 0.0
    while not await request.is_disconnected():
        items = await asyncio.to_thread(catalog.runs)
        runs = await asyncio.to_thread(
            lambda listed: [describe_run(i, scheduler) for i in listed], items
        )
        text = json.dumps(runs, ensure_ascii=False)
        quiet += _POLL_S
        if text != known:
            known, quiet = text, 0.0
            yield f"event: runs\ndata: {text}\n\n"
        elif quiet >= _PING_S:
            quiet = 0.0
            yield ": ping\n\n"
        await asyncio.sleep(_POLL_S)


async def _run_events(request: Request, folder: Path, seen: int) -> AsyncIterator[str]:
    """Send a run's progress reports; a reader that comes back names the last one it saw."""
    offset, quiet = 0, 0.0
    while not await request.is_disconnected():
        events, offset = await asyncio.to_thread(read_events, folder, offset)
        quiet += _POLL_S
        for event in events:
            if int(event["seq"]) > seen:
                quiet = 0.0
                yield f"id: {event['seq']}\nevent: progress\ndata: {json.dumps(event)}\n\n"
        if quiet >= _PING_S:
            quiet = 0.0
            yield ": ping\n\n"
        await asyncio.sleep(_POLL_S)
