"""The REST interface below /api/v1: nothing but translation."""

import asyncio
import time
from collections.abc import Iterable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi import Path as PathParameter
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, ConfigDict, Field, JsonValue, field_validator
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException

from app.ids import ItemId
from app.jobs.about import Line, RunChanges, change_about
from app.jobs.catalog import Catalog, NotFoundError
from app.jobs.checks import check_item
from app.jobs.launch_keys import KeyedRequest
from app.jobs.listing import RunQuery, page_of, select_runs
from app.jobs.log import open_log
from app.jobs.machine import Machine
from app.jobs.order import check_order, describe_order, describe_settings
from app.jobs.overview import Overview
from app.jobs.recordings.annotations import (
    Annotations,
    ChosenModels,
    ClickedPlace,
    PaintedMask,
)
from app.jobs.recordings.background import BackgroundTasks
from app.jobs.recordings.imports import ImportOrder, Imports
from app.jobs.recordings.upload_names import MOST_FILES
from app.jobs.recordings.uploads import Uploads
from app.jobs.recovery.aside import MovedFolder
from app.jobs.recovery.recovery import Recovery
from app.jobs.scheduler import Scheduler
from app.jobs.storage.retention import Retention
from app.jobs.streams import News, Streams
from app.jobs.ticket import Priority
from app.jobs.views import (
    describe_results,
    describe_run,
    describe_sequence,
    follow_run,
    loss_curves,
    read_frame_errors,
)
from app.jobs.watch import Feed, Watch, preview_bytes
from app.root_path import address_on
from app.viewer.compare.request import NewComparison
from app.viewer.sessions import AnySession, Sessions
from physhandi.fitting.config import named_profile, profile_names

SettingPath = Annotated[str, Field(max_length=200)]
_INTERVAL_S = 1.0


class NewRun(BaseModel):
    """A fit to launch."""

    model_config = ConfigDict(extra="forbid")

    sequences: Annotated[list[ItemId], Field(min_length=1, max_length=64)]
    profile: ItemId = "quick"
    name: Line = ""
    overrides: Annotated[dict[SettingPath, JsonValue], Field(max_length=200)] = {}
    """New values of settings by their paths; `GET /api/v1/settings` lists them."""
    parent: ItemId | None = None
    """The run that it was made from."""
    accepts_missing: bool = False
    """Whether the object may be left out although depth was recorded; else that is refused."""
    priority: Priority = "normal"
    """Its priority: ``high`` passes what came up to a day before, ``low`` lets by what comes up to
    a day later."""


class Again(BaseModel):
    """A fit to start once more, with the same settings."""

    model_config = ConfigDict(extra="forbid")

    afresh: bool = False
    """Whether it begins with its first stage; else it goes on where it was."""
    priority: Priority = "normal"


class NewPriority(BaseModel):
    """Priority of a fit in line."""

    model_config = ConfigDict(extra="forbid")

    priority: Priority


IdempotencyKey = Annotated[str | None, Header(min_length=1, max_length=255, pattern=r"^[!-~]+$")]


class Draft(BaseModel):
    """A fit that is not launched yet."""

    model_config = ConfigDict(extra="forbid")

    sequences: Annotated[list[ItemId], Field(max_length=64)] = []
    profile: ItemId = "quick"
    overrides: Annotated[dict[SettingPath, JsonValue], Field(max_length=200)] = {}


class NewClick(BaseModel):
    """A place on the object, in an image of the recording, or the middle of a box around it."""

    model_config = ConfigDict(extra="forbid")

    view: ItemId
    frame: Annotated[int, Field(ge=0, le=10_000_000)]
    x: Annotated[float, Field(ge=-1, le=100_000, allow_inf_nan=False)]
    y: Annotated[float, Field(ge=-1, le=100_000, allow_inf_nan=False)]
    width: Annotated[float, Field(ge=0, le=100_000, allow_inf_nan=False)] = 0.0
    """Width of the box [px]; 0 without one."""
    height: Annotated[float, Field(ge=0, le=100_000, allow_inf_nan=False)] = 0.0


