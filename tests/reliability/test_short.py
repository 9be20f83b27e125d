"""The short form of every case."""

from pathlib import Path

import pytest

from reliability import all_cases, faults_of
from reliability.__main__ import merged

CASES = all_cases()


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


def test_rows_that_are_not_measured_again_stay_on_the_page() -> None:
    page = "# Title\n\n| case |\n| --- |\n| R2 | kept |\n| R10 | old |\n| R19 nodes | kept |\n"
    assert merged(page, {"R10": "| R10 | new |", "R7b": "| R7b | new |"}) == (
        "| R2 | kept |\n| R7b | new |\n| R10 | new |\n| R19 nodes | kept |\n"
    )
