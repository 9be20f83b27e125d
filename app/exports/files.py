"""Files of runs and of live scenes, over HTTP."""

import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import FileResponse, Response
from pydantic import BaseModel
from starlette.background import BackgroundTask
from starlette.exceptions import HTTPException

from app.exports.cache import FileCache, FileJob
from app.exports.links import CLOSED, address, read_query
from app.exports.making import store_rollout
from app.exports.permalink import state_from_query, state_to_query
from app.exports.request import LARGEST, LARGEST_TURN, SMALLEST, Beside, FileRequest, Format
from app.exports.schema import MEDIA_TYPES, SlowFormat, errors, files
from app.ids import ItemId
from app.jobs.catalog import Catalog
from app.root_path import address_on
from app.viewer.export.snapshot import snapshot_yaml
from app.viewer.session import Session
from app.viewer.sessions import Sessions
from physhandi.data.exporters import PLY, export_run
from physhandi.data.layout import SequenceFiles
from physhandi.errors import PhysHandiError, RunError, UsageError, describe
from physhandi.run import Run

_OWN_FIELDS = ("format", "width", "height", "turn", "camera_path", "view", "beside", "download")
_STORED = ("npz", "csv", "yaml")
"""Formats of what a run holds, which is written sooner than a process is started."""
PictureSide = Annotated[
    int, Query(ge=SMALLEST, le=LARGEST, description="Of PNG, ZIP and films [px].")
]
Turn = Annotated[
    float,
    Query(
        ge=-LARGEST_TURN,
        le=LARGEST_TURN,
        allow_inf_nan=False,
        description="Angle by which the camera of a film goes round [degrees].",
    ),
]
CameraPathField = Annotated[
    str,
    Query(max_length=50_000, description="Of films: the JSON of a camera path (docs/formats.md)."),
]
FilmedFrom = Annotated[
    str, Query(max_length=200, description="Of films: camera of the recording that takes it.")
]
_BESIDE = (
    "Of films from a recorded camera, by default the one that the link looks from or the first: "
    "what is beside it, nothing, the recording, or that and how much both differ."
)
LinkField = Annotated[
    str | None,
    Query(max_length=600, description="As in a link of the viewer; see the page's “Copy link”."),
]


@dataclass(frozen=True)
class PictureOptions:
    """Size of a picture or film, and how its camera moves: fields of the query."""

    width: PictureSide = 1280
    """Columns [px]."""
    height: PictureSide = 720
    """Rows [px]."""
    turn: Turn = 0.0
    """Angle by which the camera goes round [degrees]."""
    camera_path: CameraPathField = ""
    """Camera path of a film; docs/formats.md describes the JSON."""
    view: FilmedFrom = ""
    """Camera of the recording from which a film is taken."""
    beside: Annotated[Beside | None, Query(description=_BESIDE)] = None
    """Picture beside such a film."""


class FileProgress(BaseModel):
    """Progress of a file that is being made."""

    state: Literal["making", "ready", "failed"]
    """Whether it is being made, is there, or could not be made."""
    done: int
    """Frames that are finished."""
    of: int
    """Frames that there are; 0 before that is known."""
    url: str
    """The file."""
    bytes: int = 0
    """Its size, when it is ready."""
    message: str = ""
    """Why it could not be made."""


def describe_progress(work: FileJob, url: str) -> FileProgress:
    """Tell how far a file is.

    Args:
        work: What makes it.
        url: Where it is fetched.
    """
    size, message = 0, ""
    if work.state == "ready":
        size = work.path.stat().st_size
    elif work.state == "failed" and (error := work.future.exception()) is not None:
        message = describe(error)
    return FileProgress(
        state=work.state, done=work.done, of=work.of, url=url, bytes=size, message=message
    )