ModelName = Annotated[str, Field(max_length=255)]


class NewAnnotation(BaseModel):
    """Masks and tracks to find."""

    model_config = ConfigDict(extra="forbid")

    clicks: Annotated[list[NewClick], Field(max_length=200)] = []
    """Places on the object; none finds hands alone."""
    overwrite: bool = False
    """Whether masks and tracks may be replaced that came from elsewhere."""
    mask_model: ModelName = ""
    """Network that finds masks, as `GET /api/v1/models` names it; empty for what is built in."""
    track_model: ModelName = ""
    """Network that finds tracks, named alike."""
    trusts_model_code: bool = False
    """Whether the code of `track_model` may be executed, which can do what the server can do."""


class NewMask(BaseModel):
    """The right mask of an image."""

    model_config = ConfigDict(extra="forbid")

    view: ItemId
    frame: Annotated[int, Field(ge=0, le=10_000_000)]
    runs: Annotated[
        list[Annotated[int, Field(ge=0, le=100_000_000)]], Field(min_length=2, max_length=400_000)
    ]
    """Labels row by row, each with how many pixels have it: 0 background, 1 object, 2 right and 3
    left hand."""

    @field_validator("runs")
    @classmethod
    def _are_labels(cls, value: list[int]) -> list[int]:
        if not set(value[::2]) <= {0, 1, 2, 3}:
            raise ValueError("labels are 0 to 3, and each is followed by its number of pixels")
        return value


class NewCorrection(BaseModel):
    """Masks to replace."""

    model_config = ConfigDict(extra="forbid")

    masks: Annotated[list[NewMask], Field(min_length=1, max_length=200)]
    carry_on: bool = False
    """Whether other frames are found anew from these, until the next one that was corrected."""


CapturePlace = Annotated[str, Field(max_length=1000)]


class SurveyQuery(BaseModel):
    """A recording to look at."""

    model_config = ConfigDict(extra="forbid")

    source: Annotated[CapturePlace, Field(min_length=1)]
    """Folder or bag, as `GET /api/v1/captures` names it."""
    intrinsics: CapturePlace = ""
    """File with the intrinsics of all cameras, named alike; empty for those in the folder."""
    depth_scale: Annotated[float | None, Field(gt=0, allow_inf_nan=False)] = None
    """Metres per unit of depth; above 1, units per metre; none as the recording says."""


class NewImport(SurveyQuery):
    """A recording to import; what is left out is found in the recording."""

    name: ItemId
    """Name of the new sequence."""
    charuco: Annotated[str, Field(max_length=40)] = ""
    """ChArUco board of the calibration pictures, like 7x5,0.04."""
    april_grid: Annotated[str, Field(max_length=40)] = ""
    """Grid of AprilTags of the calibration pictures, like 6x6,0.03,0.009."""
    by_table: bool = False
    """Whether cameras are placed by the table's own pattern, without board or stated poses."""
    start: Annotated[int, Field(ge=0, le=10_000_000)] = 0
    """First frame."""
    stop: Annotated[int | None, Field(ge=1, le=10_000_000)] = None
    """Frame before which the import ends; none is all."""
    every: Annotated[int, Field(ge=1, le=10_000)] = 1
    """Only every n-th frame."""
    frame_rate: Annotated[float | None, Field(ge=1, le=1000, allow_inf_nan=False)] = None
    """Frames per second, if the recording does not tell it."""
    hands: Annotated[list[Literal["right", "left"]], Field(min_length=1, max_length=2)] = ["right"]
    """Hands that the recording shows."""
    overwrite: bool = False
    """Whether a sequence of that name may be replaced."""


class UploadFile(BaseModel):
    """A file that is going to be sent."""

    model_config = ConfigDict(extra="forbid")

    path: Annotated[str, Field(min_length=1, max_length=500)]
    """Its name with slashes, below the folder that is sent."""
    size: Annotated[int, Field(ge=0, le=2**50)]
    """Its size [bytes]."""


