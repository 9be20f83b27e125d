"""The pages: lists, one run, several runs compared, one live scene."""

from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse
from starlette.exceptions import HTTPException

from app.ids import ItemId
from app.jobs.catalog import Catalog, RunItem
from app.jobs.log import read_log
from app.jobs.order import describe_settings, order_of
from app.jobs.overview import Overview
from app.jobs.recordings.imports import Imports
from app.jobs.recordings.models import ModelFolders
from app.jobs.recovery.recovery import Recovery
from app.jobs.scheduler import ENDED, Scheduler
from app.jobs.storage.retention import Retention
from app.jobs.views import describe_results, describe_run, describe_sequence, follow_run
from app.jobs.watch import Feed
from app.pages.browse import add_lists
from app.pages.checks import add_checks
from app.pages.diff import LEAST_RUNS, MOST_RUNS, compare_runs
from app.pages.imports import add_imports
from app.pages.metrics import METHOD_TEXTS, tabulate
from app.pages.parameters import parameter_rows
from app.pages.pictures import add_pictures
from app.pages.render import Pages
from app.pages.suites import add_suites
from app.previews.store import Previews
from app.viewer.sessions import Sessions
from physhandi.data.sequence import Sequence
from physhandi.errors import UsageError
from physhandi.fitting.config import named_profile, profile_names
from physhandi.run import warnings_in

_THUMBNAIL_WIDTH = 640


def create_pages(
    catalog: Catalog,
    scheduler: Scheduler,
    feed: Feed,
    sessions: Sessions,
    pages: Pages,
    *,
    overview: Overview,
    previews: Previews,
    imports: Imports,
    models: ModelFolders,
    recovery: Recovery,
    retention: Retention,
    suites: Path,
) -> APIRouter:
    """Make the routes of the pages.

    Args:
        catalog: Finds sequences and runs.
        scheduler: Tells how far runs are.
        feed: Names the state that a page shows.
        sessions: Finds live scenes.
        pages: Renders.
        overview: Describes machine, queue and program.
        previews: Keeps small pictures.
        imports: Finds recordings.
        models: Finds networks of the user.
        recovery: Knows what is damaged.
        retention: Knows what may go.
        suites: Folder of suites.
    """
    router = APIRouter(include_in_schema=False)
    add_lists(router, catalog, feed, pages, previews=previews)
    add_pictures(router, previews)
    add_checks(router, catalog, models, pages)
    add_imports(router, catalog, imports, pages)
    add_suites(router, suites, pages)
    _add_launch(router, catalog, overview, pages)
    _add_recovery(router, recovery, retention, pages)

    @router.get("/runs/{run_id}")
    def run(request: Request, run_id: ItemId) -> HTMLResponse:
        item = catalog.run_item(run_id)
        described = follow_run(item, scheduler)
        log = read_log(item.folder, is_ended=described["state"] in ENDED)
        values = run_values(item, described, catalog)
        return pages.render(request, "run.html", log=log, is_listed=item.run is not None, **values)

    @router.get("/runs/{run_id}/parts")
    def parts(request: Request, run_id: ItemId) -> HTMLResponse:
        """Give the parts of a run's page that change when a stage or the run ends."""
        item = catalog.run_item(run_id)
        return pages.render(
            request, "parts.html", **run_values(item, follow_run(item, scheduler), catalog)
        )

    @router.get("/diff")
    def diff(
        request: Request,
        run: Annotated[list[ItemId], Query(max_length=20)] = [],  # noqa: B006  # FastAPI copies it
        show: Literal["differences", "all"] = "differences",
    ) -> HTMLResponse:
        ids = list(dict.fromkeys(run))
        if not LEAST_RUNS <= len(ids) <= MOST_RUNS:
            raise UsageError(
                f"Choose {LEAST_RUNS} to {MOST_RUNS} runs in the list of runs to compare them; "
                f"this address names {len(ids)}."
            )
        items = [catalog.run_item(run_id) for run_id in ids]
        described = [describe_run(item, scheduler) for item in items]
        sections = compare_runs(
            described,
            [item.run.config if item.run else {} for item in items],
            [describe_results(item.run) if item.run else {} for item in items],
        )
        return pages.render(
            request,
            "diff.html",
            runs=[entry | {"picture": previews.look("run", entry["id"])} for entry in described],
            sections=sections,
            shows_all=show == "all",
            least=LEAST_RUNS,
        )

    @router.get("/live/{session_id}")
    def live(session_id: ItemId, request: Request) -> HTMLResponse:
        scene = sessions.find(session_id, request.state.owner)
        if scene is not None:
            return pages.render(request, "live.html", session=session_id, scene=scene.info)
        closed = sessions.closed_session(session_id, request.state.owner)
        if closed is not None:
            query = request.url.query
            return pages.render(request, "closed.html", status=404, scene=closed, query=query)
        return pages.error(
            request,
            404,
            "This live scene was closed, or it belongs to another browser. "
            "Open your own from the home page.",
        )

    @router.get("/sequences/{sequence_id}/thumbnail")
    def thumbnail(sequence_id: ItemId) -> Response:
        item = catalog.sequence_item(sequence_id)
        image = _thumbnail(item.folder, (item.folder / "sequence.yaml").stat().st_mtime_ns)
        if image is None:
            raise HTTPException(404, "This sequence has no colour video.")
        headers = {"Cache-Control": "private, max-age=600"}
        return Response(image, media_type="image/jpeg", headers=headers)

    return router


