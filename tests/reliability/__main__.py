"""Run cases in their long form and write ``docs/reliability.md``; see the package."""

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

from reliability import Case, Report, all_cases, faults_of

PAGE = Path(__file__).parents[2] / "docs" / "reliability.md"
_HEAD = """# Reliability

What was done to the server and its fits, and what came of it. `make reliability` runs all of it
and writes this page; a short form of the cases is among the tests. *Faults* counts what was lost,
corrupted, left behind, published twice or told wrong.

"""


def main() -> int:
    """Run what is asked for; returns 1 if anything went wrong."""
    cases = all_cases()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="CASE", help="cases; all if left out")
    parser.add_argument("--count", type=int, help="in the place of each case's own count")
    parser.add_argument("--page", action="store_true", help="write docs/reliability.md")
    asked = parser.parse_args()
    unknown = set(asked.names) - set(cases)
    if unknown:
        parser.error(f"there is no {', '.join(sorted(unknown))}; known: {', '.join(cases)}")
    # Children find the workers of the tests here.
    os.environ["PYTHONPATH"] = str(Path(__file__).parents[1])
    rows: list[str] = []
    is_well = True
    for name in asked.names or cases:
        case = cases[name]
        count = asked.count or case.count
        begin = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            report = case.run(count, Path(folder))
        seconds = time.monotonic() - begin
        faults = faults_of(count, report)
        is_well &= not faults
        sys.stdout.write(f"{name} {json.dumps(dict(report))} in {seconds:.0f} s {faults or ''}\n")
        sys.stdout.flush()
        rows.append(_row(name, case, report, seconds, faults))
    if asked.page:
        table = [
            "| case | what is done | counted | faults | s |",
            "| --- | --- | --- | --- | --- |",
        ]
        where = f"{platform.system()}, {os.cpu_count()} processors, Python "
        where += f"{platform.python_version()}, {datetime.now(UTC):%Y-%m-%d}.\n"
        PAGE.write_text(_HEAD + where + "\n" + "\n".join([*table, *rows]) + "\n", encoding="utf-8")
    return 0 if is_well else 1


def _row(name: str, case: Case, report: Report, seconds: float, faults: list[str]) -> str:
    counted = ", ".join(f"{key} {value:g}" for key, value in report.items())
    told = "; ".join(faults) or "0"
    return f"| {name} | {case.about} | {counted} | {told} | {seconds:.0f} |"


if __name__ == "__main__":
    sys.exit(main())
