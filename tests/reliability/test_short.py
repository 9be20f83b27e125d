"""The short form of every case."""

import pickle
from pathlib import Path

import pytest

from reliability import Counts, all_cases, faults_of
from reliability.__main__ import merged, row_of, short

CASES = all_cases()


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.short])
def test_nothing_goes_wrong(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
    case = CASES[name]
    report = case.run(case.short, tmp_path)
    assert faults_of(case.short, report) == [], report


def test_a_case_that_finds_faults_or_does_too_little_is_told() -> None:
    assert faults_of(3, {"done": 3, "lost": 0}) == []
    assert faults_of(3, {"done": 2, "lost": 1}) == ["lost: 1", "done 2 of 3"]
    assert "looked for none" in faults_of(3, {"done": 3})[0]


def test_what_was_found_is_kept_in_the_row_of_its_case() -> None:
    counts = Counts("wrong", "lost")
    counts.require(True, "all is well")
    counts.require(False, "GET /x was\nanswered by 500 | expected 200 " + "x" * 1000)
    sent = pickle.loads(pickle.dumps(counts))  # noqa: S301 - as from a process of ours
    assert (sent, sent.findings) == ({"wrong": 1, "lost": 0}, counts.findings)
    faults = faults_of(1, sent | {"done": 1})
    row = row_of("R18", CASES["R18"], sent, 7.2, [*faults, *map(short, sent.findings)], "here")
    begin, _, end = row.partition("| wrong 1, lost 0 | wrong: 1; GET /x was answered by 500 ")
    assert begin.startswith("| R18 | A server")
    assert end.startswith(r"\| expected 200 xxx")
    assert end.endswith("x… | 7 | here |")
    assert len(end) < 320


def test_rows_that_are_not_measured_again_stay_on_the_page() -> None:
    page = "# Title\n\n| case |\n| --- |\n| R2 | kept |\n| R10 | old |\n| R19 nodes | kept |\n"
    assert merged(page, {"R10": "| R10 | new |", "R7b": "| R7b | new |"}) == (
        "| R2 | kept |\n| R7b | new |\n| R10 | new |\n| R19 nodes | kept |\n"
    )