class UploadName(BaseModel):
    """Name of an upload."""

    model_config = ConfigDict(extra="forbid")

    name: ItemId | None = None
    """Another name than it was announced with; none for that one."""


class NewUpload(BaseModel):
    """A recording, sequence or run to send: its files, or a zip archive of them."""

    model_config = ConfigDict(extra="forbid")

    name: ItemId
    """Its name."""
    files: Annotated[list[UploadFile], Field(min_length=1, max_length=2 * MOST_FILES)]


class NewSession(BaseModel):
    """A live scene to open."""

    model_config = ConfigDict(extra="forbid")

    kind: Literal["run", "sequence"]
    id: ItemId


NewScene = Annotated[NewSession | NewComparison, Field(discriminator="kind")]


class SessionWishes(BaseModel):
    """Changes that a browser asks for in a live scene."""

    model_config = ConfigDict(extra="forbid")

    dark: bool | None = None
    """Whether the browser asks for a dark background."""
    frame: Annotated[int | None, Field(ge=0, le=10_000_000)] = None
    """Frame to stop at."""


def create_api(
    catalog: Catalog,
    scheduler: Scheduler,
    feed: Feed,
    sessions: Sessions,
    *,
    machine: Machine,
    overview: Overview,
    tasks: BackgroundTasks,
    annotations: Annotations,
    imports: Imports,
    uploads: Uploads,
    recovery: Recovery,
    retention: Retention,
) -> APIRouter:
    """Make the routes.

    Args:
        catalog: Finds sequences and runs.
        scheduler: Launches and cancels fits.
        feed: Tells what changed.
        sessions: Opens live scenes.
        machine: Tells how busy the machine is.
        overview: Describes machine, queue and program.
        tasks: Tells which recordings are being worked on.
        annotations: Finds masks and tracks.
        imports: Makes sequences of recordings.
        uploads: Takes what is sent.
        recovery: Knows what is damaged.
        retention: Knows what may go.
    """
    router = APIRouter(prefix="/api/v1")
    _add_listings(router, catalog, scheduler)
    _add_annotations(router, annotations)
    _add_imports(router, imports)
    _add_uploads(router, uploads)
    _add_results(router, catalog)
    _add_jobs(router, catalog, scheduler, tasks)
    _add_line(router, catalog, scheduler, tasks)
    _add_sessions(router, sessions)
    _add_streams(router, catalog, scheduler, feed, machine)
    _add_system(router, overview)
    _add_recovery(router, scheduler, recovery)
    _add_retention(router, retention)
    return router


def _add_listings(router: APIRouter, catalog: Catalog, scheduler: Scheduler) -> None:
    @router.get("/sequences")
    def list_sequences() -> dict[str, Any]:
        return {"sequences": [describe_sequence(item) for item in catalog.sequences()]}

    @router.get("/sequences/{sequence_id}")
    def show_sequence(sequence_id: ItemId) -> dict[str, Any]:
        return describe_sequence(catalog.sequence_item(sequence_id))

    @router.get("/sequences/{sequence_id}/check")
    def check_sequence(sequence_id: ItemId) -> dict[str, Any]:
        """Read a whole recording: what each stage can do with it, and every problem."""
        return check_item(catalog.sequence_item(sequence_id)).to_dict()

    @router.get("/runs")
    def list_runs(query: Annotated[RunQuery, Query()]) -> dict[str, Any]:
        runs = select_runs([describe_run(item, scheduler) for item in catalog.runs()], query)
        return {"runs": page_of(runs, query), "total": len(runs)}

    @router.get("/runs/{run_id}")
    def show_run(run_id: ItemId) -> dict[str, Any]:
        item = catalog.run_item(run_id)
        # The state first: of a run that is called finished, all results are there.
        followed = follow_run(item, scheduler)
        results = describe_results(item.run) if item.run else {}
        order = describe_order(item.run) if item.run else {}
        return followed | order | {"results": results}

    @router.get("/profiles")
    def list_profiles() -> dict[str, Any]:
        names = profile_names()
        return {
            "profiles": [
                {"name": name, "description": named_profile(name).description} for name in names
            ]
        }


