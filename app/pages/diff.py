"""Table of what several runs have in common and where they differ."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

from app.pages.metrics import (
    about_quantity,
    figure,
    is_better_when_higher,
    is_count,
    scaled,
    unit_of_metric,
)
from app.pages.parameters import meaning_of
from app.pages.render import duration, short, words
from physhandi.data.files import named_fields
from physhandi.settings import flatten, is_same

LEAST_RUNS, MOST_RUNS = 2, 5
"""Fewest and most runs that can be compared."""
_COMMIT_DIGITS = 12
_SPLITS = {"reconstruction": "fitted frames", "future": "predicted frames"}
_UNCOMPARED = {"description", "aggregation", "unit", "frames"}

_TOLD_ELSEWHERE = {"profile", "edits", "overrides"}
"""Keys of a configuration beside settings; those that override a profile are in it."""
_CHANGED = "parameters."
"""Settings that begin so are the parameters that a simulation was asked to change."""
_NOTICED = 0.005
"""Scores that differ by a smaller share are as good as the same."""

_Scores = dict[tuple[str, str, str], tuple[float, str]]


@dataclass(frozen=True)
class ComparedCell:
    """Value of a quantity in one run."""

    text: str
    is_best: bool = False
    """Whether no other run is better."""
    change: str = ""
    """Its difference from the first run."""
    moment: str = ""
    """If the text is a time, what browsers show in their own time zone; ISO 8601."""


@dataclass(frozen=True)
class Row:
    """One quantity of all runs."""

    name: str
    cells: list[ComparedCell]
    differs: bool
    """Whether the runs do not all have the same."""
    about: str = ""
    unit: str = ""


@dataclass(frozen=True)
class Section:
    """Rows that belong together."""

    name: str
    rows: list[Row] = field(default_factory=list[Row])

    @property
    def shown(self) -> list[Row]:
        """The rows that differ."""
        return [row for row in self.rows if row.differs]


def compare_runs(
    described: Sequence[Mapping[str, Any]],
    configs: Sequence[Mapping[str, Any]],
    results: Sequence[Mapping[str, Mapping[str, Any]]],
) -> list[Section]:
    """Lay runs side by side.

    Args:
        described: `describe_run` of each.
        configs: Configuration of each.
        results: `describe_results` of each.

    Returns:
        Sections of edits, facts, what somebody chose, and what came of it: settings, and
        parameters where they were chosen, then scores, losses, parameters where they were fitted,
        and surroundings. One without rows is left out. Only scores have a best value.
    """
    parameters = [result.get("parameters", {}) for result in results]
    surroundings = [_surroundings_of(result.get("environment", {})) for result in results]
    is_chosen = any(run["kind"] == "simulation" for run in described)
    ended_with = Section("Parameters that the simulation ended with", _parameter_rows(parameters))
    losses = [_losses_of(result) for result in results]
    sections = [
        Section("Edits of springs and nodes", _edit_rows(configs)),
        Section("The runs", _fact_rows(described)),
        *([ended_with] if is_chosen else []),
        Section("Settings", _setting_rows(configs)),
        *_score_sections([_scores_of(result.get("metrics", {})) for result in results]),
        Section("Loss at the end of each stage", _plain_rows(losses, counts_absence=False)),
        *([] if is_chosen else [ended_with]),
        Section("Computed with", _plain_rows(surroundings, counts_absence=False)),
    ]
    return [section for section in sections if section.rows]


def _facts_of(run: Mapping[str, Any]) -> dict[str, Any]:
    facts = {
        "state": run["state"],
        "kind": run["kind"],
        "sequences": ", ".join(run["sequences"]),
        "profile": run["profile"],
        "tags": ", ".join(run["tags"]),
        "created": run["created"][:16].replace("T", " "),
        "took": duration(run["duration_s"]),
    }
    return {name: fact for name, fact in facts.items() if fact}


def _fact_rows(described: Sequence[Mapping[str, Any]]) -> list[Row]:
    moments = [run["created"] for run in described]
    return [
        replace(row, cells=[replace(c, moment=m) for c, m in zip(row.cells, moments, strict=True)])
        if row.name == "created"
        else row
        for row in _plain_rows([_facts_of(run) for run in described])
    ]


def _setting_rows(configs: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Lay settings side by side; a run that simulates a fitted object again has none of a fit."""
    columns = [_settings_of(config) for config in configs]
    changed = [{k: v for k, v in c.items() if k.startswith(_CHANGED)} for c in columns]
    others = [{k: v for k, v in c.items() if not k.startswith(_CHANGED)} for c in columns]
    return _plain_rows(changed) + _plain_rows(others, counts_absence=False)


