"""The simulation's parameters as a table: what was found beside what it began with."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from app.pages.metrics import scaled
from app.pages.render import short
from physhandi.data.files import named_fields
from physhandi.data.layout import PARAMETERS_FILE
from physhandi.errors import PhysHandiError
from physhandi.run import Run
from physhandi.settings import changes
from physhandi.simulation.parameters import PARAMETERS

_TOLERANCE = 1e-9
"""Numbers that differ by a smaller share were only rounded on the way."""


def parameter_rows(run: Run, final: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Lay the parameters out as rows of ``name about unit start value is_changed``.

    Args:
        run: The run; its configuration, or the run that it simulates again, tells the start.
        final: The parameters that it ended with.
    """
    start = _start_of(run)
    rows: list[dict[str, Any]] = []
    changed = changes(start, final, tolerance=_TOLERANCE)
    for name, value in final.items():
        about, unit = meaning_of(name)
        before = start.get(name)
        rows.append(
            {
                "name": name,
                "about": about,
                "unit": scaled(None, unit)[1],
                "start": _text(before, unit) if name in start else "",
                "value": _text(value, unit),
                "is_changed": name in start and name in changed,
            }
        )
    return rows


def meaning_of(name: str) -> tuple[str, str]:
    """Give what a simulation parameter means, and its unit; empty for one of another version."""
    parameter = PARAMETERS.get(name)
    return (parameter.about, parameter.unit) if parameter else ("", "")


def _start_of(run: Run) -> dict[str, Any]:
    if run.kind == "simulation":
        try:
            source = Run.open(Path(str(run.config.get("source", ""))))
            return named_fields(source.yaml(PARAMETERS_FILE)) or {}
        except (PhysHandiError, OSError):
            return {}  # The run that it began from was deleted since.
    profile = named_fields(run.config.get("profile")) or {}
    return named_fields(profile.get("simulation")) or {}


def _text(value: Any, unit: str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return short(scaled(value, unit)[0])