def _add_annotations(router: APIRouter, annotations: Annotations) -> None:
    @router.post("/sequences/{sequence_id}/annotation", status_code=202)
    def annotate(sequence_id: ItemId, new: NewAnnotation) -> dict[str, Any]:
        """Find masks and tracks of a recording from places on its object."""
        clicks = [ClickedPlace(**click.model_dump()) for click in new.clicks]
        chosen = ChosenModels(
            masks=new.mask_model, tracks=new.track_model, trusts_code=new.trusts_model_code
        )
        job = annotations.start(sequence_id, clicks, overwrite=new.overwrite, chosen=chosen)
        return asdict(job)

    @router.get("/models")
    def list_models() -> dict[str, Any]:
        """List the networks of the data folder that can find masks and tracks."""
        return {"models": [asdict(model) for model in annotations.models()]}

    @router.get("/sequences/{sequence_id}/views/{view_name}/frames/{frame}/mask")
    def show_mask(sequence_id: ItemId, view_name: ItemId, frame: int) -> dict[str, Any]:
        """Give the labels of an image row by row, each with how many pixels have it."""
        return asdict(annotations.painted(sequence_id, view_name, frame))

    @router.post("/sequences/{sequence_id}/correction", status_code=202)
    def correct(sequence_id: ItemId, new: NewCorrection) -> dict[str, Any]:
        """Replace masks, and follow points anew; `annotation` tells how far that is."""
        masks = [PaintedMask(mask.view, mask.frame, tuple(mask.runs)) for mask in new.masks]
        return asdict(annotations.correct(sequence_id, masks, carries_on=new.carry_on))

    @router.get("/sequences/{sequence_id}/annotation")
    def show_annotation(sequence_id: ItemId) -> dict[str, Any]:
        """Tell how far that is."""
        return asdict(annotations.job(sequence_id))

    @router.delete("/sequences/{sequence_id}/annotation", status_code=204)
    def cancel_annotation(sequence_id: ItemId) -> Response:
        annotations.cancel(sequence_id)
        return Response(status_code=204)


def _add_imports(router: APIRouter, imports: Imports) -> None:
    @router.get("/captures")
    def list_captures(folder: CapturePlace = "") -> dict[str, Any]:
        """List the folders and bags that can be imported, below one of them or at the top."""
        return {"folder": folder, "entries": [asdict(one) for one in imports.folders.list(folder)]}

    @router.get("/captures/survey")
    def survey_capture(query: Annotated[SurveyQuery, Query()]) -> dict[str, Any]:
        """Tell what a recording holds, and what is wrong with it or missing."""
        return imports.survey(
            query.source, intrinsics=query.intrinsics, depth_scale=query.depth_scale
        )

    @router.post("/captures/example", status_code=202)
    def make_example() -> dict[str, Any]:
        """Write the example: a raw capture of three made-up cameras."""
        return asdict(imports.make_example())

    @router.get("/captures/example")
    def show_example() -> dict[str, Any]:
        """Tell how far that is."""
        return asdict(imports.example())

    @router.delete("/captures/example", status_code=204)
    def cancel_example() -> Response:
        imports.cancel_example()
        return Response(status_code=204)

    @router.post("/imports", status_code=202)
    def import_capture(new: NewImport, request: Request) -> dict[str, Any]:
        """Make a sequence of a recording; one that was stopped goes on where it was."""
        request.state.made = {"sequence_id": new.name}
        return asdict(imports.start(ImportOrder(**new.model_dump())))

    @router.get("/imports/{sequence_id}")
    def show_import(sequence_id: ItemId) -> dict[str, Any]:
        """Tell how far that is."""
        return asdict(imports.job(sequence_id))

    @router.delete("/imports/{sequence_id}", status_code=204)
    def cancel_import(sequence_id: ItemId) -> Response:
        imports.cancel(sequence_id)
        return Response(status_code=204)