def _add_recovery(
    router: APIRouter, recovery: Recovery, retention: Retention, pages: Pages
) -> None:
    @router.get("/recovery")
    def show_recovery(request: Request) -> HTMLResponse:
        report, going = recovery.describe(), retention.describe()
        return pages.render(request, "recovery.html", report=report, going=going)


def _add_launch(router: APIRouter, catalog: Catalog, overview: Overview, pages: Pages) -> None:
    @router.get("/system")
    def system(request: Request) -> HTMLResponse:
        return pages.render(request, "system.html", system=overview.whole())

    @router.get("/launch")
    def launch(
        request: Request,
        run: Annotated[ItemId | None, Query()] = None,
        profile: Annotated[ItemId | None, Query()] = None,
        sequence: Annotated[ItemId | None, Query()] = None,
    ) -> HTMLResponse:
        values = _launch_values(catalog, run, profile, sequence)
        return pages.render(request, "launch.html", **values)


def run_values(item: RunItem, described: dict[str, Any], catalog: Catalog) -> dict[str, Any]:
    """Collect what the page of a run shows of its state and its results.

    Args:
        item: The run.
        described: `follow_run` of it.
        catalog: Knows the run that it was made from.
    """
    results = describe_results(item.run) if item.run else {}
    final = results.get("parameters", {})
    return {
        "run": described,
        "order": order_of(item, catalog),
        "warnings": warnings_in(results.get("metrics", {})),
        "metrics": {name: tabulate(v) for name, v in results.get("metrics", {}).items()},
        "parameters": parameter_rows(item.run, final) if item.run else [],
        "environment": results.get("environment", {}),
        "problem": results.get("problem", {}).get("message"),
        "methods": METHOD_TEXTS,
    }


def _launch_values(
    catalog: Catalog, run_id: str | None, profile: str | None, sequence: str | None
) -> dict[str, Any]:
    """Collect what the page shows on which every setting of a fit can be chosen."""
    offered = describe_settings(catalog, profile, run_id)
    sequences = [entry for s in catalog.sequences() if not (entry := describe_sequence(s))["error"]]
    item = catalog.run_item(run_id) if run_id else None
    chosen: set[str | None] = {sequence}
    missing: list[str] = []
    if item is not None and item.run is not None:
        folders = {str(s.folder): s.id for s in catalog.sequences()}
        names = {entry["name"]: entry["id"] for entry in sequences}
        for folder, name in zip(item.run.sequences, item.run.sequence_names, strict=True):
            sequence_id = folders.get(folder, names.get(name))
            if sequence_id is None:
                missing.append(name)
            chosen.add(sequence_id)
    groups: dict[str, list[dict[str, Any]]] = {}
    for setting in offered["settings"]:
        groups.setdefault(setting["group_name"], []).append(setting)
    return {
        "parent": item and {"id": item.id, "name": item.run.name if item.run else item.id},
        "profile": offered["profile"],
        "description": offered["description"],
        "profiles": [(name, named_profile(name).description) for name in profile_names()],
        "groups": groups,
        "sequences": sequences,
        "chosen": chosen,
        "missing": missing,
    }


@lru_cache(maxsize=256)
def _thumbnail(folder: Path, _stamp: int) -> bytes | None:
    sequence = Sequence.load(folder)
    for view in sequence.views:
        if view.has_color:
            image = view.color(min(sequence.frame_count - 1, sequence.frame_count // 2))
            view.close()
            height = round(image.shape[0] * _THUMBNAIL_WIDTH / image.shape[1])
            size = (_THUMBNAIL_WIDTH, height)
            small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            done, content = cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])
            return content.tobytes() if done else None
    return None
