"""The report of a suite: the paper's tables, comparisons, every sequence, and what it ran on."""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

from physhandi.metrics.suite_layout import Column, latex_table, markdown_table
from physhandi.metrics.suite_plots import bar_chart, line_chart
from physhandi.metrics.suite_tables import Difference, Row

_MM, _CM = 1000.0, 100.0
_PAPER = (
    ("chamfer_dynamic_l1", "CD_dyn [mm]", _MM, 2),
    ("chamfer_phystwin", "CD_full [mm]", _MM, 2),
    ("track_error_phystwin", "Track [cm]", _CM, 2),
    ("iou", "IoU ↑", 1.0, 3),
    ("psnr", "PSNR ↑", 1.0, 2),
)
_PROPER = (
    ("chamfer_dynamic_symmetric", "CD_dyn sym. [mm]", _MM, 2),
    ("chamfer_symmetric", "CD sym. [mm]", _MM, 2),
    ("chamfer_truth", "CD to truth [mm]", _MM, 2),
    ("track_error", "Track [mm]", _MM, 2),
    ("marker_error", "Markers [mm]", _MM, 2),
)
_CONTACT = (
    ("contact_accuracy_5mm", "accuracy 5 mm ↑", 1.0, 3),
    ("contact_accuracy_10mm", "accuracy 10 mm ↑", 1.0, 3),
    ("contact_f1_5mm", "F1 5 mm ↑", 1.0, 3),
    ("contact_f1_10mm", "F1 10 mm ↑", 1.0, 3),
)
_OTHER = {
    "hands": (
        ("mpjpe", "MPJPE [mm]", _MM, 2),
        ("hand_surface", "surface [mm]", _MM, 2),
        ("hand_chamfer", "Hand CD [mm]", _MM, 2),
    ),
    "topology": (("rrd_object", "RRD object", 1.0, 2), ("rrd_virtual", "RRD virtual", 1.0, 2)),
}
_SPLITS = {"reconstruction": "rec.", "future": "fut."}
_COMPARED = ("chamfer_dynamic_l1", "chamfer_phystwin", "track_error_phystwin", "track_error")
_CURVE = "track_error"
_NOTE = """\
Figures are means over sequences of the mean over frames of the mean over points; brackets hold the
95 % interval of a bootstrap over sequences, for which all methods are resampled together. Frame 0
is given and not scored. `rec.` are the frames that were fitted, `fut.` those that were held out. A
method without output scores as the static object, which touches nothing. The best figure of a
column is bold, and so is every one that prints the same; oracles do not count, and no figure is
bold where methods have different numbers of sequences, which `n` then tells. CD_dyn and CD_full are
one-way and in the L1 norm, as PhysTwin computes them; `sym.` is the symmetric mean of Euclidean
distances. All data is synthetic: these figures do not compare with those published on other data.
docs/evaluation.md explains the methods and protocols, docs/metrics.md every metric.
"""


def write_report(
    about: Mapping[str, Any],
    rows: Sequence[Row],
    differences: Sequence[Difference],
    cells: Sequence[Mapping[str, Any]],
) -> dict[str, str]:
    """Put a suite's results into words, tables and charts.

    Args:
        about: Of the suite: ``title command methods oracles cases protocols settings seeds
            is_verification presets generators notes skipped missing environment``.
        rows: Means over sequences.
        differences: Paired comparisons with one method.
        cells: One entry a cell: ``method case run error figures curves seconds`` and more.

    Returns:
        Content by file name: ``report.md``, ``tables.tex``, ``per_sequence.csv`` and charts.
    """
    tables = tables_of(rows)
    charts = _charts(rows, cells)
    oracles = about["oracles"]
    mark = " (verification)" if about["is_verification"] else ""
    parts = [f"# {about['title']}{mark}", "", _intro(about), _NOTE]
    for title, columns in tables.items():
        parts += [f"## {title}{mark}", "", markdown_table(rows, columns, oracles)]
    if differences:
        parts += [f"## Compared with {differences[0].against}", "", _compared(differences)]
    if charts:
        parts += ["## Charts", "", *(f"![{file}]({file})" for file in charts), ""]
    parts += ["## Every sequence", "", _every_sequence(cells)]
    parts += ["## Missing output", "", _missing(about, cells)]
    parts += ["## Computed with", "", _environment(about)]
    latex = "\n".join(
        f"% {title}{mark}\n{latex_table(rows, columns, oracles)}"
        for title, columns in tables.items()
    )
    return {
        "report.md": "\n".join(parts),
        "tables.tex": latex,
        "per_sequence.csv": _per_sequence(cells),
        **charts,
    }


