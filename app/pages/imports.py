"""The page that imports recordings: choose a folder, see what it holds, set what it lacks."""

from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse

from app.jobs.catalog import Catalog
from app.jobs.recordings.imports import EXAMPLE, Imports
from app.pages.render import Pages

_Place = Annotated[str, Query(max_length=1000)]


def add_imports(router: APIRouter, catalog: Catalog, imports: Imports, pages: Pages) -> None:
    """Add the page that imports recordings to the routes.

    Args:
        router: Gets the routes.
        catalog: Finds sequences.
        imports: Finds recordings.
        pages: Renders.
    """

    @router.get("/import")
    def show_import(request: Request, folder: _Place = "") -> HTMLResponse:
        roots = imports.folders.roots
        place = folder.strip("/") or (next(iter(roots)) if len(roots) == 1 else "")
        is_chosen = bool(place) and place not in roots
        parts = place.split("/") if place else []
        return pages.render(
            request,
            "import.html",
            place=place,
            chosen=parts[-1] if is_chosen else "",
            path=[("/".join(parts[: n + 1]), part) for n, part in enumerate(parts)],
            entries=imports.folders.list(place),
            roots=roots,
            example=f"captures/{EXAMPLE}",
            has_example=(imports.folders.own / EXAMPLE).is_dir(),
        )

    @router.get("/import/survey")
    def show_survey(request: Request, source: _Place) -> HTMLResponse:
        """Look at a recording, which takes seconds, and ask for what it does not say."""
        name = source.split("/")[-1].partition(".")[0]
        taken = {item.id for item in catalog.sequences()}
        return pages.render(
            request,
            "_survey.html",
            source=source,
            survey=imports.survey(source),
            suggested=_free_name(name, taken),
        )


def _free_name(name: str, taken: set[str]) -> str:
    """Suggest a name for a sequence that no other one has."""
    safe = "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "_" for c in name)[:56]
    safe = safe or "recording"
    number, free = 1, safe
    while free in taken:
        number += 1
        free = f"{safe}_{number}"
    return free
