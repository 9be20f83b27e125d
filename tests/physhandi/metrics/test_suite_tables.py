"""Means over cases and their intervals, against hand-made figures, SciPy and all resamples."""

import csv
import io
from itertools import product

import numpy as np
import pytest

from physhandi.metrics.suite_report import (
    PAIRED_COLUMNS,
    SEED_COLUMNS,
    SUITE_COLUMNS,
    Score,
    compare,
    interval,
    read_rows,
    resampled_means,
    summarise,
    to_csv,
    with_seed_means,
)


def score(method: str, case: str, value: float, metric: str = "track_error") -> Score:
    return Score(method=method, case=case, split="future", metric=metric, value=value)


def test_the_interval_is_that_of_scipy() -> None:
    from scipy.stats import bootstrap  # Half a second, which processes without this test spare.

    value = np.random.default_rng(3).gamma(2.0, 5.0, 12)
    low, high = interval(value, 20_000)
    other = bootstrap(
        (value,), np.mean, n_resamples=20_000, method="percentile", random_state=0
    ).confidence_interval
    assert low == pytest.approx(other.low, rel=0.02)
    assert high == pytest.approx(other.high, rel=0.02)
    assert high - low > 3.0


def test_three_cases_have_the_means_of_their_27_resamples() -> None:
    value = np.array([1.0, 2.0, 6.0])
    known = {round(float(np.mean(draw)), 9) for draw in product(value, repeat=3)}
    drawn = resampled_means(value, 4000)
    assert {round(float(mean), 9) for mean in drawn} == known
    assert (drawn == 1.0).mean() == pytest.approx(1 / 27, abs=0.01)


def test_rows_keep_their_order_and_say_how_many_cases_they_hold() -> None:
    rows = summarise(
        [score("b", "x", 3.0), score("a", "x", 1.0), score("b", "y", 5.0), score("b", "z", np.nan)]
    )
    assert [(row.method, row.mean, row.n) for row in rows] == [("b", 4.0, 2), ("a", 1.0, 1)]
    assert (rows[0].low, rows[0].high) == (3.0, 5.0)
    assert rows[1].low == rows[1].high == 1.0


def test_a_difference_is_paired_by_case_so_that_hard_cases_cancel() -> None:
    hard = {"x": 1.0, "y": 50.0, "z": 200.0}
    base = [score("base", case, value) for case, value in hard.items()]
    ours = [score("ours", case, value - 2.0) for case, value in hard.items()]
    (found,) = compare([*base, *ours, score("ours", "alone", 9.0)], "base")
    assert (found.difference, found.low, found.high) == pytest.approx((-2.0, -2.0, -2.0))
    assert (found.better, found.n) == (3, 3)
    rows = summarise([*base, *ours])
    assert rows[0].high - rows[0].low > 50


def test_shares_are_better_when_they_are_higher() -> None:
    figures = [("base", 0.8), ("ours", 0.9)]
    for metric, better in (("contact_f1_5mm", 1), ("psnr", 1), ("iou", 1), ("lpips", 0)):
        (found,) = compare([score(m, "x", v, metric) for m, v in figures], "base")
        assert found.difference == pytest.approx(0.1)
        assert found.better == better


def test_the_table_has_the_agreed_columns_and_is_read_back() -> None:
    rows = summarise([score("a@x=1,y=2", "x", 0.0123456789), score("a@x=1,y=2", "y", 0.5)])
    text = to_csv(rows)
    assert text.splitlines()[0] == "method,split,metric,mean,low,high,n" == ",".join(SUITE_COLUMNS)
    (line,) = csv.DictReader(io.StringIO(text))
    assert line["method"] == "a@x=1,y=2"
    assert float(line["mean"]) == pytest.approx(0.25617284, rel=1e-6)
    (again,) = read_rows(text)
    assert (again.n, again.metric) == (2, "track_error")
    assert again.low == pytest.approx(rows[0].low, rel=1e-6)
    assert again.spread is None


def test_seeds_of_a_search_become_a_mean_with_its_spread() -> None:
    figures = {"x": (1.0, 2.0, 6.0), "y": (10.0, 20.0, 30.0)}
    scores = [score("static", "x", 9.0)]
    scores += [
        score(f"ours@seed={seed}", case, value)
        for case, values in figures.items()
        for seed, value in enumerate(values)
    ]
    scores.append(score("ours@seed=0", "z", 5.0))  # One seed alone has it.
    seed_of = {f"ours@seed={seed}": "ours" for seed in range(3)}
    means = with_seed_means(scores, seed_of)
    assert [one for one in means if one.method != "ours"] == scores
    rows = {row.method: row for row in summarise(means, seed_of)}
    assert list(rows) == ["static", "ours", *seed_of]
    ours = rows["ours"]
    assert (ours.mean, ours.low, ours.high, ours.n) == (11.5, 3.0, 20.0, 2)
    # Means over the sequences are 5.5, 11 and 18.
    assert ours.spread == pytest.approx(np.std([5.5, 11.0, 18.0], ddof=1))
    assert rows["static"].spread is rows["ours@seed=1"].spread is None
    text = to_csv(list(rows.values()), SEED_COLUMNS)
    assert text.splitlines()[0].endswith(",n,spread")
    again = {row.method: row for row in read_rows(text)}
    assert again["ours"].spread == pytest.approx(ours.spread, rel=1e-6)
    assert again["static"] == rows["static"]
    against = {one.method: one.difference for one in compare(means, "ours")}
    assert against["ours@seed=2"] == pytest.approx(18.0 - 11.5)


def test_one_seed_alone_has_no_spread() -> None:
    seed_of = {"ours@seed=7": "ours"}
    means = with_seed_means([score("ours@seed=7", "x", 2.0)], seed_of)
    assert [(r.method, r.mean, r.spread) for r in summarise(means, seed_of)] == [
        ("ours", 2.0, None),
        ("ours@seed=7", 2.0, None),
    ]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "columns"),
        ("method,mean\n", "columns"),
        (",".join(SUITE_COLUMNS) + "\na,b,c,1,2\n", "line 2 has 5"),
        (",".join(SUITE_COLUMNS) + "\na,b,c,one,2,3,4\n", "one"),
        (",".join(SEED_COLUMNS) + "\na,b,c,1,2,3,4\n", "line 2 has 7 cells instead of 8"),
        (",".join(SEED_COLUMNS) + "\na,b,c,1,2,3,4,some\n", "some"),
    ],
)
def test_a_damaged_table_is_refused(text: str, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        read_rows(text)


def test_paired_columns_are_fields() -> None:
    found = compare([score("base", "x", 2.0), score("a", "x", 1.0)], "base")
    line = to_csv(found, PAIRED_COLUMNS).splitlines()[1]
    assert line == "a,base,future,track_error,-1,-1,-1,1,1"


def test_no_case_has_no_mean() -> None:
    with pytest.raises(ValueError, match="no case"):
        interval(np.zeros(0))
