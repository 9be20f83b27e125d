"""The pages: home, one run, one live scene."""

import os
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Protocol

import cv2
from fastapi import APIRouter, Response
from fastapi.responses import HTMLResponse
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
from pydantic import Field
from starlette.exceptions import HTTPException

from app.jobs.catalog import Catalog
from app.jobs.describe import describe_results, describe_run, describe_sequence
from app.jobs.feed import Feed
from app.jobs.scheduler import AT_WORK, ENDED, Scheduler
from app.settings import WEB_ASSETS
from physhandi.data.atomic import named_fields
from physhandi.data.sequence import Sequence
from physhandi.fitting.profile import load_profile, profile_names
from physhandi.pipeline import SIMULATION, STAGES

Id = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
_LOG_BYTES = 20_000
_RUNS_SHOWN = 50
_THUMBNAIL_WIDTH = 640
_TITLES = {
    400: "The server cannot answer this",
    404: "Nothing is here",
    409: "That does not work now",
    422: "That is not possible",
    429: "Too much at once",
    500: "Something went wrong",
}


class ShownScene(Protocol):
    """What a page says about a live scene."""

    @property
    def kind(self) -> str:
        """``run`` or ``sequence``."""
        ...

    @property
    def target(self) -> str:
        """Id of the run or the sequence."""
        ...

    @property
    def title(self) -> str:
        """Its name."""
        ...


class Scene(Protocol):
    """A live scene of the viewer."""

    @property
    def info(self) -> ShownScene:
        """What is to be said about it."""
        ...


class Scenes(Protocol):
    """The part of the live viewer that the pages need."""

    def get(self, session_id: str) -> Scene | None:
        """Find a live scene."""
        ...


