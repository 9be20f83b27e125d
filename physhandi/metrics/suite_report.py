"""Writes the report of a suite: tables, paired comparisons, charts, and the environment.

`summarise` and `compare` turn scores into rows, `write_report` turns rows into files.
"""

import csv
import io
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

SUITE_COLUMNS = ("method", "split", "metric", "mean", "low", "high", "n")
"""Columns of ``table.csv``."""
SEED_COLUMNS = (*SUITE_COLUMNS, "spread")
"""Its columns if there are means over several seeds of a search."""
PAIRED_COLUMNS = (
    *("method", "against", "split", "metric"),
    *("difference", "low", "high", "better", "n"),
)
"""Columns of ``paired.csv``."""
RESAMPLES = 4000
"""Resamples of a bootstrap."""
LEVEL = 0.95
"""Share of the resamples that an interval holds."""
_SEED = 20250
_ROWS = 2**15
"""Intervals that are kept: more than tables of a suite have rows."""
_HIGHER = ("iou", "psnr", "ssim", "contact_accuracy", "contact_f1")
_NONE = "–"  # noqa: RUF001  # a dash, as tables have it
_LATEX = (
    ("\\", "\\textbackslash{}"),
    *((sign, f"\\{sign}") for sign in "_%&#$"),
    ("δ", "$\\delta$"),
    ("×", "$\\times$"),
    ("↑", "$\\uparrow$"),
    ("±", "$\\pm$"),
    ("–", "--"),  # noqa: RUF001
)
_COLORS = ("#4269d0", "#efb118", "#ff725c", "#6cc5b0", "#3ca951", "#ff8ab7", "#a463f2", "#97bbf5")
_WIDTH, _LEFT, _RIGHT, _LINE, _AXIS = 720.0, 220.0, 70.0, 24.0, 50.0
_STYLE = (
    "<style>text{font:12px sans-serif;fill:#333}.axis{stroke:#999}"
    "@media(prefers-color-scheme:dark){text{fill:#ddd}}</style>"
)
_MM, _CM = 1000.0, 100.0
_PAPER = (
    ("chamfer_dynamic_l1", "CD_dyn [mm]", _MM, 2),
    ("chamfer_phystwin", "CD_full [mm]", _MM, 2),
    ("track_error_phystwin", "Track [cm]", _CM, 2),
    ("iou", "IoU ↑", 1.0, 3),
    ("psnr", "PSNR ↑", 1.0, 2),
    ("lpips", "LPIPS", 1.0, 3),
)
_PROPER = (
    ("chamfer_dynamic_symmetric", "CD_dyn sym. [mm]", _MM, 2),
    ("chamfer_symmetric", "CD sym. [mm]", _MM, 2),
    ("chamfer_truth", "CD to truth [mm]", _MM, 2),
    ("track_error", "Track [mm]", _MM, 2),
    ("marker_error", "Markers [mm]", _MM, 2),
)
_PICTURES = (
    ("iou_proper", "IoU ↑", 1.0, 3),
    ("psnr_proper", "PSNR ↑", 1.0, 2),
    ("ssim_proper", "SSIM ↑", 1.0, 3),
    ("lpips_proper", "LPIPS", 1.0, 3),
)
_HELD_OUT = (
    ("iou_held_out", "IoU ↑", 1.0, 3),
    ("psnr_held_out", "PSNR ↑", 1.0, 2),
    ("ssim_held_out", "SSIM ↑", 1.0, 3),
    ("lpips_held_out", "LPIPS", 1.0, 3),
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
_FLOORED = ("chamfer_dynamic_l1", "chamfer_phystwin")
_CURVE = "track_error"
_NOTE = """\
Figures are means over sequences of the mean over frames of the mean over points; brackets hold the
95 % interval of a bootstrap over sequences, for which all methods are resampled together. Frame 0
is given and not scored. `rec.` are the frames that were fitted, `fut.` those that were held out. A
method without output scores as the static object, which touches nothing. The best figure of a
column is bold, and so is every one that prints the same; oracles do not count, and no figure is
bold where methods have different numbers of sequences, which `n` then tells. `±` is the standard
deviation over several seeds of the search, over which the figures of a sequence are then means.
CD_dyn and CD_full are one-way and in the L1 norm, as PhysTwin computes them; `sym.` is the
symmetric mean of Euclidean distances. PSNR, SSIM and IoU are of pictures of splats that were fitted
to frame 0 once for all methods and go along with the nodes of each. All data is synthetic: these
figures do not compare with those published on other data.
docs/evaluation.md explains the methods and protocols, docs/metrics.md every metric.
"""


@dataclass(frozen=True, kw_only=True)
class Score:
    """One figure of one case: a method on a sequence."""

    method: str
    """Name of the method."""
    case: str
    """Name of the sequence."""
    split: str
    """Frames or protocol that the figure covers."""
    metric: str
    """Name of the metric."""
    value: float
    """The figure, in metres where it is a length."""


@dataclass(frozen=True, kw_only=True)
class SuiteRow:
    """A method's mean over cases."""

    method: str
    """Name of the method."""
    split: str
    """Frames over which the figures are taken."""
    metric: str
    """Name of the metric."""
    mean: float
    """Mean over cases."""
    low: float
    """Lower end of the interval; the mean itself where there is one case."""
    high: float
    """Upper end of the interval."""
    n: int
    """Number of cases."""
    spread: float | None = None
    """Standard deviation of the mean over the seeds of a search; None if there are not several."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Difference between two methods on the cases that both have."""

    method: str
    """Name of the method."""
    against: str
    """The method that is subtracted."""
    split: str
    """Frames over which the figures are taken."""
    metric: str
    """Name of the metric."""
    difference: float
    """Mean over cases of the method's figure less the other's."""
    low: float
    """Lower end of the interval."""
    high: float
    """Upper end of the interval."""
    better: int
    """Cases in which the method is strictly better."""
    n: int
    """Cases that both have."""


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column of a printed table."""

    split: str
    """Which split it shows."""
    metric: str
    """Which metric it shows."""
    title: str
    """Heading, unit included."""
    factor: float = 1.0
    """Factor applied to figures, for example 1000 for millimetres."""
    digits: int = 2
    """Digits after the point."""


def write_report(
    about: Mapping[str, Any],
    rows: Sequence[SuiteRow],
    differences: Sequence[Difference],
    above: Sequence[Difference],
    cells: Sequence[Mapping[str, Any]],
) -> dict[str, str]:
    """Write a suite's results as text, tables and charts.

    Args:
        about: Description of the suite: ``title command methods oracles cases protocols settings
            seeds is_verification presets generators notes skipped missing environment``, and as
            ``seed_of`` the method of which others are one seed.
        rows: Means over sequences.
        differences: Paired comparisons with one method.
        above: The same with the true motion; empty if that is not among the methods.
        cells: One entry a cell: ``method case run error figures curves seconds`` and more.

    Returns:
        Content by file name: ``report.md``, ``tables.tex``, ``per_sequence.csv`` and charts.
    """
    hidden = about.get("seed_of", {})
    rows = [row for row in rows if row.method not in hidden]
    tables = tables_of(rows)
    charts = _charts(rows, cells)
    oracles = about["oracles"]
    mark = " (verification)" if about["is_verification"] else ""
    parts = [f"# {about['title']}{mark}", "", _intro(about), _NOTE]
    for title, columns in tables.items():
        parts += [f"## {title}{mark}", "", markdown_table(rows, columns, oracles)]
    if differences:
        parts += [f"## Compared with {differences[0].against}", "", _compared(differences, hidden)]
    if above:
        parts += ["## Above the floor", "", _above_the_floor(above, hidden)]
    if charts:
        parts += ["## Charts", "", *(f"![{file}]({file})" for file in charts), ""]
    if pictures := about.get("pictures"):
        parts += ["## Pictures", "", *(f"![{name}](charts/{name})" for name in pictures), ""]
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


def with_seed_means(scores: Iterable[Score], seed_of: Mapping[str, str]) -> list[Score]:
    """Add to methods that differ in the seed of their search the mean over these, case by case.

    A case counts if every seed has a figure of it. Means stand before the first of their seeds.

    Args:
        scores: Figures of all methods.
        seed_of: The method of which each is one seed.
    """
    given = list(scores)
    values: dict[tuple[str, str, str, str], dict[str, float]] = {}
    for score in given:
        if score.method in seed_of and np.isfinite(score.value):
            values.setdefault(_place(score, seed_of), {})[score.method] = score.value
    counts = Counter(seed_of.values())
    means: list[Score] = []
    for score in given:
        if score.method in seed_of:
            place = _place(score, seed_of)
            of_seeds = values.pop(place, {})
            if len(of_seeds) == counts[place[0]]:
                mean = sum(of_seeds.values()) / len(of_seeds)
                means.append(replace(score, method=place[0], value=mean))
        means.append(score)
    return means


def _place(score: Score, seed_of: Mapping[str, str]) -> tuple[str, str, str, str]:
    return seed_of[score.method], score.case, score.split, score.metric


def _spreads(
    grouped: Mapping[tuple[str, str, str], Mapping[str, float]], seed_of: Mapping[str, str]
) -> dict[tuple[str, str, str], float]:
    """Compute the deviation over seeds of the mean over those cases that all of them have."""
    means: dict[tuple[str, str, str], list[float]] = {}
    for (method, split, metric), cases in grouped.items():
        shared = grouped.get((seed_of.get(method, ""), split, metric))
        if shared:
            mean = sum(cases[case] for case in shared) / len(shared)
            means.setdefault((seed_of[method], split, metric), []).append(mean)
    return {key: float(np.std(m, ddof=1)) for key, m in means.items() if len(m) > 1}


def _intro(about: Mapping[str, Any]) -> str:
    cases, seed_of = about["cases"], about.get("seed_of", {})
    # All seeds of a method are described alike.
    methods = {seed_of.get(name, name): text for name, text in about["methods"].items()}
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


def tables_of(rows: Sequence[SuiteRow]) -> dict[str, list[Column]]:
    """List the tables that have figures, by title, in the order of the paper."""
    splits = list(dict.fromkeys(row.split for row in rows))
    tables: dict[str, list[Column]] = {
        "Reconstruction and future prediction": _both(_PAPER),
        "The same by proper metrics": _both(_PROPER),
        "Pictures in all views": _both(_PICTURES),
        "In the view that is held out": _both(_HELD_OUT),
        "Contact": _both(_CONTACT),
    }
    for kind, title in (("dense", "Dense contact"), ("point", "Point contact")):
        tables[title] = _both(_PAPER[:3] + _CONTACT[:1], f"/{kind}")
    for split, figures in _OTHER.items():
        tables[split.capitalize()] = _columns(split, "", figures)
    tables["Unseen interaction"] = _columns("unseen", "", _PAPER)
    for split in splits:
        name, slash, last = split.rpartition("/")
        if slash and last == "future":
            hands = _columns(f"{name}/hands", "", _OTHER["hands"])
            tables[name.replace("_", " ").capitalize()] = [
                *_both(_PAPER, before=f"{name}/"),
                *hands,
            ]
    times = [row.metric for row in rows if row.split == "runtime"]
    tables["Seconds for a video frame"] = [
        Column(
            split="runtime",
            metric=metric,
            title=metric.removeprefix("seconds_per_frame").strip("_").replace("_", " ") or "all",
        )
        for metric in dict.fromkeys(times)
    ]
    available = {(row.split, row.metric) for row in rows}
    return {
        title: columns
        for title, columns in tables.items()
        if any((column.split, column.metric) in available for column in columns)
    }


def _both(
    figures: Sequence[tuple[str, str, float, int]], after: str = "", before: str = ""
) -> list[Column]:
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


def _compared(differences: Sequence[Difference], hidden: Collection[str]) -> str:
    against = differences[0].against
    intro = f"Method less `{against}` on the same sequences [mm]; below zero is better."
    return _difference_table(intro, differences, _COMPARED, hidden)


def _above_the_floor(above: Sequence[Difference], hidden: Collection[str]) -> str:
    intro = (
        f"Method less `{above[0].against}` on the same sequences [mm]: the true motion, carried by "
        "the same nodes, has Chamfer distances too, which no fit can avoid."
    )
    return _difference_table(intro, above, _FLOORED, hidden)


def _difference_table(
    intro: str,
    differences: Sequence[Difference],
    metrics: Collection[str],
    hidden: Collection[str],
) -> str:
    lines = [
        intro,
        "",
        "| method | split | metric | difference | better in |",
        "| --- | --- | --- | ---: | ---: |",
    ]
    for entry in differences:
        if entry.metric in metrics and entry.split in _SPLITS and entry.method not in hidden:
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
    environment = about["environment"]
    packages = ", ".join(f"{name} {version}" for name, version in environment["packages"].items())
    settings = ", ".join(f"{name} = {value}" for name, value in about["settings"].items())
    origin = {"command": [about["command"] and f"`{about['command']}`"]} | {
        name: about[name] for name in ("seeds", "presets", "generators")
    }
    shared = about.get("at_once", 1)
    crowd = f", shared by {shared} cells at a time, so times are longer" if shared > 1 else ""
    return "\n".join(
        [
            *(
                f"* {name}: {', '.join(str(value) for value in values)}"
                for name, values in origin.items()
                if any(value != "" for value in values)
            ),
            f"* device: {environment['device']} {environment['device_name']}, "
            f"{environment['cpu_count']} processors{crowd}",
            f"* system: {environment['system']}, Python {environment['python']}",
            f"* commit: {environment['commit'] or 'not run from a checkout'}",
            f"* packages: {packages}",
            f"* settings that all methods share: {settings or 'none'}",
            f"* written: {environment['started']}",
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


def _charts(rows: Sequence[SuiteRow], cells: Sequence[Mapping[str, Any]]) -> dict[str, str]:
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


def summarise(scores: Iterable[Score], seed_of: Mapping[str, str] | None = None) -> list[SuiteRow]:
    """Average every metric of every method and split over its cases, in the order they come.

    Args:
        scores: Figures, with the means over seeds (`with_seed_means`) if there are any.
        seed_of: The method of which each is one seed; that one's rows then tell their spread.
    """
    rows: list[SuiteRow] = []
    grouped = _grouped(scores)
    spreads = _spreads(grouped, seed_of or {})
    for (method, split, metric), cases in grouped.items():
        value = np.array([cases[case] for case in sorted(cases)])
        low, high = interval(value)
        rows.append(
            SuiteRow(
                method=method,
                split=split,
                metric=metric,
                mean=float(value.mean()),
                low=low,
                high=high,
                n=len(value),
                spread=spreads.get((method, split, metric)),
            )
        )
    return rows


def compare(scores: Iterable[Score], against: str) -> list[Difference]:
    """Subtract one method's figures from those of every other, case by case."""
    grouped = _grouped(scores)
    differences: list[Difference] = []
    for (method, split, metric), cases in grouped.items():
        other = grouped.get((against, split, metric), {})
        shared = sorted(cases.keys() & other.keys())
        if method == against or not shared:
            continue
        value = np.array([cases[case] - other[case] for case in shared])
        low, high = interval(value)
        better = value > 0 if is_higher_better(metric) else value < 0
        differences.append(
            Difference(
                method=method,
                against=against,
                split=split,
                metric=metric,
                difference=float(value.mean()),
                low=low,
                high=high,
                better=int(better.sum()),
                n=len(shared),
            )
        )
    return differences


def is_higher_better(metric: str) -> bool:
    """Whether higher values of a metric are better; the others are distances or times."""
    return metric.startswith(_HIGHER)


def interval(value: Float[ndarray, " case"], resamples: int = RESAMPLES) -> tuple[float, float]:
    """Compute the percentile interval of the mean over cases; of one case it is that alone."""
    return _interval(np.asarray(value, np.float64).tobytes(), resamples)


@lru_cache(_ROWS)
def _interval(value: bytes, resamples: int) -> tuple[float, float]:
    """Compute an interval once, although tables are written again whenever a cell is finished."""
    tail = (1.0 - LEVEL) / 2.0
    mean = resampled_means(np.frombuffer(value, np.float64), resamples)
    low, high = np.quantile(mean, (tail, 1.0 - tail))
    return float(low), float(high)


def resampled_means(
    value: Float[ndarray, " case"], resamples: int = RESAMPLES
) -> Float[ndarray, " resample"]:
    """Average resamples of the cases, drawn with replacement from a fixed seed.

    The draw depends on the number of cases alone. Figures of several methods on the same cases are
    therefore resampled together: the bootstrap is paired.

    Raises:
        ValueError: If there is no case.
    """
    if len(value) == 0:
        raise ValueError("there is no case to resample")
    return value[_draw(len(value), resamples)].mean(axis=1)


@cache
def _draw(count: int, resamples: int) -> Int[ndarray, "resample case"]:
    """Draw cases; every row of a table asks for the same."""
    draw = np.random.default_rng([_SEED, count]).integers(count, size=(resamples, count))
    draw.flags.writeable = False
    return draw


def _grouped(scores: Iterable[Score]) -> dict[tuple[str, str, str], dict[str, float]]:
    grouped: dict[tuple[str, str, str], dict[str, float]] = {}
    for score in scores:
        if np.isfinite(score.value):
            key = (score.method, score.split, score.metric)
            grouped.setdefault(key, {})[score.case] = score.value
    return grouped


def to_csv(
    rows: Sequence[SuiteRow] | Sequence[Difference], columns: tuple[str, ...] = SUITE_COLUMNS
) -> str:
    """Write rows as comma-separated values with a header; numbers keep 7 digits."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        cells = [getattr(row, column) for column in columns]
        writer.writerow([f"{c:.7g}" if isinstance(c, float) else c for c in cells])
    return stream.getvalue()


def read_rows(text: str) -> list[SuiteRow]:
    """Read rows that `to_csv` wrote.

    Raises:
        ValueError: If the columns are others, or a number is not one.
    """
    try:
        table = list(csv.reader(io.StringIO(text)))
    except csv.Error as error:
        raise ValueError(str(error)) from None
    if not table or tuple(table[0]) not in (SUITE_COLUMNS, SEED_COLUMNS):
        raise ValueError(f"the columns must be {', '.join(SUITE_COLUMNS)}")
    rows: list[SuiteRow] = []
    for line, cells in enumerate(table[1:], 2):
        if len(cells) != len(table[0]):
            raise ValueError(f"line {line} has {len(cells)} cells instead of {len(table[0])}")
        method, split, metric, mean, low, high, n, *spread = cells
        rows.append(
            SuiteRow(
                method=method,
                split=split,
                metric=metric,
                mean=float(mean),
                low=float(low),
                high=float(high),
                n=int(n),
                spread=float(spread[0]) if any(spread) else None,
            )
        )
    return rows


def markdown_table(
    rows: Sequence[SuiteRow], columns: Sequence[Column], unranked: Collection[str] = ()
) -> str:
    """Write methods against columns as Markdown, with intervals; the best figure is bold."""
    head, *body = laid_out(rows, columns, "**{}**", unranked)
    lines = [[text.replace("|", "\\|") for text in line] for line in (head, *body)]
    lines.insert(1, ["---"] + ["---:"] * (len(head) - 1))
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def latex_table(
    rows: Sequence[SuiteRow], columns: Sequence[Column], unranked: Collection[str] = ()
) -> str:
    """Write methods against columns as a booktabs ``tabular``; the best figure is bold."""
    # Placeholders become the LaTeX command only after escaping, which would break it.
    head, *body = laid_out(rows, columns, "\x00{}\x01", unranked)
    lines = [" & ".join(_escaped(text) for text in line) + " \\\\\n" for line in (head, *body)]
    kinds = "l" + "r" * (len(head) - 1)
    return (
        f"\\begin{{tabular}}{{{kinds}}}\n\\toprule\n{lines[0]}\\midrule\n"
        f"{''.join(lines[1:])}\\bottomrule\n\\end{{tabular}}\n"
    )


def laid_out(
    rows: Sequence[SuiteRow],
    columns: Sequence[Column],
    best: str = "{}",
    unranked: Collection[str] = (),
) -> list[list[str]]:
    """Arrange rows as lines of texts: a head, then one line a method in the order of the rows.

    All methods that print the best figure are best, unless all print it. Where methods have figures
    of different numbers of cases, the number stands beside each of them and none is best: a mean
    without the hard cases is no better.

    Args:
        rows: Means over cases.
        columns: What is shown; columns for which no method has a figure are left out.
        best: Format of the best figure of a column, with ``{}`` for the figure.
        unranked: Methods that are never best, and that others need not beat.
    """
    row_of = {(row.method, row.split, row.metric): row for row in rows}
    methods = list(dict.fromkeys(row.method for row in rows))
    shown = [c for c in columns if any((m, c.split, c.metric) in row_of for m in methods)]
    methods = [m for m in methods if any((m, c.split, c.metric) in row_of for c in shown)]
    lines = [["method", *(column.title for column in shown)], *([method] for method in methods)]
    for column in shown:
        column_rows = [row_of.get((method, column.split, column.metric)) for method in methods]
        texts = _column(column_rows, column, best, unranked)
        for line, text in zip(lines[1:], texts, strict=True):
            line.append(text)
    return lines


def _column(
    rows: Sequence[SuiteRow | None], column: Column, best: str, unranked: Collection[str]
) -> list[str]:
    rivals = [row for row in rows if row is not None and row.method not in unranked]
    pick = max if is_higher_better(column.metric) else min
    printed = {_printed(row.mean, column) for row in rivals}
    is_ranked = len(printed) > 1 and len({row.n for row in rivals}) == 1
    winner = _printed(pick(row.mean for row in rivals), column) if is_ranked else None
    is_uneven = len({row.n for row in rows if row is not None}) > 1
    texts: list[str] = []
    for row in rows:
        if row is None:
            texts.append(_NONE)
            continue
        low, mean, high = (_printed(value, column) for value in (row.low, row.mean, row.high))
        is_best = mean == winner and row.method not in unranked
        parts = [best.format(mean) if is_best else mean]
        parts += (
            [f"± {row.spread * column.factor:.{column.digits}f}"] if row.spread is not None else []
        )
        parts += [f"[{low}, {high}]"] if row.n > 1 else []
        parts += [f"(n = {row.n})"] if is_uneven else []
        texts.append(" ".join(parts))
    return texts


def _printed(value: float, column: Column) -> str:
    return f"{value * column.factor:.{column.digits}f}"


def _escaped(text: str) -> str:
    for plain, escaped in _LATEX:
        text = text.replace(plain, escaped)
    return text.replace("\x00", "\\textbf{").replace("\x01", "}")


def bar_chart(title: str, bars: Sequence[tuple[str, float, float, float]]) -> str:
    """Draw one bar a method with the ends of its interval.

    Args:
        title: What is shown, unit included.
        bars: For each method its name, its mean, and the low and high end of its interval.
    """
    height = _LINE * (len(bars) + 2)
    most = max([high for *_, high in bars] + [mean for _, mean, *_ in bars]) or 1.0
    scale = (_WIDTH - _LEFT - _RIGHT) / most
    parts: list[str] = []
    for number, (name, mean, low, high) in enumerate(bars):
        y = _LINE * (number + 1.6)
        end, middle = _LEFT + scale * mean, y + 7
        parts += [
            _text(_LEFT - 8, y + 11, name, anchor="end"),
            f'<rect x="{_LEFT}" y="{y:.1f}" width="{scale * mean:.1f}" height="14" '
            f'fill="{_COLORS[number % len(_COLORS)]}"/>',
            _segment(_LEFT + scale * low, middle, _LEFT + scale * high, middle),
            _text(max(end, _LEFT + scale * high) + 6, y + 11, f"{mean:.2f}"),
        ]
    return _drawing(title, height, parts)


def line_chart(title: str, lines: Mapping[str, Sequence[float | None]]) -> str:
    """Draw one line a method over the frames; where a value is unknown the line is broken.

    Args:
        title: What is shown, unit included.
        lines: For each method its values, frame by frame.
    """
    top, bottom = 40.0, 240.0
    values = [value for line in lines.values() for value in line if value is not None]
    most = max(values, default=0.0) or 1.0
    count = max(len(line) for line in lines.values())
    across = (_WIDTH - _AXIS - _LEFT) / max(1, count - 1)
    parts = [
        _segment(_AXIS, bottom, _WIDTH - _LEFT, bottom),
        _segment(_AXIS, top, _AXIS, bottom),
        _text(_AXIS - 6, top + 4, f"{most:.3g}", anchor="end"),
        _text(_AXIS - 6, bottom + 4, "0", anchor="end"),
        _text(_WIDTH - _LEFT, bottom + 18, f"frame {count - 1}", anchor="end"),
    ]
    for number, (name, line) in enumerate(lines.items()):
        color = _COLORS[number % len(_COLORS)]
        pen, path = "M", ""
        for frame, value in enumerate(line):
            if value is None:
                pen = "M"
                continue
            x, y = _AXIS + across * frame, bottom - (bottom - top) * value / most
            path += f"{pen}{x:.1f} {y:.1f}"
            pen = "L"
        parts.append(f'<path d="{path}" fill="none" stroke="{color}" stroke-width="1.6"/>')
        at = top + 18 * number
        parts.append(
            f'<rect x="{_WIDTH - _LEFT + 12}" y="{at}" width="10" height="10" fill="{color}"/>'
        )
        parts.append(_text(_WIDTH - _LEFT + 28, at + 10, name))
    return _drawing(title, max(bottom + 30, top + 18 * len(lines)), parts)


def _drawing(title: str, height: float, parts: Sequence[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH:g} {height:g}" '
        f'role="img" aria-label="{escape(title, {chr(34): "&quot;"})}">{_STYLE}'
        f"{_text(8.0, 16.0, title)}{''.join(parts)}</svg>\n"
    )


def _text(x: float, y: float, text: str, *, anchor: str = "start") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _segment(x0: float, y0: float, x1: float, y1: float) -> str:
    return f'<line class="axis" x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"/>'
