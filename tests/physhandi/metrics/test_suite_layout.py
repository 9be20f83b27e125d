"""Tables as people read them."""

import re
from dataclasses import replace

from physhandi.metrics.suite_report import (
    Column,
    SuiteRow,
    bar_chart,
    laid_out,
    latex_table,
    line_chart,
    markdown_table,
)

SHOWN = (
    Column(split="future", metric="track_error", title="Track [mm]", factor=1000.0),
    Column(split="future", metric="iou", title="IoU ↑", digits=3),
    Column(split="future", metric="psnr", title="PSNR ↑"),
)


def row(method: str, metric: str, mean: float, n: int = 3) -> SuiteRow:
    return SuiteRow(
        method=method, split="future", metric=metric, mean=mean, low=mean / 2, high=2 * mean, n=n
    )


ROWS = [
    row("static", "track_error", 0.02),
    row("last_residual", "track_error", 0.01),
    row("static", "iou", 0.5),
    row("last_residual", "iou", 0.75),
    row("elsewhere", "rrd_object", 0.1),
]


def test_lines_hold_figures_in_the_units_of_their_column() -> None:
    assert laid_out(ROWS, SHOWN, "<{}>") == [
        ["method", "Track [mm]", "IoU ↑"],
        ["static", "20.00 [10.00, 40.00]", "0.500 [0.250, 1.000]"],
        ["last_residual", "<10.00> [5.00, 20.00]", "<0.750> [0.375, 1.500]"],
    ]


def test_a_spread_over_seeds_stands_beside_the_mean() -> None:
    rows = [replace(row("a", "track_error", 0.01), spread=0.0015), row("b", "track_error", 0.02)]
    lines = laid_out(rows, SHOWN[:1], "<{}>")
    assert lines[1][1] == "<10.00> ± 1.50 [5.00, 20.00]"
    assert lines[2][1] == "20.00 [10.00, 40.00]"
    assert "$\\pm$ 1.50" in latex_table(rows, SHOWN[:1])


def test_a_mean_without_the_hard_cases_is_not_best_and_tells_its_number() -> None:
    rows = [row("a", "iou", 0.9, n=1), row("b", "iou", 0.5), row("c", "iou", 0.4)]
    lines = laid_out(rows, SHOWN[1:2], "<{}>")
    assert [line[1] for line in lines[1:]] == [
        "0.900 (n = 1)",
        "0.500 [0.250, 1.000] (n = 3)",
        "0.400 [0.200, 0.800] (n = 3)",
    ]


def test_what_prints_the_best_figure_is_best_too() -> None:
    rows = [row("a", "iou", 0.70011), row("b", "iou", 0.70012), row("c", "iou", 0.6)]
    lines = laid_out(rows, SHOWN[1:2], "<{}>")
    assert [line[1].startswith("<0.700>") for line in lines[1:]] == [True, True, False]
    assert "<" not in str(laid_out(rows[:2], SHOWN[1:2], "<{}>"))


def test_an_oracle_is_never_best_and_need_not_be_beaten() -> None:
    rows = [row("oracle", "iou", 0.9, n=2), row("a", "iou", 0.5), row("b", "iou", 0.4)]
    lines = laid_out(rows, SHOWN[1:2], "<{}>", {"oracle"})
    assert [line[1].startswith("<") for line in lines[1:]] == [False, True, False]
    assert "**0.500**" in markdown_table(rows, SHOWN[1:2], {"oracle"})
    assert "textbf{0.500}" in latex_table(rows, SHOWN[1:2], {"oracle"})


def test_a_missing_figure_is_a_dash_and_one_method_alone_is_not_best() -> None:
    lines = laid_out([row("a", "iou", 0.5), row("b", "track_error", 0.1)], SHOWN, "<{}>")
    assert lines[1][1] == lines[2][2] == "\N{EN DASH}"
    assert "<" not in str(lines)


def test_markdown_has_as_many_cells_in_every_line() -> None:
    lines = markdown_table(ROWS, SHOWN).splitlines()
    assert len(lines) == 4
    assert {line.count("|") for line in lines} == {4}
    assert "**10.00**" in lines[3]


def test_latex_escapes_names_and_counts_its_columns() -> None:
    text = latex_table(ROWS, SHOWN)
    assert text.startswith("\\begin{tabular}{lrr}\n")
    assert (
        "last\\_residual & \\textbf{10.00} [5.00, 20.00] & \\textbf{0.750} [0.375, 1.500] \\\\\n"
        in text
    )
    assert "IoU $\\uparrow$" in text


def test_bars_are_as_long_as_their_figures() -> None:
    chart = bar_chart("CD <b>", [("a", 2.0, 1.0, 4.0), ("b", 4.0, 3.0, 4.0)])
    first, second = (float(width) for width in re.findall(r'<rect [^>]*width="([\d.]+)"', chart))
    assert 0 < first < second
    assert abs(second / first - 2) < 0.01
    assert "CD &lt;b&gt;" in chart
    assert "<b>" not in chart


def test_a_line_is_broken_where_nothing_is_known() -> None:
    chart = line_chart("error", {"a": [0.0, 1.0, None, 2.0, 1.0], "b": [0.5]})
    first, second = re.findall(r'<path d="([^"]*)"', chart)
    assert first.count("M") == 2
    assert first.count("L") == 2
    assert second.count("M") == 1
    heights = [float(y) for y in re.findall(r"[ML][\d.]+ ([\d.]+)", first)]
    assert heights[0] == 240.0  # zero is the lowest
    assert heights[2] == 40.0 < heights[1]
