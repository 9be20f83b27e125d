"""docs/security.md tells of tests that are there."""

import ast
import re
from pathlib import Path

TESTS = Path(__file__).parents[2]
PAGE = (TESTS.parent / "docs/security.md").read_text(encoding="utf-8")


def test_every_abuse_case_names_its_tests_and_these_are_there() -> None:
    rows = re.findall(r"^\| (A\d+) \|.*\| ([^|]*) \|$", PAGE, re.MULTILINE)
    assert [case for case, _ in rows] == [f"A{number}" for number in range(1, 29)]
    for case, cell in rows:
        named = re.findall(r"`([\w/]+\.py)::(\w+)`", cell)
        assert named, case
        for file, name in named:
            tree = ast.parse((TESTS / file).read_text(encoding="utf-8"))
            assert name in {item.name for item in tree.body if isinstance(item, ast.FunctionDef)}
