"""What a suite's folder tells: its cells, and the tables made of them.

Tables are made of cells alone, so that they can be written while others are still computed, and so
that cells of an earlier order for the same sequences stay in them.
"""

from collections.abc import Iterable, Mapping
from collections.abc import Sequence as Many
from pathlib import Path
from typing import Any, cast

from physhandi.data.atomic import named_fields, write_bytes, write_json
from physhandi.data.run_files import read_json
from physhandi.errors import UsageError
from physhandi.metrics.suite_report import write_report
from physhandi.metrics.suite_tables import PAIRED_COLUMNS, compare, summarise, to_csv
from physhandi.synthetic.suite_scores import scores_of

CELLS = "cells.json"
"""What was asked for, and every cell with its figures."""
CURVES = "curves.json"
"""Errors frame by frame of the same cells, in the same order."""
_KEY = ("protocol", "split", "method", "case")

Cell = dict[str, Any]


class SuiteFolder:
    """The tables in a folder, which grow with every cell."""

    def __init__(self, out: Path, about: Mapping[str, Any]) -> None:
        """Read what is there; nothing is written yet.

        Args:
            out: The folder.
            about: What is asked for now: ``title methods oracles cases protocols made_from`` and
                more.

        Raises:
            UsageError: If the folder holds the table of another order.
        """
        self.out = out
        self.about = dict(about)
        self.done: list[Cell] = []
        before = check_folder(out, about["title"], about["cases"])
        self._earlier: list[Cell] = []
        self._skipped: list[str] = []
        self.notes: list[str] = []
        if before is None:
            return
        told = before["about"]
        methods = {n: text for n, text in told["methods"].items() if n not in about["methods"]}
        if told.get("made_from") == about["made_from"]:
            self._earlier = _with_curves(out, before["cells"])
            self._skipped = list(told["skipped"])
            self.about["methods"] = {**told["methods"], **about["methods"]}
            self.about["oracles"] = list(dict.fromkeys([*told["oracles"], *about["oracles"]]))
            self.about["protocols"] = list(dict.fromkeys([*told["protocols"], *about["protocols"]]))
        elif methods:
            self.notes.append(
                "Left out, because they were computed with other code, settings or data: "
                f"{', '.join(methods)}. Evaluate them again to have them in this table."
            )

    def write(
        self, environment: Mapping[str, Any], skipped: Many[str], missing: int
    ) -> dict[str, Any]:
        """Write cells, tables, report and charts of what is known by now.

        Args:
            environment: What it was computed with.
            skipped: What could not be asked for, and why.
            missing: Number of cells that are asked for and not finished.

        Returns:
            ``out``, ``table`` and ``report``: paths.
        """
        cells = self._all_cells()
        shown = {cell["method"] for cell in cells}
        about = self.about | {
            "methods": {n: text for n, text in self.about["methods"].items() if n in shown},
            "notes": [*self.about["notes"], *self.notes],
            "skipped": list(dict.fromkeys([*self._skipped, *skipped])),
            "missing": missing,
            "environment": dict(environment),
        }
        scores = list(scores_of(cells))
        rows = summarise(scores)
        methods = list(about["methods"])
        against = "phystwin" if "phystwin" in methods else (methods or [""])[0]
        differences = compare(scores, against)
        files = write_report(about, rows, differences, cells)
        about["charts"] = [Path(file).name for file in files if file.startswith("charts/")]
        files |= {"table.csv": to_csv(rows), "paired.csv": to_csv(differences, PAIRED_COLUMNS)}
        for file, content in files.items():
            (self.out / file).parent.mkdir(parents=True, exist_ok=True)
            write_bytes(self.out / file, content.encode())
        write_json(self.out / CURVES, {"curves": [cell["curves"] for cell in cells]})
        plain = [{name: v for name, v in cell.items() if name != "curves"} for cell in cells]
        write_json(self.out / CELLS, {"about": about, "cells": plain})
        return {
            "out": str(self.out),
            "table": str(self.out / "table.csv"),
            "report": str(self.out / "report.md"),
        }

    def _all_cells(self) -> list[Cell]:
        """Put what is finished beside what is kept of earlier orders, in the order of tables."""
        new = {_key(cell) for cell in self.done}
        kept = [
            cell
            for cell in self._earlier
            if _key(cell) not in new and (not cell["run"] or self._has_run(cell["run"]))
        ]
        places = [list(self.about[name]) for name in ("protocols", "cases", "methods")]

        def place(cell: Cell) -> tuple[int, ...]:
            named = (cell["protocol"], cell["case"], cell["method"])
            return tuple(known.index(name) for known, name in zip(places, named, strict=True))

        return sorted([*kept, *self.done], key=place)

    def _has_run(self, name: str) -> bool:
        return (self.out / "cells" / name / "run.yaml").is_file()


def check_folder(out: Path, title: str, cases: Iterable[str]) -> dict[str, Any] | None:
    """Read what a folder holds, and refuse it if that is the table of another order.

    Args:
        out: The folder.
        title: Title of what is asked for now.
        cases: Names of its sequences.

    Returns:
        ``about`` and ``cells``; None if there is no table.

    Raises:
        UsageError: If the table is of other sequences, or cannot be read.
    """
    path = out / CELLS
    if not path.is_file():
        return None
    content = named_fields(read_json(path)) or {}
    about = named_fields(content.get("about"))
    cells = content.get("cells")
    wanted = ("title", "methods", "cases", "protocols", "skipped")
    if about is None or not isinstance(cells, list) or any(name not in about for name in wanted):
        raise UsageError(f"{path} is damaged. Delete it; finished cells are kept without it.")
    wanted_cases = list(cases)
    if about["title"] != title or set(about["cases"]) != set(wanted_cases):
        raise UsageError(
            f"{out} holds the table '{about['title']}' of {', '.join(about['cases'])}, which "
            f"'{title}' of {', '.join(wanted_cases)} would replace. Choose another --out."
        )
    return {"about": about, "cells": cast("list[Cell]", cells)}


def _with_curves(out: Path, cells: Many[Cell]) -> list[Cell]:
    path = out / CURVES
    curves = (named_fields(read_json(path)) or {}).get("curves") if path.is_file() else None
    if not isinstance(curves, list) or len(cast("list[Any]", curves)) != len(cells):
        curves = [{} for _ in cells]
    both = zip(cells, cast("list[Any]", curves), strict=True)
    return [{**cell, "curves": curve} for cell, curve in both]


def _key(cell: Cell) -> tuple[str, ...]:
    return tuple(cell[name] for name in _KEY)
