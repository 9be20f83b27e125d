"""The pages of suites: methods compared on many sequences, and every cell to look into."""

from pathlib import Path
from typing import Annotated, Any, Literal, cast, get_args

from fastapi import APIRouter, Query, Response
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, ConfigDict, Field

from app.jobs.catalog import NotFoundError
from app.pages.metrics import about_quantity, figure, scaled, unit_of
from app.pages.render import Pages
from physhandi.data.atomic import named_fields
from physhandi.data.run_files import read_json
from physhandi.errors import PhysHandiError, RunError
from physhandi.metrics.suite_layout import laid_out
from physhandi.metrics.suite_report import tables_of
from physhandi.metrics.suite_tables import Row, is_higher_better, read_rows

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
Chart = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,80}\.svg$")]
File = Literal["table.csv", "paired.csv", "per_sequence.csv", "report.md", "tables.tex"]
_BEST = "\0"
_TYPES = {".csv": "text/csv", ".md": "text/markdown", ".tex": "text/plain", ".svg": "image/svg+xml"}
_SMALL = 64 * 2**20


class UnknownSuiteError(NotFoundError):
    """There is no suite of that name."""


class CellQuery(BaseModel):
    """Which figure the table of sequences shows; its fields are the parameters of an address."""

    model_config = ConfigDict(extra="forbid")

    split: Annotated[str, Field(max_length=80)] = "future"
    metric: Annotated[str, Field(max_length=80)] = "track_error"


def add_suites(router: APIRouter, folder: Path, pages: Pages) -> None:
    """Add the pages of suites to the routes.

    Args:
        router: Gets the routes.
        folder: Folder of suites; each is a folder that ``physhandi evaluate suite`` filled.
        pages: Renders.
    """

    @router.get("/suites")
    def list_suites() -> HTMLResponse:
        return pages.render("suites.html", suites=[_described(path) for path in _folders(folder)])

    @router.get("/suites/{name}")
    def show_suite(name: Name, query: Annotated[CellQuery, Query()]) -> HTMLResponse:
        path = _found(folder, name)
        about, cells = _read(path)
        rows = _rows(path)
        charts = sorted(chart.name for chart in (path / "charts").glob("*.svg"))
        return pages.render(
            "suite.html",
            suite=name,
            about=about,
            tables=_tables(rows),
            matrix=_matrix(cells, query),
            choices=_choices(cells),
            query=query,
            problems=[cell for cell in cells if cell["error"]],
            charts=charts,
            files=[file for file in get_args(File) if (path / file).is_file()],
        )

    @router.get("/suites/{name}/charts/{chart}")
    def chart(name: Name, chart: Chart) -> Response:
        return _file(_found(folder, name) / "charts" / chart)

    @router.get("/suites/{name}/files/{file}")
    def file(name: Name, file: File) -> Response:
        return _file(_found(folder, name) / file)


def _folders(folder: Path) -> list[Path]:
    found = [path.parent for path in folder.glob("*/cells.json")]
    return sorted(found, key=lambda path: (path / "cells.json").stat().st_mtime_ns, reverse=True)


def _found(folder: Path, name: str) -> Path:
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
        about, cells = _read(path)
    except PhysHandiError as error:
        return {"name": path.name, "title": "", "error": str(error)}
    return {
        "name": path.name,
        "error": "",
        "title": about["title"],
        "cases": len(about["cases"]),
        "methods": len(about["methods"]),
        "cells": len(cells),
        "failed": sum(bool(cell["error"]) for cell in cells),
        "written": about["environment"]["started"],
        "device": about["environment"]["device_name"] or about["environment"]["device"],
    }


def _read(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Read what a suite says of itself.

    Raises:
        RunError: If it is damaged.
    """
    file = path / "cells.json"
    content = named_fields(read_json(file)) or {}
    about, listed = named_fields(content.get("about")), content.get("cells")
    known = ("title", "cases", "methods", "protocols", "skipped", "environment")
    if about is None or not isinstance(listed, list) or any(name not in about for name in known):
        raise RunError(f"{file} is damaged. Evaluate the suite again.")
    cells = [named_fields(cell) or {} for cell in cast("list[object]", listed)]
    wanted = ("method", "case", "protocol", "split", "run", "error", "figures")
    if any(name not in cell for cell in cells for name in wanted):
        raise RunError(f"{file}: a cell is damaged. Evaluate the suite again.")
    return about, cells


def _rows(path: Path) -> list[Row]:
    file = path / "table.csv"
    try:
        return read_rows(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RunError(f"{file} is not readable: {error}. Evaluate the suite again.") from error


def _tables(rows: list[Row]) -> list[dict[str, Any]]:
    tables: list[dict[str, Any]] = []
    for title, columns in tables_of(rows).items():
        head, *lines = laid_out(rows, columns, _BEST + "{}")
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


def _matrix(cells: list[dict[str, Any]], query: CellQuery) -> dict[str, Any]:
    """Arrange one figure by sequence and method; every cell leads to its run."""
    shown = [cell for cell in cells if query.split in cell["figures"]]
    methods = list(dict.fromkeys(cell["method"] for cell in shown))
    unit = unit_of(set(query.metric.split("_")), "m")
    rows: list[dict[str, Any]] = []
    for case in dict.fromkeys(cell["case"] for cell in shown):
        of_case = {cell["method"]: cell for cell in shown if cell["case"] == case}
        values = {
            method: cell["figures"][query.split].get(query.metric)
            for method, cell in of_case.items()
        }
        known = [value for value in values.values() if isinstance(value, int | float)]
        best = (max if is_higher_better(query.metric) else min)(known) if len(known) > 1 else None
        rows.append(
            {
                "case": case,
                "cells": [
                    _shown(of_case.get(method), values.get(method), unit, best)
                    for method in methods
                ],
            }
        )
    return {
        "methods": methods,
        "rows": rows,
        "unit": scaled(None, unit)[1],
        "about": about_quantity(query.metric),
    }


def _shown(cell: dict[str, Any] | None, value: Any, unit: str, best: Any) -> dict[str, Any]:
    return {
        "text": figure(scaled(value, unit)[0]),
        "is_best": value is not None and value == best,
        "run": cell["run"] if cell else "",
        "error": cell["error"] if cell else "",
    }


def _choices(cells: list[dict[str, Any]]) -> dict[str, list[str]]:
    splits = dict.fromkeys(split for cell in cells for split in cell["figures"])
    metrics = dict.fromkeys(
        metric for cell in cells for part in cell["figures"].values() for metric in part
    )
    return {"splits": list(splits), "metrics": list(metrics)}