def tables_of(rows: Sequence[Row]) -> dict[str, list[Column]]:
    """Choose the tables for which there are figures, in the order of the paper."""
    splits = list(dict.fromkeys(row.split for row in rows))
    wanted: dict[str, list[Column]] = {
        "Reconstruction and future prediction": _both(_PAPER),
        "The same by proper metrics": _both(_PROPER),
        "Contact": _both(_CONTACT),
    }
    for kind, title in (("dense", "Dense contact"), ("point", "Point contact")):
        wanted[title] = _both(_PAPER[:3] + _CONTACT[:1], f"/{kind}")
    for split, figures in _OTHER.items():
        wanted[split.capitalize()] = _columns(split, "", figures)
    wanted["Unseen interaction"] = _columns("unseen", "", _PAPER)
    for split in splits:
        name, slash, last = split.rpartition("/")
        if slash and last == "future":
            hands = _columns(f"{name}/hands", "", _OTHER["hands"])
            wanted[name.replace("_", " ").capitalize()] = [
                *_both(_PAPER, before=f"{name}/"),
                *hands,
            ]
    times = [row.metric for row in rows if row.split == "runtime"]
    wanted["Seconds for a video frame"] = [
        Column(
            split="runtime",
            metric=metric,
            title=metric.removeprefix("seconds_per_frame").strip("_").replace("_", " ") or "all",
        )
        for metric in dict.fromkeys(times)
    ]
    known = {(row.split, row.metric) for row in rows}
    return {
        title: columns
        for title, columns in wanted.items()
        if any((column.split, column.metric) in known for column in columns)
    }


def _both(figures: Sequence[tuple[str, str, float, int]], after: str = "", before: str = ""):
    return [
        column
        for split, short in _SPLITS.items()
        for column in _columns(f"{before}{split}{after}", short, figures)
    ]


def _columns(
    split: str, short: str, figures: Sequence[tuple[str, str, float, int]]
) -> list[Column]:
    return [
        Column(
            split=split,
            metric=metric,
            title=f"{short} {title}".strip(),
            factor=factor,
            digits=digits,
        )
        for metric, title, factor, digits in figures
    ]


def _intro(about: Mapping[str, Any]) -> str:
    cases, methods = about["cases"], about["methods"]
    lines = [f"{len(cases)} sequences: {', '.join(cases)}.", ""]
    lines += [f"* `{name}`: {text}" for name, text in methods.items()]
    if len(cases) == 1:
        lines += ["", "One sequence alone has no interval."]
    if about["is_verification"]:
        lines += ["", "**Verification**: seeds from 1000 on; nothing may be tuned on this table."]
    if about["missing"]:
        lines += ["", f"**Not finished**: {about['missing']} cells are missing."]
    for note in about["notes"]:
        lines += ["", f"**Note**: {note}"]
    return "\n".join([*lines, ""])


def _compared(differences: Sequence[Difference]) -> str:
    against = differences[0].against
    lines = [
        f"Method less `{against}` on the same sequences [mm]; below zero is better.",
        "",
        "| method | split | metric | difference | better in |",
        "| --- | --- | --- | ---: | ---: |",
    ]
    for entry in differences:
        if entry.metric in _COMPARED and entry.split in _SPLITS:
            low, mean, high = (
                f"{_MM * value:+.2f}" for value in (entry.low, entry.difference, entry.high)
            )
            shown = f"{mean} [{low}, {high}]" if entry.n > 1 else mean
            lines.append(
                f"| {entry.method} | {entry.split} | {entry.metric} | {shown} "
                f"| {entry.better} of {entry.n} |"
            )
    return "\n".join([*lines, ""])