def _edit_rows(configs: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Lay edits side by side, step by step; those of one name may be of other springs or nodes."""
    edits_of_runs = [named_fields(config.get("edits")) or {} for config in configs]
    columns = [
        {f"step {number}": step for number, step in enumerate(edits.get("steps", ()), start=1)}
        for edits in edits_of_runs
    ]
    rows = _plain_rows(columns)
    hashes = [str(edits.get("sha256", ""))[:_COMMIT_DIGITS] for edits in edits_of_runs]
    if len(set(hashes)) > 1 and not any(row.differs for row in rows):
        cells = [ComparedCell(text) for text in hashes]
        rows.append(Row("the same steps, of other springs, nodes or frames", cells, differs=True))
    return rows


def _plain_rows(columns: Sequence[Mapping[str, Any]], *, counts_absence: bool = True) -> list[Row]:
    """Make a row of every value.

    Args:
        columns: Values of each run by name.
        counts_absence: Whether runs differ if one of them lacks what the others agree on.
    """
    rows: list[Row] = []
    for name in _names(columns):
        values = [column.get(name) for column in columns]
        if any(value is not None for value in values):
            cells = [ComparedCell(text) for text in _texts(columns, name)]
            shown = " / ".join(words(part.rstrip("_")) for part in name.split("."))
            compared = values if counts_absence else _present(values)
            rows.append(Row(shown, cells, _differ(compared)))
    return rows


def _present(values: Sequence[Any]) -> list[Any]:
    return [value for value in values if value is not None]


def _parameter_rows(columns: Sequence[Mapping[str, Any]]) -> list[Row]:
    rows: list[Row] = []
    for name in _names(columns):
        about, unit = meaning_of(name)
        values = [column.get(name) for column in columns]
        scaled_columns = [
            {name: scaled(column[name], unit)[0]} if name in column else {} for column in columns
        ]
        cells = [ComparedCell(text) for text in _texts(scaled_columns, name)]
        rows.append(Row(words(name), cells, _differ(values), about, scaled(None, unit)[1]))
    return rows


def _score_sections(columns: Sequence[_Scores]) -> list[Section]:
    parts = dict.fromkeys((sequence, part) for column in columns for sequence, part, _ in column)
    return [
        Section(
            f"Scores of {sequence}, {words(part)}",
            [
                _score_row(columns, (sequence, part, name))
                for name in dict.fromkeys(
                    key[2] for column in columns for key in column if key[:2] == (sequence, part)
                )
            ],
        )
        for sequence, part in parts
    ]


def _score_row(columns: Sequence[_Scores], key: tuple[str, str, str]) -> Row:
    name = key[2]
    words_of_name = set(name.rsplit(".", 1)[-1].split("_"))
    values = [column[key][0] if key in column else None for column in columns]
    numbers = [value for value in values if value is not None]
    unit = unit_of_metric(
        words_of_name, next(column[key][1] for column in columns if key in column)
    )
    best = (max if is_better_when_higher(words_of_name) else min)(numbers)
    is_score = key[1] != "topology" and not is_count(words_of_name)
    differs = any(not is_same(numbers[0], value, tolerance=_NOTICED) for value in numbers[1:])
    is_contest = is_score and differs
    cells = [
        ComparedCell(
            figure(scaled(value, unit)[0]),
            is_contest and value is not None and _same(value, best),
            _change(values[0], value) if number else "",
        )
        for number, value in enumerate(values)
    ]
    shown = " / ".join(words(part) for part in name.split("."))
    return Row(shown, cells, differs, about_quantity(name), scaled(None, unit)[1])


def _scores_of(metrics: Mapping[str, Any]) -> _Scores:
    """Find every score of the rollout by sequence, part and name, with its unit of length."""
    score_of: _Scores = {}
    for sequence, scores in metrics.items():
        fields = named_fields(scores) or {}
        unit = str(fields.get("unit", "m"))
        for part, content in fields.items():
            inside = named_fields(content) or {}
            of_object = named_fields(inside.get("rollout"))
            local = str(inside.get("unit", unit))
            for name, value in flatten(inside if of_object is None else of_object).items():
                if _is_number(value) and name.rsplit(".", 1)[-1] not in _UNCOMPARED:
                    score_of[sequence, _SPLITS.get(part, part), name] = (float(value), local)
    return score_of


def _losses_of(result: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    losses = result.get("losses", {})
    return {stage: (named_fields(summary) or {}).get("after") for stage, summary in losses.items()}


def _settings_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """Flatten a configuration; the settings of a profile are named without saying so."""
    profile = named_fields(config.get("profile")) or {}
    others = {key: value for key, value in config.items() if key not in _TOLD_ELSEWHERE}
    flat = flatten(profile) | flatten(others)
    return {name: value for name, value in flat.items() if name not in _UNCOMPARED}


def _surroundings_of(environment: Mapping[str, Any]) -> dict[str, Any]:
    flat = flatten({key: value for key, value in environment.items() if key != "started"})
    commit = flat.get("commit")
    if environment:
        flat["commit"] = str(commit)[:_COMMIT_DIGITS] if commit else "not run from a checkout"
    return flat


def _names(columns: Iterable[Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(name for column in columns for name in column))


def _texts(columns: Sequence[Mapping[str, Any]], name: str) -> list[str]:
    """Write a value of all runs; numbers that differ get the digits by which they do."""
    texts = [_text(column, name) for column in columns]
    numbers = [float(column[name]) for column in columns if _is_number(column.get(name))]
    if len(set(texts)) > 1 or len(numbers) < len(texts) or not _differ(numbers):
        return texts
    for digits in range(5, 18):
        is_small = max(map(abs, numbers)) < 1e-3
        kind = f".{digits - 1}e" if is_small else f".{digits}g"
        texts = [f"{number:{kind}}".replace("e-0", "e-") for number in numbers]
        if len(set(texts)) > 1:
            break
    return texts


def _text(column: Mapping[str, Any], name: str) -> str:
    if name not in column:
        return "–"  # noqa: RUF001  # a dash, as tables have it
    value = column[name]
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(short(item) for item in cast("list[Any]", value)) or "none"
    return "none" if value in ({}, None) else short(value)


def _change(first: Any, value: Any) -> str:
    """Tell how much more or less a value is than the first run's."""
    if not (_is_number(first) and _is_number(value)) or not first or _same(first, value):
        return ""
    percent = 100.0 * (value - first) / abs(first)
    sign = "+" if percent > 0 else "−"  # noqa: RUF001  # the sign for minus
    if abs(percent) >= 1000:
        return f"{sign}{abs(percent) / 100:.0f}×"  # times
    return f"{sign}{abs(percent):.0f} %" if abs(percent) >= 1 else f"{sign}{abs(percent):.1g} %"


def _differ(values: Sequence[Any]) -> bool:
    return any(not _same(values[0], value) for value in values[1:])


def _same(first: Any, second: Any) -> bool:
    return is_same(first, second, tolerance=1e-9)


def _is_number(value: Any) -> bool:
    is_one = isinstance(value, int | float) and not isinstance(value, bool)
    return is_one and math.isfinite(value)