class Pages:
    """Renders templates; everything a user wrote is escaped."""

    def __init__(self) -> None:
        environment: Any = Environment(
            loader=FileSystemLoader(WEB_ASSETS / "templates"),
            autoescape=select_autoescape(default=True),
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        environment.filters.update(short=short, words=words, duration=duration)
        self._environment: Environment = environment

    def render(self, name: str, *, status: int = 200, **values: Any) -> HTMLResponse:
        """Fill a template."""
        return HTMLResponse(self._environment.get_template(name).render(values), status_code=status)

    def error(self, status: int, message: str) -> HTMLResponse:
        """Show an error in the frame of the application."""
        title = _TITLES.get(status, "That did not work")
        return self.render("error.html", status=status, code=status, title=title, message=message)


def create_pages(
    catalog: Catalog, scheduler: Scheduler, feed: Feed, scenes: Scenes, pages: Pages
) -> APIRouter:
    """Make the routes of the pages.

    Args:
        catalog: Finds sequences and runs.
        scheduler: Tells how far runs are.
        feed: Names the state that a page shows.
        scenes: Finds live scenes.
        pages: Renders.
    """
    router = APIRouter(include_in_schema=False)

    @router.get("/")
    def home(*, all: bool = False) -> HTMLResponse:  # noqa: A002  # the query's name
        cursor = feed.cursor()
        runs = [describe_run(item, scheduler) for item in catalog.runs()]
        sequences = [describe_sequence(item) for item in catalog.sequences()]
        return pages.render(
            "home.html",
            cursor=cursor,
            sequences=sequences,
            runs=runs
            if all
            else runs[:_RUNS_SHOWN] + [r for r in runs[_RUNS_SHOWN:] if _is_kept(r)],
            address="/?all=true" if all else "/",
            hidden_count=0 if all else sum(not _is_kept(r) for r in runs[_RUNS_SHOWN:]),
            featured=_featured(runs),
            profiles=[(name, load_profile(name).description) for name in ordered_profiles()],
        )

    @router.get("/runs/{run_id}")
    def run(run_id: Id) -> HTMLResponse:
        cursor = feed.cursor()
        item = catalog.run_item(run_id)
        described = describe_run(item, scheduler)
        results = describe_results(item.run) if item.run else {}
        return pages.render(
            "run.html",
            cursor=cursor,
            run=described,
            stages=stage_states(described, results.get("losses", {})),
            metrics={name: tabulate(v) for name, v in results.get("metrics", {}).items()},
            parameters=flat(results.get("parameters", {})),
            log=log_tail(item.folder / "log.txt"),
        )

    @router.get("/live/{session_id}")
    def live(session_id: Id) -> HTMLResponse:
        scene = scenes.get(session_id)
        if scene is None:
            return pages.error(404, "This live scene was closed. Open it again from the home page.")
        return pages.render("live.html", session=session_id, scene=scene.info)

    @router.get("/sequences/{sequence_id}/thumbnail")
    def thumbnail(sequence_id: Id) -> Response:
        item = catalog.sequence_item(sequence_id)
        image = _thumbnail(item.folder, (item.folder / "sequence.yaml").stat().st_mtime_ns)
        if image is None:
            raise HTTPException(404, "This sequence has no colour video.")
        headers = {"Cache-Control": "private, max-age=600"}
        return Response(image, media_type="image/jpeg", headers=headers)

    return router


def ordered_profiles() -> list[str]:
    """Give the profiles, the quickest first."""
    return sorted(profile_names(), key=lambda name: (name != "quick", name != "default", name))


def stage_states(run: Mapping[str, Any], finished: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Tell for each stage of a run whether it is done, at work or still to come."""
    names = [SIMULATION] if run["kind"] == "simulation" else list(STAGES)
    names += [name for name in finished if name not in names]
    at_work = run["progress"].get("stage") if run["state"] in AT_WORK else None
    stages: list[dict[str, Any]] = []
    for name in names:
        summary = named_fields(finished.get(name)) or {}
        state = "done" if name in finished else "at-work" if name == at_work else "to-come"
        if state == "to-come" and run["state"] == "succeeded":
            continue  # The sequence had no part for this stage.
        stages.append(
            {
                "name": name,
                "state": state,
                "before": summary.get("before"),
                "after": summary.get("after"),
            }
        )
    return stages


def tabulate(scores: Any) -> dict[str, Any]:
    """Arrange the scores of a sequence: what has rivals side by side, the rest as notes.

    A part whose entries score the same quantities, such as the rollout beside its baselines,
    becomes a table with one column each; all scores are errors, so the lowest is the best.
    """
    tables: list[dict[str, Any]] = []
    notes: list[tuple[str, Any]] = []
    for name, part in (named_fields(scores) or {}).items():
        fields = named_fields(part) or {}
        columns = {key: inner for key, v in fields.items() if (inner := named_fields(v))}
        if len(columns) < 2:
            notes += flat(part, words(name))
            continue
        rows: list[dict[str, Any]] = []
        for quantity in dict.fromkeys(key for column in columns.values() for key in column):
            values = [column.get(quantity) for column in columns.values()]
            known = [value for value in values if isinstance(value, int | float)]
            if known:
                rows.append({"name": quantity, "values": values, "best": min(known)})
        rest = [flat(v, words(key)) for key, v in fields.items() if key not in columns]
        note = ", ".join(f"{key} {short(v)}" for pairs in rest for key, v in pairs)
        tables.append({"name": name, "note": note, "columns": list(columns), "rows": rows})
    return {"tables": tables, "notes": notes}


def flat(value: Any, path: str = "") -> list[tuple[str, Any]]:
    """Lay nested results out as rows of a dotted name and a value."""
    fields = named_fields(value)
    if fields is None:
        return [(path, value)]
    rows: list[tuple[str, Any]] = []
    for key, inner in fields.items():
        rows += flat(inner, f"{path} · {words(key)}" if path else words(key))
    return rows


def short(value: Any) -> str:
    """Show a number with four digits, anything else as it is."""
    return "none" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def words(value: Any) -> str:
    """Show a name of the program as words."""
    return str(value).replace("_", " ")


def duration(seconds: Any) -> str:
    """Show a time that is left."""
    if seconds is None:
        return ""
    whole = int(seconds)
    minutes, rest = divmod(whole, 60)
    return f"{whole} s" if minutes == 0 else f"{minutes} min {rest} s"


def log_tail(path: Path) -> str:
    """Read the end of a log; a link that a job might have put there is not followed."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return ""
    with os.fdopen(descriptor, "rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        stream.seek(max(0, size - _LOG_BYTES))
        text = stream.read().decode("utf-8", errors="replace")
    return text if size <= _LOG_BYTES else text.partition("\n")[2]


def _is_kept(run: Mapping[str, Any]) -> bool:
    """Tell whether the home page lists a run however old it is."""
    return run["is_bundled"] or run["state"] not in ENDED


def _featured(runs: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Choose the finished run that the home page offers first: a bundled one, else the newest."""
    finished = [run for run in runs if run["is_published"] and run["kind"] == "reconstruction"]
    return min(finished, key=lambda run: not run["is_bundled"], default=None)


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
