"""Tables as people read them, methods against metrics, in Markdown and LaTeX."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from physhandi.metrics.suite_tables import Row, is_higher_better

_NONE = "–"  # noqa: RUF001  # a dash, as tables have it
_LATEX = (
    ("\\", "\\textbackslash{}"),
    *((sign, f"\\{sign}") for sign in "_%&#$"),
    ("δ", "$\\delta$"),
    ("×", "$\\times$"),  # noqa: RUF001
    ("↑", "$\\uparrow$"),
    ("–", "--"),  # noqa: RUF001
)


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column of a printed table."""

    split: str
    """Which split it shows."""
    metric: str
    """Which metric it shows."""
    title: str
    """What stands above it, unit included."""
    factor: float = 1.0
    """What figures are multiplied by, for example 1000 for millimetres."""
    digits: int = 2
    """Digits after the point."""


def markdown_table(
    rows: Sequence[Row], columns: Sequence[Column], unranked: Collection[str] = ()
) -> str:
    """Lay methods out against columns, with intervals; the best of a column is bold."""
    head, *body = laid_out(rows, columns, "**{}**", unranked)
    lines = [[text.replace("|", "\\|") for text in line] for line in (head, *body)]
    lines.insert(1, ["---"] + ["---:"] * (len(head) - 1))
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def latex_table(
    rows: Sequence[Row], columns: Sequence[Column], unranked: Collection[str] = ()
) -> str:
    """Lay methods out against columns as a ``tabular`` of booktabs; the best is bold."""
    # The command is put in after escaping, which would break it.
    head, *body = laid_out(rows, columns, "\x00{}\x01", unranked)
    lines = [" & ".join(_escaped(text) for text in line) + " \\\\\n" for line in (head, *body)]
    kinds = "l" + "r" * (len(head) - 1)
    return (
        f"\\begin{{tabular}}{{{kinds}}}\n\\toprule\n{lines[0]}\\midrule\n"
        f"{''.join(lines[1:])}\\bottomrule\n\\end{{tabular}}\n"
    )


def laid_out(
    rows: Sequence[Row],
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
        best: How the best figure of a column is set, with ``{}`` where it goes.
        unranked: Methods that are never best, and that others need not beat.
    """
    found = {(row.method, row.split, row.metric): row for row in rows}
    methods = list(dict.fromkeys(row.method for row in rows))
    shown = [c for c in columns if any((m, c.split, c.metric) in found for m in methods)]
    methods = [m for m in methods if any((m, c.split, c.metric) in found for c in shown)]
    lines = [["method", *(column.title for column in shown)], *([method] for method in methods)]
    for column in shown:
        given = [found.get((method, column.split, column.metric)) for method in methods]
        texts = _column(given, column, best, unranked)
        for line, text in zip(lines[1:], texts, strict=True):
            line.append(text)
    return lines


def _column(
    rows: Sequence[Row | None], column: Column, best: str, unranked: Collection[str]
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
