"""The pages of suites: methods compared on many sequences, and every cell to look into."""

import re
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from app.jobs.catalog import NotFoundError
from app.pages.metrics import about_quantity, figure, scaled, unit_of_metric
from app.pages.render import Pages
from app.wrong_fields import wrong_fields
from physhandi.data.files import files_by_age
from physhandi.data.run_folder import read_json
from physhandi.errors import PhysHandiError, RunError
from physhandi.metrics.suite_report import (
    SuiteRow,
    is_higher_better,
    laid_out,
    read_rows,
    tables_of,
)

_NAME = r"^[A-Za-z0-9_-]{1,64}$"
Name = Annotated[str, Field(pattern=_NAME)]
Chart = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,80}\.(svg|png)$")]
File = Literal["table.csv", "paired.csv", "per_sequence.csv", "report.md", "tables.tex"]
_BEST = "\0"
_TYPES = {
    ".csv": "text/csv",
    ".md": "text/markdown",
    ".tex": "text/plain",
    ".svg": "image/svg+xml",
    ".png": "image/png",
}
_SMALL = 64 * 2**20


class UnknownSuiteError(NotFoundError):
    """There is no suite of that name."""


class CellQuery(BaseModel):
    """Figure that the table of sequences shows; the fields are the parameters of an address."""

    model_config = ConfigDict(extra="forbid")

    split: Annotated[str, Field(max_length=80)] = "future"
    metric: Annotated[str, Field(max_length=80)] = "track_error"


class Environment(BaseModel):
    """Environment that a suite was computed in, as far as the page shows it."""

    started: str
    device: str
    device_name: str


class About(BaseModel):
    """Description of a suite in its ``cells.json``, as far as the page shows it."""

    title: str
    cases: list[str]
    methods: dict[str, str]
    oracles: list[str] = []
    seed_of: dict[str, str] = {}
    skipped: list[str]
    notes: list[str] = []
    missing: int = 0
    is_verification: bool = False
    charts: list[Chart] = []
    environment: Environment


class StoredCell(BaseModel):
    """One cell in ``cells.json``, as far as the page shows it."""

    method: str
    case: str
    split: str
    run: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{0,128}$")]
    error: str
    figures: dict[str, dict[str, float | None]]


class StoredCells(BaseModel):
    """Content of ``cells.json``."""

    about: About
    cells: list[StoredCell]


def add_suites(router: APIRouter, folder: Path, pages: Pages) -> None:
    """Add the pages of suites to the routes.

    Args:
        router: Gets the routes.
        folder: Folder of suites; each is a folder that ``physhandi evaluate suite`` filled.
        pages: Renders.
    """

    @router.get("/suites")
    def list_suites(request: Request) -> HTMLResponse:
        return pages.render(
            request, "suites.html", suites=[_described(path) for path in _folders(folder)]
        )

    @router.get("/suites/{name}")
    def show_suite(
        request: Request, name: Name, query: Annotated[CellQuery, Query()]
    ) -> HTMLResponse:
        path = _suite_folder(folder, name)
        content = _read(path)
        about, cells = content.about, content.cells
        return pages.render(
            request,
            "suite.html",
            suite=name,
            about=about,
            tables=_tables(_rows(path, about.seed_of), about.oracles),
            matrix=_matrix(cells, about.oracles, query),
            choices=_choices(cells),
            query=query,
            problems=[cell for cell in cells if cell.error],
            charts=[chart for chart in about.charts if (path / "charts" / chart).is_file()],
            files=[file for file in get_args(File) if (path / file).is_file()],
        )

    @router.get("/suites/{name}/charts/{chart}")
    def chart(name: Name, chart: Chart) -> Response:
        return _file(_suite_folder(folder, name) / "charts" / chart)

    @router.get("/suites/{name}/files/{file}")
    def file(name: Name, file: File) -> Response:
        return _file(_suite_folder(folder, name) / file)


def _folders(folder: Path) -> list[Path]:
    """List suites, the newest first."""
    suites = [path.parent for _, _, path in files_by_age(folder.glob("*/cells.json"))]
    return [path for path in reversed(suites) if _has_page(path)]


def _has_page(path: Path) -> bool:
    """Tell whether a route leads to a folder of this name."""
    return re.fullmatch(_NAME, path.name) is not None