def _every_sequence(cells: Sequence[Mapping[str, Any]]) -> str:
    shown = [cell for cell in cells if cell["protocol"] == "main"]
    lines = [
        "| sequence | method | rec. CD_full [mm] | rec. Track [cm] | fut. CD_full [mm] "
        "| fut. Track [cm] | run |",
        "| --- | --- | ---: | ---: | ---: | ---: | --- |",
    ]
    for cell in sorted(shown, key=lambda cell: str(cell["case"])):
        figures = [
            _figure(cell, split, metric, factor)
            for split in _SPLITS
            for metric, factor in (("chamfer_phystwin", _MM), ("track_error_phystwin", _CM))
        ]
        mark = " (static stands in)" if cell["error"] else ""
        lines.append(
            f"| {cell['case']} | {cell['method']}{mark} | {' | '.join(figures)} "
            f"| `{cell['run'] or '-'}` |"
        )
    return "\n".join([*lines, ""])


def _figure(cell: Mapping[str, Any], split: str, metric: str, factor: float) -> str:
    value = cell["figures"].get(split, {}).get(metric)
    return "-" if value is None else f"{factor * value:.2f}"


def _missing(about: Mapping[str, Any], cells: Sequence[Mapping[str, Any]]) -> str:
    lines = [
        f"* {cell['method']} on {cell['case']} ({cell['split']}): {cell['error']}"
        for cell in cells
        if cell["error"]
    ]
    lines += [f"* Not asked for: {reason}" for reason in about["skipped"]]
    return "\n".join([*(lines or ["Every method gave an output on every sequence."]), ""])


def _environment(about: Mapping[str, Any]) -> str:
    found = about["environment"]
    packages = ", ".join(f"{name} {version}" for name, version in found["packages"].items())
    settings = ", ".join(f"{name} = {value}" for name, value in about["settings"].items())
    made = {"command": [about["command"] and f"`{about['command']}`"]} | {
        name: about[name] for name in ("seeds", "presets", "generators")
    }
    shared = about.get("at_once", 1)
    crowd = f", shared by {shared} cells at a time, so times are longer" if shared > 1 else ""
    return "\n".join(
        [
            *(
                f"* {name}: {', '.join(str(value) for value in values)}"
                for name, values in made.items()
                if any(value != "" for value in values)
            ),
            f"* device: {found['device']} {found['device_name']}, {found['cpu_count']} processors"
            + crowd,
            f"* system: {found['system']}, Python {found['python']}",
            f"* commit: {found['commit'] or 'not run from a checkout'}",
            f"* packages: {packages}",
            f"* settings that all methods share: {settings or 'none'}",
            f"* written: {found['started']}",
            "",
        ]
    )


def _per_sequence(cells: Sequence[Mapping[str, Any]]) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(("method", "sequence", "split", "metric", "value", "stood_in", "run"))
    for cell in cells:
        for split, figures in cell["figures"].items():
            for metric, value in figures.items():
                place = (cell["method"], cell["case"], split, metric)
                stood_in = int(bool(cell["error"]))
                writer.writerow((*place, f"{value:.7g}", stood_in, cell["run"]))
    return stream.getvalue()


def _charts(rows: Sequence[Row], cells: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    charts: dict[str, str] = {}
    for split in _SPLITS:
        bars = [
            (row.method, _MM * row.mean, _MM * row.low, _MM * row.high)
            for row in rows
            if row.split == split and row.metric == "chamfer_phystwin"
        ]
        if bars:
            title = f"CD_full, {split} [mm]"
            charts[f"charts/{split}.svg"] = bar_chart(title, bars)
    for case in dict.fromkeys(str(cell["case"]) for cell in cells):
        lines = {
            str(cell["method"]): [
                None if value is None else _MM * value for value in cell["curves"][_CURVE]
            ]
            for cell in cells
            if cell["case"] == case and cell["protocol"] == "main" and _CURVE in cell["curves"]
        }
        if lines:
            # Split and sequence may have one name.
            charts[f"charts/sequence_{case}.svg"] = line_chart(f"Track error on {case} [mm]", lines)
    return charts
