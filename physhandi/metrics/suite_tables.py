"""Tables over many cases: means with paired bootstrap intervals, and their CSV."""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

COLUMNS = ("method", "split", "metric", "mean", "low", "high", "n")
"""Columns of ``table.csv``."""
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
_HIGHER = ("iou", "psnr", "contact_accuracy", "contact_f1")


@dataclass(frozen=True, kw_only=True)
class Score:
    """One figure of one case: a method on a sequence."""

    method: str
    """Name of the method."""
    case: str
    """Name of the sequence."""
    split: str
    """What the figure is taken over."""
    metric: str
    """Name of the metric."""
    value: float
    """The figure, in metres where it is a length."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A method's mean over cases."""

    method: str
    """Name of the method."""
    split: str
    """What the figures are taken over."""
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


@dataclass(frozen=True, kw_only=True)
class Difference:
    """How much a method's figures differ from another one's on the cases that both have."""

    method: str
    """Name of the method."""
    against: str
    """The method that is subtracted."""
    split: str
    """What the figures are taken over."""
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


def is_higher_better(metric: str) -> bool:
    """Tell whether more of a metric is better; all others are distances or times."""
    return metric.startswith(_HIGHER)


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
    draw = np.random.default_rng([_SEED, len(value)]).integers(
        len(value), size=(resamples, len(value))
    )
    return value[draw].mean(axis=1)


def interval(value: Float[ndarray, " case"], resamples: int = RESAMPLES) -> tuple[float, float]:
    """Give the percentile interval of the mean over cases."""
    tail = (1.0 - LEVEL) / 2.0
    low, high = np.quantile(resampled_means(value, resamples), (tail, 1.0 - tail))
    return float(low), float(high)


def summarise(scores: Iterable[Score]) -> list[Row]:
    """Average every metric of every method and split over its cases, in the order they come."""
    rows: list[Row] = []
    for (method, split, metric), cases in _grouped(scores).items():
        value = np.array([cases[case] for case in sorted(cases)])
        low, high = interval(value)
        rows.append(
            Row(
                method=method,
                split=split,
                metric=metric,
                mean=float(value.mean()),
                low=low,
                high=high,
                n=len(value),
            )
        )
    return rows


def compare(scores: Iterable[Score], against: str) -> list[Difference]:
    """Subtract one method's figures from those of every other, case by case."""
    grouped = _grouped(scores)
    found: list[Difference] = []
    for (method, split, metric), cases in grouped.items():
        other = grouped.get((against, split, metric), {})
        shared = sorted(cases.keys() & other.keys())
        if method == against or not shared:
            continue
        value = np.array([cases[case] - other[case] for case in shared])
        low, high = interval(value)
        better = value > 0 if is_higher_better(metric) else value < 0
        found.append(
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
    return found


def to_csv(rows: Sequence[Row] | Sequence[Difference], columns: tuple[str, ...] = COLUMNS) -> str:
    """Write rows as comma-separated values with a header; numbers keep 7 digits."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        cells = [getattr(row, column) for column in columns]
        writer.writerow([f"{c:.7g}" if isinstance(c, float) else c for c in cells])
    return stream.getvalue()


def read_rows(text: str) -> list[Row]:
    """Read back what `to_csv` wrote of rows.

    Raises:
        ValueError: If the columns are others, or a number is not one.
    """
    table = list(csv.reader(io.StringIO(text)))
    if not table or tuple(table[0]) != COLUMNS:
        raise ValueError(f"the columns must be {', '.join(COLUMNS)}")
    rows: list[Row] = []
    for line, cells in enumerate(table[1:], 2):
        if len(cells) != len(COLUMNS):
            raise ValueError(f"line {line} has {len(cells)} cells instead of {len(COLUMNS)}")
        method, split, metric, mean, low, high, n = cells
        rows.append(
            Row(
                method=method,
                split=split,
                metric=metric,
                mean=float(mean),
                low=float(low),
                high=float(high),
                n=int(n),
            )
        )
    return rows


def _grouped(scores: Iterable[Score]) -> dict[tuple[str, str, str], dict[str, float]]:
    grouped: dict[tuple[str, str, str], dict[str, float]] = {}
    for score in scores:
        if np.isfinite(score.value):
            key = (score.method, score.split, score.metric)
            grouped.setdefault(key, {})[score.case] = score.value
    return grouped