def _suite_folder(folder: Path, name: str) -> Path:
    path = folder / name
    if not (path / "cells.json").is_file():
        raise UnknownSuiteError(
            f"There is no suite '{name}'. `physhandi evaluate suite` makes one."
        )
    return path


def _file(path: Path) -> Response:
    if not path.is_file() or path.is_symlink() or path.stat().st_size > _SMALL:
        raise UnknownSuiteError(f"This suite has no {path.name}. Evaluate it again.")
    return Response(path.read_bytes(), media_type=_TYPES[path.suffix])


def _described(path: Path) -> dict[str, Any]:
    try:
        content = _read(path)
    except PhysHandiError as error:
        return {"name": path.name, "title": "", "error": str(error)}
    about = content.about
    return {
        "name": path.name,
        "error": "",
        "title": about.title,
        "cases": len(about.cases),
        "methods": len(about.methods),
        "cells": len(content.cells),
        "failed": sum(bool(cell.error) for cell in content.cells),
        "written": about.environment.started,
        "device": about.environment.device_name or about.environment.device,
    }


def _read(path: Path) -> StoredCells:
    """Read the description and cells of a suite.

    Raises:
        RunError: If it is damaged.
    """
    file = path / "cells.json"
    try:
        return StoredCells.model_validate(read_json(file))
    except ValidationError as error:
        where, why = wrong_fields(error.errors())[0]
        raise RunError(
            f"{file} is damaged: {where}: {why}. Delete it, and evaluate the suite again; "
            "finished cells are kept."
        ) from None


def _rows(path: Path, hidden: Collection[str]) -> list[SuiteRow]:
    """Read the table of a suite without the methods that it shows as means over seeds."""
    file = path / "table.csv"
    try:
        rows = read_rows(file.read_text(encoding="utf-8"))
        return [row for row in rows if row.method not in hidden]
    except (OSError, ValueError) as error:
        raise RunError(f"{file} is not readable: {error}. Evaluate the suite again.") from error


def _tables(rows: list[SuiteRow], oracles: list[str]) -> list[dict[str, Any]]:
    tables: list[dict[str, Any]] = []
    for title, columns in tables_of(rows).items():
        head, *lines = laid_out(rows, columns, _BEST + "{}", oracles)
        body = [
            {
                "method": line[0],
                "cells": [
                    {"text": text.removeprefix(_BEST), "is_best": text.startswith(_BEST)}
                    for text in line[1:]
                ],
            }
            for line in lines
        ]
        tables.append({"title": title, "head": head[1:], "rows": body})
    return tables


def _matrix(cells: list[StoredCell], oracles: list[str], query: CellQuery) -> dict[str, Any]:
    """Arrange one figure by sequence and method; every cell leads to its run."""
    shown = [cell for cell in cells if query.split in cell.figures]
    methods = list(dict.fromkeys(cell.method for cell in shown))
    unit = unit_of_metric(set(query.metric.split("_")), "m")
    rows: list[dict[str, Any]] = []
    for case in dict.fromkeys(cell.case for cell in shown):
        of_case = {cell.method: cell for cell in shown if cell.case == case}
        values = {
            name: cell.figures[query.split].get(query.metric) for name, cell in of_case.items()
        }
        rivals = [
            value
            for name, value in values.items()
            if value is not None and name not in oracles and not of_case[name].error
        ]
        best = (max if is_higher_better(query.metric) else min)(rivals) if len(rivals) > 1 else None
        rows.append(
            {
                "case": case,
                "cells": [
                    _shown(
                        of_case.get(name),
                        values.get(name),
                        unit,
                        None if name in oracles else best,
                    )
                    for name in methods
                ],
            }
        )
    return {
        "methods": methods,
        "rows": rows,
        "unit": scaled(None, unit)[1],
        "about": about_quantity(query.metric),
    }


def _shown(
    cell: StoredCell | None, value: float | None, unit: str, best: float | None
) -> dict[str, Any]:
    return {
        "text": figure(scaled(value, unit)[0]),
        "is_best": value is not None and value == best and cell is not None and not cell.error,
        "run": cell.run if cell else "",
        "error": cell.error if cell else "",
    }


def _choices(cells: list[StoredCell]) -> dict[str, list[str]]:
    splits = dict.fromkeys(split for cell in cells for split in cell.figures)
    metrics = dict.fromkeys(
        metric for cell in cells for part in cell.figures.values() for metric in part
    )
    return {"splits": list(splits), "metrics": list(metrics)}
