"""Replays: recordings that play in the browser without a live session."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import FileResponse, HTMLResponse

from app.exports.cache import FileCache
from app.exports.files import FileProgress, describe_progress, request_of
from app.exports.links import read_query
from app.exports.permalink import state_from_query
from app.exports.request import FileRequest
from app.exports.schema import errors, files
from app.ids import ItemId
from app.jobs.catalog import Catalog
from app.pages.render import Pages
from app.root_path import address_on
from app.viewer.ui.scene_frame import packed_scene_page, scene_page
from physhandi.errors import UsageError

_CAMERA = ("cam", "up", "fov")
_KNOWN = ("sequence", "theme", *_CAMERA)
SequenceField = Annotated[str | None, Query(max_length=200)]
ThemeField = Annotated[Literal["light", "dark"], Query()]


def create_replays(catalog: Catalog, file_cache: FileCache, pages: Pages) -> APIRouter:
    """Make the routes.

    ``/viewer/replay/`` is viser's page, which plays the file that its query names. It holds no data
    and opens no connection but the one for that file.

    Args:
        catalog: Finds runs.
        file_cache: Makes the files.
        pages: Renders.
    """
    router = APIRouter()
    client = scene_page()
    packed = packed_scene_page()

    def order(run_id: str, sequence: str | None, theme: str) -> FileRequest:
        query = {"sequence": sequence} if sequence else {}
        return request_of(catalog, catalog.run(run_id), "viser", query | {"theme": theme})

    @router.get("/runs/{run_id}/replay", include_in_schema=False)
    def show_page(run_id: ItemId, request: Request) -> HTMLResponse:
        query = read_query(request)
        unknown = [name for name in query if name not in _KNOWN]
        if unknown:
            raise UsageError(
                f"{unknown[0][:40]}: a replay has no such field. It has: {', '.join(_KNOWN)}."
            )
        camera = _camera(query)
        item = catalog.run_item(run_id)
        run = catalog.run(run_id)
        sequence = query.get("sequence") or run.sequence_names[0]
        if sequence not in run.sequence_names:
            raise UsageError(f"sequence: run '{run_id}' has no sequence '{sequence[:80]}'.")
        return pages.render(
            request,
            "replay.html",
            run_id=item.id,
            title=run.name,
            sequence=sequence,
            sequences=run.sequence_names,
            camera=urlencode(camera),
            theme=query.get("theme", ""),
        )

    @router.post("/api/v1/runs/{run_id}/replay", responses=errors(404, 409, 422, 429))
    def prepare(
        request: Request,
        run_id: ItemId,
        sequence: SequenceField = None,
        theme: ThemeField = "light",
    ) -> FileProgress:
        """Have the replay of a run made, unless it is there, and tell how far it is."""
        work = file_cache.begin(order(run_id, sequence, theme))
        query = {"theme": theme} | ({"sequence": sequence} if sequence else {})
        return describe_progress(
            work, address_on(request, f"/api/v1/runs/{run_id}/replay.viser?{urlencode(query)}")
        )

    @router.get(
        "/api/v1/runs/{run_id}/replay.viser",
        response_class=FileResponse,
        responses=files("viser") | errors(404, 409, 422, 429),
    )
    def fetch(
        run_id: ItemId, sequence: SequenceField = None, theme: ThemeField = "light"
    ) -> FileResponse:
        """Give the replay of a run as viser's recording; made when it is missing."""
        path = file_cache.make(order(run_id, sequence, theme))
        headers = {"Cache-Control": "private, no-cache"}
        return FileResponse(path, media_type="application/octet-stream", headers=headers)

    @router.get("/viewer/replay/", include_in_schema=False)
    def show_client(request: Request) -> Response:
        is_packed = "gzip" in request.headers.get("accept-encoding", "")
        headers = {"Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
        if is_packed:
            headers["Content-Encoding"] = "gzip"
        content = packed if is_packed else client
        return Response(content, media_type="text/html", headers=headers)

    return router


def _camera(query: Mapping[str, str]) -> dict[str, Any]:
    """Write the camera of a link as viser's page reads it."""
    pose = state_from_query({n: text for n, text in query.items() if n != "sequence"}).pose
    if pose is None:
        return {}

    def numbers(values: Any) -> str:
        return ",".join(f"{float(value):.6g}" for value in values)

    return {
        "initialCameraPosition": numbers(pose.position),
        "initialCameraLookAt": numbers(pose.look_at),
        "initialCameraUp": numbers(pose.up),
        "initialCameraFov": f"{pose.fov:.6g}",
    }