def create_files(catalog: Catalog, sessions: Sessions, file_cache: FileCache) -> APIRouter:
    """Make the routes.

    Args:
        catalog: Finds runs and sequences.
        sessions: The live scenes.
        file_cache: Makes files.
    """
    router = APIRouter(prefix="/api/v1")

    @router.get(
        "/runs/{run_id}/export",
        response_class=FileResponse,
        responses=files() | errors(404, 409, 422, 429),
    )
    def export(
        *,
        request: Request,
        run_id: ItemId,
        kind: Annotated[Format, Query(alias="format")],
        sequence: Annotated[str | None, Query(max_length=200)] = None,
        f: Annotated[int | None, Query(ge=0, description="Frame of PNG, ZIP and PLY.")] = None,
        picture: Annotated[PictureOptions, Depends()],
        cam: LinkField = None,
        fov: LinkField = None,
        show: LinkField = None,
        color: LinkField = None,
        scale: LinkField = None,
        theme: LinkField = None,
    ) -> FileResponse:
        """Write a run as a file that other programs read.

        `ply`, `gltf`, `usd`, `npz`, `csv`: motion; `mjcf`, `newton`: the object as a scene of
        MuJoCo or a model of Newton; `rrd`: a recording for Rerun; `yaml`: parameters
        and metrics; `splat-ply`: what the object looks like, for viewers of Gaussian splats;
        `png`: a picture; `mp4`, `gif`: a film of all frames; `zip`: a picture with all
        its data; `viser`, `html`: a recording that plays without the server. All fields of a link
        are understood. A parameter of the simulation by its name, such as `drag=4`, has the object
        simulated anew before it is written.
        """
        del sequence, cam, fov, show, color, scale, theme  # Read with the rest of the link.
        run, query = catalog.run(run_id), read_query(request, without=_OWN_FIELDS)
        order = request_of(catalog, run, kind, query)
        frame = f if kind in PLY else None
        order = replace(order, frame=frame, **asdict(picture))
        if kind in _STORED and not state_from_query(query).is_changed:
            return _answer_stored(run, order)
        return _answer(file_cache.make(order), run_id, order)

    @router.post("/runs/{run_id}/export", responses=errors(404, 409, 422, 429))
    def prepare(
        *,
        request: Request,
        run_id: ItemId,
        kind: Annotated[SlowFormat, Query(alias="format")],
        picture: Annotated[PictureOptions, Depends()],
    ) -> FileProgress:
        """Have a file made that takes a while, unless it is there, and tell how far it is.

        All fields of a link are understood, as where the file is fetched.
        """
        query = read_query(request, without=_OWN_FIELDS)
        order = request_of(catalog, catalog.run(run_id), kind, query)
        work = file_cache.begin(replace(order, **asdict(picture)))
        return describe_progress(
            work, address_on(request, f"/api/v1/runs/{run_id}/export?{request.url.query}")
        )

    @router.get(
        "/sessions/{session_id}/export",
        response_class=FileResponse,
        responses=files() | errors(404, 409, 422, 429),
    )
    def export_scene(
        *,
        request: Request,
        session_id: ItemId,
        kind: Annotated[Format, Query(alias="format")],
        picture: Annotated[PictureOptions, Depends()],
    ) -> Response:
        """Write what a live scene shows: the rollout that its sliders asked for, as it looks."""
        session = sessions.find(session_id, request.state.owner)
        if not isinstance(session, Session):
            raise HTTPException(404, CLOSED)
        snapshot, state = session.snapshot(), session.state
        if kind == "yaml":
            return _attached(snapshot_yaml(snapshot), f"{session.target}.yaml", kind)
        query = state_to_query(state)
        if "theme" not in query and state.prefers_dark:
            query["theme"] = "dark"
        order = _order_of_scene(catalog, session, kind, query)
        order = replace(order, link=snapshot.link, **asdict(picture))
        rollout = snapshot.rollout
        if rollout is None:
            return _answer(file_cache.make(order), session.target, order)
        with file_cache.once(order, lambda folder: store_rollout(folder, rollout)) as path:
            return _attached(path.read_bytes(), _name(session.target, order), kind)

    return router


def request_of(
    catalog: Catalog,
    run: Run,
    format: Format,  # noqa: A002
    query: Mapping[str, str],
) -> FileRequest:
    """Describe a file of a run.

    Args:
        catalog: Finds recordings that have moved.
        run: The run.
        format: Which kind of file.
        query: What a link would say of it.

    Raises:
        RunError: If the run is not finished.
        UsageError: If it has no such sequence or frame; names the field.
    """
    if not run.is_published:
        raise RunError(f"Run '{run.id}' is {run.state}: there is nothing to export yet.")
    _check_frame(run, query)
    recordings: dict[str, str] = {}
    for name in run.sequence_names:
        try:
            recordings[name] = str(catalog.sequence_item(name).folder)
        except PhysHandiError:
            continue  # A run can be looked at without its recording.
    return FileRequest(
        kind="run",
        folder=str(run.folder),
        format=format,
        query=query,
        recordings=recordings,
        link=address("run", run.id, query),
    )


def _order_of_scene(
    catalog: Catalog,
    session: Session,
    format: Format,  # noqa: A002
    query: Mapping[str, str],
) -> FileRequest:
    if session.kind == "run":
        return request_of(catalog, catalog.run(session.target), format, query)
    folder = catalog.sequence_item(session.target).folder
    return FileRequest(kind="sequence", folder=str(folder), format=format, query=query)


def _check_frame(run: Run, query: Mapping[str, str]) -> None:
    """Say at once, not after a process was started, that there is no such frame."""
    name = query.get("sequence") or run.sequence_names[0]
    if name not in run.sequence_names:
        names = ", ".join(run.sequence_names)
        raise UsageError(f"sequence: run '{run.id}' has no sequence '{name[:80]}', but {names}.")
    count = run.recording(name)["frame_count"] if run.has(SequenceFiles(name).meta) else 0
    frame = state_from_query(query).frame
    if count and frame >= count:
        raise UsageError(f"f: '{name}' has frames 0 to {count - 1}, not {frame}.")


def _name(target: str, order: FileRequest) -> str:
    has_frame = order.frame is not None or order.format in {"png", "zip"}
    frame = f"_{int(order.query.get('f', '0')):05d}" if has_frame else ""
    kind = f"_{order.format}" if order.suffix == "zip" != order.format else ""
    return f"{target}{frame}{kind}.{order.suffix}"


def _answer(
    path: Path, target: str, order: FileRequest, clean_up: BackgroundTask | None = None
) -> FileResponse:
    media = "application/octet-stream" if order.suffix == "ply" else MEDIA_TYPES[order.format]
    return FileResponse(path, filename=_name(target, order), media_type=media, background=clean_up)


def _attached(content: bytes, name: str, kind: str) -> Response:
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(content, media_type=MEDIA_TYPES[kind], headers=headers)


def _answer_stored(run: Run, order: FileRequest) -> FileResponse:
    """Write what a run holds; the file is gone once it was sent."""
    run.verify(allows_more=True)
    folder = Path(tempfile.mkdtemp(prefix="physhandi-export-"))
    try:
        path = folder / f"file.{order.suffix}"
        export_run(run, order.format, path, sequence=order.query.get("sequence"))
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return _answer(path, run.id, order, BackgroundTask(shutil.rmtree, folder, ignore_errors=True))