def _add_uploads(router: APIRouter, uploads: Uploads) -> None:
    @router.get("/uploads")
    def list_uploads() -> dict[str, Any]:
        """List what was begun and is not finished."""
        return {"uploads": uploads.unfinished()}

    @router.post("/uploads", status_code=201)
    def begin_upload(new: NewUpload, request: Request) -> dict[str, Any]:
        """Announce a recording, sequence or run by the names and sizes of its files."""
        upload = uploads.begin(new.name, [(file.path, file.size) for file in new.files])
        request.state.made = {"upload_id": upload["id"]}
        return upload

    @router.get("/uploads/{upload_id}")
    def show_upload(upload_id: ItemId) -> dict[str, Any]:
        """Tell how much of it is here, and what became of it."""
        return uploads.describe(upload_id)

    @router.put("/uploads/{upload_id}/files/{number}")
    async def send_piece(
        upload_id: ItemId,
        number: Annotated[int, PathParameter(ge=0, le=MOST_FILES)],
        offset: Annotated[int, Query(ge=0)],
        request: Request,
    ) -> dict[str, Any]:
        """Append a piece of a file, the request's body, where the last one ended."""
        request.state.is_part = True  # Thousands of them would push all else out of the audit log.
        piece = await request.body()
        append = partial(uploads.append, upload_id, number, offset, piece)
        return {"received": await run_in_threadpool(append)}

    @router.post("/uploads/{upload_id}/finish", status_code=202)
    def finish_upload(upload_id: ItemId, wish: UploadName) -> dict[str, Any]:
        """Have a whole upload checked and put in place."""
        return asdict(uploads.finish(upload_id, wish.name))

    @router.post("/uploads/{upload_id}/cancel", status_code=204)
    def cancel_upload(upload_id: ItemId) -> Response:
        """Stop the check of an upload, which stays."""
        uploads.cancel(upload_id)
        return Response(status_code=204)

    @router.delete("/uploads/{upload_id}", status_code=204)
    def remove_upload(upload_id: ItemId) -> Response:
        """Remove what was sent of it."""
        uploads.remove(upload_id)
        return Response(status_code=204)


def _add_results(router: APIRouter, catalog: Catalog) -> None:
    @router.get("/runs/{run_id}/losses")
    def show_losses(run_id: ItemId) -> dict[str, Any]:
        losses, number = loss_curves(catalog.run(run_id))
        return {"losses": losses, "seq": number}

    @router.get("/runs/{run_id}/frame_errors")
    def show_frame_errors(run_id: ItemId) -> dict[str, Any]:
        return {"sequences": read_frame_errors(catalog.run(run_id))}

    @router.get("/runs/{run_id}/log")
    def show_log(run_id: ItemId) -> Response:
        log = open_log(catalog.run_item(run_id).folder)
        headers = {"Content-Disposition": f'attachment; filename="{run_id}_log.txt"'}
        if log is None:
            raise NotFoundError(f"Run '{run_id}' has no log yet.")
        content = iter(lambda: log.read(2**16), b"")
        clean_up = BackgroundTask(log.close)
        return StreamingResponse(
            content, media_type="text/plain; charset=utf-8", headers=headers, background=clean_up
        )

    @router.get("/runs/{run_id}/preview")
    def show_preview(run_id: ItemId) -> Response:
        """Give what a running fit shows of itself: few frames, few points (safetensors)."""
        content = preview_bytes(catalog.run_item(run_id).folder)
        if content is None:
            raise NotFoundError(f"Run '{run_id}' has shown nothing yet.")
        headers = {"Cache-Control": "no-store"}
        return Response(content, media_type="application/octet-stream", headers=headers)


