"""The pages: home, one run, one live scene."""

from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
from pydantic import Field

import web_assets as assets_package
from app.describe import describe_results, describe_run, describe_sequence
from app.jobs.catalog import Catalog
from app.jobs.scheduler import Scheduler
from physhandi.fitting.profile import load_profile, profile_names

ASSETS = Path(assets_package.__file__).parent
Id = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
_LOG_BYTES = 20_000


def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(ASSETS / "templates"),
        autoescape=select_autoescape(default=True),
        undefined=StrictUndefined,
    )
    environment.filters["short"] = _short
    return environment


def _short(value: Any) -> str:
    """Show a number with four digits, anything else as it is."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


class Pages:
    """Renders templates; everything a user wrote is escaped."""

    def __init__(self) -> None:
        self._environment = _environment()

    def render(self, name: str, *, status: int = 200, **values: Any) -> HTMLResponse:
        """Fill a template."""
        return HTMLResponse(self._environment.get_template(name).render(values), status_code=status)

    def error(self, status: int, message: str) -> HTMLResponse:
        """Show an error in the frame of the application."""
        return self.render("error.html", status=status, code=status, message=message)


def create_pages(catalog: Catalog, scheduler: Scheduler, pages: Pages) -> APIRouter:
    """Make the routes of the pages.

    Args:
        catalog: Finds sequences and runs.
        scheduler: Tells how far runs are.
        pages: Renders.
    """
    router = APIRouter(include_in_schema=False)

    @router.get("/")
    def home() -> HTMLResponse:
        return pages.render(
            "home.html",
            sequences=[describe_sequence(item) for item in catalog.sequences()],
            runs=[describe_run(item, scheduler) for item in catalog.runs()],
            profiles=[(name, load_profile(name).description) for name in ordered_profiles()],
        )

    @router.get("/partials/runs")
    def runs() -> HTMLResponse:
        listed = [describe_run(item, scheduler) for item in catalog.runs()]
        return pages.render("_runs.html", runs=listed)

    @router.get("/runs/{run_id}")
    def run(run_id: Id) -> HTMLResponse:
        item = catalog.run_item(run_id)
        return pages.render(
            "run.html",
            run=describe_run(item, scheduler),
            results=describe_results(item),
            log=_log_tail(item.folder / "log.txt"),
        )

    @router.get("/live/{session_id}")
    def live(request: Request, session_id: Id) -> HTMLResponse:
        session = request.app.state.sessions.get(session_id)
        if session is None:
            return pages.error(
                404, "This live scene was closed. Open it again from the start page."
            )
        return pages.render(
            "live.html", session=session_id, title=session.target, kind=session.kind
        )

    return router


def ordered_profiles() -> list[str]:
    """Give the profiles, the quickest first."""
    return sorted(profile_names(), key=lambda name: (name != "quick", name != "default", name))


def _log_tail(path: Path) -> str:
    if not path.is_file():
        return ""
    with path.open("rb") as stream:
        stream.seek(max(0, path.stat().st_size - _LOG_BYTES))
        return stream.read().decode("utf-8", errors="replace")
