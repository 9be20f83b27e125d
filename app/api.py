"""The REST interface below /api/v1: nothing but translation."""

import asyncio
import json
import shutil
import tempfile
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.responses import FileResponse, StreamingResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.background import BackgroundTask

from app.jobs.catalog import Catalog
from app.jobs.describe import describe_results, describe_run, describe_sequence, loss_curves
from app.jobs.feed import Feed
from app.jobs.scheduler import Scheduler
from physhandi.data.exporters import export_run
from physhandi.data.run import read_events
from physhandi.errors import RunError
from physhandi.fitting.profile import load_profile, profile_names

Id = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
ExportFormat = Literal["ply", "npz", "csv", "yaml"]
STREAMS_PER_OWNER = 12
"""Event streams that one browser may hold; a further one ends the oldest."""
_POLL_S = 0.4
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
    _add_streams(router, catalog, feed)
    return router


def _add_listings(router: APIRouter, catalog: Catalog, scheduler: Scheduler) -> None:
    @router.get("/sequences")
    def list_sequences() -> dict[str, Any]:
        return {"sequences": [describe_sequence(item) for item in catalog.sequences()]}

    @router.get("/sequences/{sequence_id}")
    def show_sequence(sequence_id: Id) -> dict[str, Any]:
        return describe_sequence(catalog.sequence_item(sequence_id))

    @router.get("/runs")
    def list_runs() -> dict[str, Any]:
        return {"runs": [describe_run(item, scheduler) for item in catalog.runs()]}

    @router.get("/runs/{run_id}")
    def show_run(run_id: Id) -> dict[str, Any]:
        item = catalog.run_item(run_id)
        results = describe_results(item.run) if item.run else {}
        return describe_run(item, scheduler) | {"results": results}

    @router.get("/runs/{run_id}/losses")
    def show_losses(run_id: Id) -> dict[str, Any]:
        return {"losses": loss_curves(catalog.run(run_id))}

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

    @router.delete("/sessions/{session_id}", status_code=204)
    def close_session(session_id: Id) -> Response:
        sessions.close(session_id)
        return Response(status_code=204)


def _add_streams(router: APIRouter, catalog: Catalog, feed: Feed) -> None:
    streams = _Streams(STREAMS_PER_OWNER)

    @router.get("/events")
    async def follow_runs(
        request: Request,
        since: Annotated[str | None, Query(max_length=64)] = None,
        last_event_id: Annotated[str | None, Header(max_length=64)] = None,
    ) -> StreamingResponse:
        last = last_event_id or since or await asyncio.to_thread(feed.cursor)

        def news() -> Iterable[tuple[str, str, object]]:
            nonlocal last
            for change in feed.since(last):
                last = change.id
                yield change.id, change.event, change.data

        return _stream(request, streams, news)

    @router.get("/runs/{run_id}/events")
    async def follow_run(
        request: Request, run_id: Id, last_event_id: Annotated[str | None, Header()] = None
    ) -> StreamingResponse:
        folder = (await asyncio.to_thread(catalog.run_item, run_id)).folder
        is_number = (last_event_id or "").isdecimal() and len(last_event_id or "") < 18
        seen, offset = int(last_event_id or 0) if is_number else -1, 0

        def news() -> Iterable[tuple[str, str, object]]:
            nonlocal offset
            events, offset = read_events(folder, offset)
            for event in events:
                if int(event.get("seq", -1)) > seen:
                    yield str(event["seq"]), "progress", event

        return _stream(request, streams, news)


class _Streams:
    """Counts the event streams of each browser and ends the oldest of too many."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._lock = threading.Lock()
        self._open: dict[str, deque[threading.Event]] = {}

    def enter(self, owner: str) -> threading.Event:
        """Register a stream; the returned event is set when it has to end."""
        ended = threading.Event()
        with self._lock:
            streams = self._open.setdefault(owner, deque())
            streams.append(ended)
            if len(streams) > self._limit:
                streams.popleft().set()
        return ended

    def leave(self, owner: str, ended: threading.Event) -> None:
        """Forget a stream that is over."""
        with self._lock:
            streams = self._open.get(owner, deque())
            if ended in streams:
                streams.remove(ended)
            if not streams:
                self._open.pop(owner, None)


def _stream(
    request: Request, streams: _Streams, news: Callable[[], Iterable[tuple[str, str, object]]]
) -> StreamingResponse:
    """Send server-sent events: what is new, and a comment now and then if nothing is."""
    owner: str = request.state.owner
    stopping: threading.Event = request.app.state.stopping

    async def events() -> AsyncIterator[str]:
        ended, quiet = streams.enter(owner), 0.0
        try:
            yield "retry: 2000\n\n"
            while not (ended.is_set() or stopping.is_set() or await request.is_disconnected()):
                quiet += _POLL_S
                for name, event, data in await asyncio.to_thread(lambda: list(news())):
                    quiet = 0.0
                    text = json.dumps(data, ensure_ascii=False)
                    yield f"id: {name}\nevent: {event}\ndata: {text}\n\n"
                if quiet >= _PING_S:
                    quiet = 0.0
                    yield ": ping\n\n"
                await asyncio.sleep(_POLL_S)
        finally:
            streams.leave(owner, ended)

    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(events(), media_type="text/event-stream", headers=headers)


def _export(
    catalog: Catalog, run_id: str, kind: ExportFormat, sequence: str | None
) -> FileResponse:
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