def _add_jobs(
    router: APIRouter, catalog: Catalog, scheduler: Scheduler, tasks: BackgroundTasks
) -> None:
    @router.get("/settings")
    def show_settings(profile: ItemId | None = None, run: ItemId | None = None) -> dict[str, Any]:
        """List all settings of a profile, or of a run beside its profile."""
        return describe_settings(catalog, profile, run)

    @router.post("/runs/check")
    def check(draft: Draft) -> dict[str, Any]:
        """Tell which stages would run, what differs from the profile and how long it takes."""
        return check_order(
            catalog, scheduler.forecast, draft.sequences, draft.profile, draft.overrides
        )

    @router.post("/runs", status_code=201)
    def launch(
        new: NewRun,
        asked: Request,
        response: Response,
        idempotency_key: IdempotencyKey = None,
    ) -> dict[str, Any]:
        """Launch a fit; whoever asks again with the same Idempotency-Key gets the same run."""
        request = None
        who = asked.state.owner
        if idempotency_key is not None:
            # As of scripts that were written before there were priorities.
            words = new.model_dump(mode="json", exclude={"priority"})
            if new.priority != "normal":
                words |= {"priority": new.priority}
            request = KeyedRequest.of(idempotency_key, words)
            launched = scheduler.launched_by(request, new.priority, who)
            if launched is not None:
                response.headers["Idempotency-Replayed"] = "true"
                return describe_run(catalog.run_item(launched.id), scheduler)
        tasks.require_settled(new.sequences)
        run = scheduler.launch(
            new.sequences,
            new.profile,
            new.name,
            overrides=new.overrides,
            parent=new.parent,
            accepts_missing=new.accepts_missing,
            request=request,
            priority=new.priority,
            who=who,
        )
        asked.state.made = {"run_id": run.id}
        return describe_run(catalog.run_item(run.id), scheduler)

    @router.patch("/runs/{run_id}")
    def change(run_id: ItemId, changes: RunChanges) -> dict[str, Any]:
        """Change what a run is called, its tags or its note; what is left out stays."""
        change_about(catalog, run_id, changes)
        return describe_run(catalog.run_item(run_id), scheduler)

    @router.delete("/runs/{run_id}", status_code=204)
    def delete(run_id: ItemId) -> Response:
        scheduler.delete(run_id)
        return Response(status_code=204)


def _add_line(
    router: APIRouter, catalog: Catalog, scheduler: Scheduler, tasks: BackgroundTasks
) -> None:
    @router.post("/runs/{run_id}/cancel")
    def cancel(run_id: ItemId) -> dict[str, Any]:
        scheduler.cancel(run_id)
        return describe_run(catalog.run_item(run_id), scheduler)

    @router.post("/runs/{run_id}/priority")
    def set_priority(run_id: ItemId, new: NewPriority) -> dict[str, Any]:
        """Change how urgent a fit in line is."""
        scheduler.set_priority(run_id, new.priority)
        return describe_run(catalog.run_item(run_id), scheduler)

    @router.post("/runs/{run_id}/resume")
    def resume(
        run_id: ItemId,
        asked: Request,
        response: Response,
        again: Again | None = None,
        idempotency_key: IdempotencyKey = None,
    ) -> dict[str, Any]:
        """Start a failed or cancelled fit once more; one that waits or is at work stays as it is.

        Whoever asks again with the same Idempotency-Key, however late, starts nothing.
        """
        again = again or Again()
        tasks.require_settled(Path(path).name for path in catalog.run(run_id).sequences)
        request = None
        if idempotency_key is not None:
            words = {"resume": run_id} | again.model_dump(mode="json")
            request = KeyedRequest.of(idempotency_key, words)
        is_replayed = scheduler.resume(
            run_id,
            afresh=again.afresh,
            request=request,
            priority=again.priority,
            who=asked.state.owner,
        )
        if is_replayed:
            response.headers["Idempotency-Replayed"] = "true"
        return describe_run(catalog.run_item(run_id), scheduler)


