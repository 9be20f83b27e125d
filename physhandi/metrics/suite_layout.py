"""Tables as people read them, methods against metrics, in Markdown and LaTeX."""

from collections.abc import Sequence
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


def markdown_table(rows: Sequence[Row], columns: Sequence[Column]) -> str:
    """Lay methods out against columns, with intervals; the best of a column is bold."""
    head, *body = laid_out(rows, columns, "**{}**")
    lines = [[text.replace("|", "\\|") for text in line] for line in (head, *body)]
    lines.insert(1, ["---"] + ["---:"] * (len(head) - 1))
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def latex_table(rows: Sequence[Row], columns: Sequence[Column]) -> str:
    """Lay methods out against columns as a ``tabular`` of booktabs; the best is bold."""
    # The command is put in after escaping, which would break it.
    head, *body = laid_out(rows, columns, "\x00{}\x01")
    lines = [" & ".join(_escaped(text) for text in line) + " \\\\\n" for line in (head, *body)]
    kinds = "l" + "r" * (len(head) - 1)
    return (
        f"\\begin{{tabular}}{{{kinds}}}\n\\toprule\n{lines[0]}\\midrule\n"
        f"{''.join(lines[1:])}\\bottomrule\n\\end{{tabular}}\n"
    )


def laid_out(rows: Sequence[Row], columns: Sequence[Column], best: str = "{}") -> list[list[str]]:
    """Arrange rows as lines of texts: a head, then one line a method in the order of the rows.

    Args:
        rows: Means over cases.
        columns: What is shown; columns for which no method has a figure are left out.
        best: How the best figure of a column is set, with ``{}`` where it goes.
    """
    found = {(row.method, row.split, row.metric): row for row in rows}
    methods = list(dict.fromkeys(row.method for row in rows))
    shown = [c for c in columns if any((m, c.split, c.metric) in found for m in methods)]
    methods = [m for m in methods if any((m, c.split, c.metric) in found for c in shown)]
    lines = [["method", *(column.title for column in shown)]]
    for method in methods:
        line = [method]
        for column in shown:
            row = found.get((method, column.split, column.metric))
            rivals = [r for m in methods if (r := found.get((m, column.split, column.metric)))]
            line.append(_NONE if row is None else _cell(row, column, rivals, best))
        lines.append(line)
    return lines


def _cell(row: Row, column: Column, rivals: Sequence[Row], best: str) -> str:
    low, mean, high = (
        f"{value * column.factor:.{column.digits}f}" for value in (row.low, row.mean, row.high)
    )
    pick = max if is_higher_better(column.metric) else min
    is_best = len(rivals) > 1 and row.mean == pick(rival.mean for rival in rivals)
    shown = best.format(mean) if is_best else mean
    return f"{shown} [{low}, {high}]" if row.n > 1 else shown


def _escaped(text: str) -> str:
    for plain, escaped in _LATEX:
        text = text.replace(plain, escaped)
    return text.replace("\x00", "\\textbf{").replace("\x01", "}")
