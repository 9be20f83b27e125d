"""The log of a run as a browser sees it."""

from pathlib import Path

import pytest

from app.jobs import log as log_module
from app.jobs.log import level_of, read_log

TRACE = (
    "2026-01-01 10:00:00,000 ERROR run x stopped by a defect\n"
    "Traceback (most recent call last):\n"
    '  File "/home/someone/physhandi/pipeline.py", line 3, in run\n'
    "    values[key]\n"
    "KeyError: 'node'\n"
    "\n"
    "During handling of the above exception, another exception occurred:\n"
    "\n"
    "Traceback (most recent call last):\n"
    '  File "/home/someone/physhandi/other.py", line 9, in run\n'
    "ValueError: no node\n"
)


def write(folder: Path, text: str) -> None:
    (folder / "log.txt").write_text(text)


def test_a_traceback_is_folded_into_what_went_wrong(tmp_path: Path) -> None:
    write(tmp_path, "begin\n" + TRACE + "end\n")
    part = read_log(tmp_path)
    assert part.text.split("\n") == [
        "begin",
        "2026-01-01 10:00:00,000 ERROR run x stopped by a defect",
        "KeyError: 'node'",
        "",
        "",
        "ValueError: no node",
        "end",
        "",
    ]
    assert part.end == (tmp_path / "log.txt").stat().st_size
    assert part.is_whole


@pytest.mark.parametrize("cut", range(0, len(TRACE) + 10, 7))
def test_a_log_read_in_two_parts_is_the_log_read_at_once(tmp_path: Path, cut: int) -> None:
    whole = "begin ü\n" + TRACE + "end\n"
    content = whole.encode()
    write(tmp_path, whole)
    expected = read_log(tmp_path).text
    (tmp_path / "log.txt").write_bytes(content[:cut])
    first = read_log(tmp_path, 0, is_ended=False)
    assert "File" not in first.text
    (tmp_path / "log.txt").write_bytes(content)
    second = read_log(tmp_path, first.end, is_ended=False)
    assert first.text + second.text == expected


def test_an_unfinished_line_waits_unless_nothing_more_comes(tmp_path: Path) -> None:
    write(tmp_path, "one\ntwo")
    assert read_log(tmp_path, 0, is_ended=False).text == "one\n"
    assert read_log(tmp_path, 4, is_ended=False).text == ""
    assert read_log(tmp_path, 4).text == "two"


def test_a_page_begins_with_the_end_of_a_long_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_module, "TAIL_BYTES", 25)
    monkeypatch.setattr(log_module, "_PART_BYTES", 45)
    write(tmp_path, "".join(f"line {number}\n" for number in range(10)))
    tail = read_log(tmp_path)
    assert (tail.text, tail.is_whole, tail.end) == ("line 7\nline 8\nline 9\n", False, 70)
    cut = read_log(tmp_path, 7)
    assert cut.text.startswith("line 4\n")
    assert not cut.is_whole
    assert read_log(tmp_path, 28).text.startswith("line 4\n")
    assert read_log(tmp_path, 28).is_whole
    assert read_log(tmp_path, 9999).text == ""


def test_no_log_is_an_empty_one_and_a_link_is_none(tmp_path: Path) -> None:
    assert read_log(tmp_path).end == 0
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "log.txt").symlink_to(tmp_path / "secret")
    assert read_log(tmp_path).text == ""


@pytest.mark.parametrize(
    ("line", "level"),
    [
        ("2026-01-01 10:00:00,000 ERROR it broke", "error"),
        ("2026-01-01 10:00:00,000 WARNING beware", "warning"),
        ("2026-01-01 10:00:00,000 INFO no ERROR here", ""),
        ("KeyError: 'x'", "error"),
        ("physhandi.errors.FitError: no", "error"),
        ("the Error of our ways", ""),
    ],
)
def test_bad_lines_are_known_by_their_level(line: str, level: str) -> None:
    assert level_of(line) == level