def _add_sessions(router: APIRouter, sessions: Sessions) -> None:
    @router.post("/sessions", status_code=201)
    def open_session(new: NewScene, request: Request) -> dict[str, str]:
        target = new.query if isinstance(new, NewComparison) else new.id
        may_keep = request.state.may_change
        session_id = sessions.open(new.kind, target, request.state.owner, may_keep=may_keep)
        return {"id": session_id, "url": address_on(request, f"/live/{session_id}")}

    def find(session_id: str, request: Request) -> AnySession:
        scene = sessions.find(session_id, request.state.owner)
        if scene is None:
            raise HTTPException(404, "This live scene was closed, or it is not yours.")
        return scene

    @router.get("/sessions/{session_id}")
    def show_session(session_id: ItemId, request: Request) -> dict[str, str]:
        find(session_id, request)
        return {"id": session_id, "url": address_on(request, f"/live/{session_id}")}

    @router.patch("/sessions/{session_id}", status_code=204)
    def change_session(session_id: ItemId, wishes: SessionWishes, request: Request) -> Response:
        scene = find(session_id, request)
        if wishes.dark is not None:
            scene.prefer_dark(on=wishes.dark)
        if wishes.frame is not None:
            scene.go(wishes.frame)
        return Response(status_code=204)

    @router.delete("/sessions/{session_id}", status_code=204)
    def close_session(session_id: ItemId, request: Request) -> Response:
        # Who asks again, because the answer was lost, is told the same.
        if sessions.closed_session(session_id, request.state.owner) is None:
            find(session_id, request)
            sessions.close(session_id)
        return Response(status_code=204)


def _add_streams(
    router: APIRouter,
    catalog: Catalog,
    scheduler: Scheduler,
    feed: Feed,
    machine: Machine,
) -> None:
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
        run_id: ItemId,
        since: Annotated[str | None, Query(max_length=64)] = None,
        last_event_id: Annotated[str | None, Header(max_length=64)] = None,
    ) -> StreamingResponse:
        item = await asyncio.to_thread(catalog.run_item, run_id)
        watch = Watch(
            item.folder,
            lambda: follow_run(catalog.run_item(run_id), scheduler),  # Its name may change.
            last_event_id or since,
            lambda: {"machine": machine.load(), "run": machine.of_run(item.folder)},
        )
        return streams.answer(request, watch.news)


def _add_recovery(router: APIRouter, scheduler: Scheduler, recovery: Recovery) -> None:
    def answer(moved: MovedFolder) -> dict[str, str]:
        return asdict(moved) | {"moved_to": f"damaged/{moved.kind}/{moved.name}"}

    @router.get("/recovery")
    def show_recovery() -> dict[str, Any]:
        """Tell what was damaged or left behind in the data folder, and what was done about it."""
        return recovery.describe()

    @router.post("/runs/{run_id}/aside")
    def set_run_aside(run_id: ItemId) -> dict[str, str]:
        """Move a damaged run to `damaged/runs` of the data folder; nothing is deleted."""
        return answer(scheduler.set_aside(run_id))

    @router.post("/sequences/{sequence_id}/aside")
    def set_sequence_aside(sequence_id: ItemId) -> dict[str, str]:
        """Move a sequence that cannot be read to `damaged/sequences`; nothing is deleted."""
        return answer(recovery.set_sequence_aside(sequence_id))


def _add_retention(router: APIRouter, retention: Retention) -> None:
    @router.get("/retention")
    def show_retention() -> dict[str, Any]:
        """Tell what may go by the settings of the server; nothing is changed."""
        return retention.describe()

    @router.post("/retention")
    def remove_expendable() -> dict[str, Any]:
        """Remove what may go now, as the server does by itself every hour."""
        gone = retention.remove()
        total = sum(item.bytes for item in gone)
        return {"removed": [asdict(item) for item in gone], "bytes": total}


def _add_system(router: APIRouter, overview: Overview) -> None:
    streams = Streams()

    @router.get("/system")
    def show_system() -> dict[str, Any]:
        return overview.whole()

    @router.get("/system/events")
    async def watch_system(request: Request) -> StreamingResponse:
        latest: dict[str, Any] = {}
        looked = 0.0

        def news() -> Iterable[News]:
            nonlocal latest, looked
            if time.monotonic() - looked < _INTERVAL_S:
                return
            looked = time.monotonic()
            state = overview.moving()
            if state != latest:
                latest = state
                yield "0", "system", state

        return streams.answer(request, news)
