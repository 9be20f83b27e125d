"""The simulation's parameters as a table: what was found beside what it began with."""

import math
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from app.pages.metrics import scaled
from app.pages.render import short
from physhandi.data.files import named_fields
from physhandi.errors import PhysHandiError
from physhandi.fitting.config import notes_of
from physhandi.run import Run
from physhandi.simulation.parameters import SimulationParameters

_FOUND = "object/parameters.yaml"


def parameter_rows(run: Run, found: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Lay the parameters out as rows of ``name about unit start value is_changed``.

    Args:
        run: The run; its configuration, or the run that it simulates again, tells the start.
        found: The parameters that it ended with.
    """
    start = _start_of(run)
    rows: list[dict[str, Any]] = []
    for name, value in found.items():
        about, unit = field_notes().get(name, ("", ""))
        before = start.get(name)
        rows.append(
            {
                "name": name,
                "about": about,
                "unit": scaled(None, unit)[1],
                "start": _text(before, unit) if name in start else "",
                "value": _text(value, unit),
                "is_changed": name in start and not _is_same(before, value),
            }
        )
    return rows


@cache
def field_notes() -> dict[str, tuple[str, str]]:
    """Read what each simulation parameter means, and its unit, from where it is declared."""
    return notes_of(SimulationParameters)


def _start_of(run: Run) -> dict[str, Any]:
    if run.kind == "simulation":
        try:
            source = Run.open(Path(str(run.config.get("source", ""))))
            return named_fields(source.yaml(_FOUND)) or {}
        except (PhysHandiError, OSError):
            return {}  # The run that it began from was deleted since.
    profile = named_fields(run.config.get("profile")) or {}
    return named_fields(profile.get("simulation")) or {}


def _text(value: Any, unit: str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return short(scaled(value, unit)[0])


def _is_same(first: Any, second: Any) -> bool:
    numbers = [v for v in (first, second) if isinstance(v, int | float)]
    return math.isclose(*numbers, rel_tol=1e-9) if len(numbers) == 2 else first == second
