"""Run cases in their long form and write ``docs/reliability.md``; see the package.

The page is written anew after each case. Rows of cases that are not run stay, each with the day and
the load at which it was measured, so that a page may be made of several runs.
"""

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

from reliability import Case, Counts, Report, all_cases, faults_of, in_order

PAGE = Path(__file__).parents[2] / "docs" / "reliability.md"
_HEAD = """# Reliability

What was done to the server and its fits, and what came of it. `make reliability` runs all of it
and writes this page; `PYTHONPATH=tests python -m reliability --page R1 R6` replaces the rows of two
cases. A short form of the cases is among the tests. *Faults* counts what was lost, corrupted, left
behind, published twice or told wrong. The load is that of the machine, the number of processes that
want a processor, when the case began and when it ended; it was not the only work there.

| case | what is done | counted | faults | s | when and where |
| --- | --- | --- | --- | --- | --- |
"""
_LONGEST = 300
"""Letters of what was found that the page keeps."""


def main() -> int:
    """Run what is asked for; returns 1 if anything went wrong."""
    cases = all_cases()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="CASE", help="cases; all if left out")
    parser.add_argument("--count", type=int, help="in the place of each case's own count")
    parser.add_argument("--minutes", type=float, help="for cases that last so long, in its place")
    parser.add_argument("--page", action="store_true", help="write docs/reliability.md")
    asked = parser.parse_args()
    unknown = set(asked.names) - set(cases)
    if unknown:
        parser.error(f"there is no {', '.join(sorted(unknown))}; known: {', '.join(cases)}")
    # Children find the workers of the tests here.
    os.environ["PYTHONPATH"] = str(Path(__file__).parents[1])
    is_well = True
    for name in asked.names or cases:
        case = cases[name]
        begin, load = time.monotonic(), os.getloadavg()[0]
        with tempfile.TemporaryDirectory() as folder:
            if case.last is not None and asked.count is None:
                report = case.last(60.0 * (asked.minutes or case.minutes), Path(folder))
                count = int(report["done"])
            else:
                count = asked.count or case.count
                report = case.run(count, Path(folder))
        seconds = time.monotonic() - begin
        faults = faults_of(count, report)
        is_well &= not faults
        sys.stdout.write(f"{name} {json.dumps(dict(report))} in {seconds:.0f} s {faults or ''}\n")
        findings = report.findings if isinstance(report, Counts) else []
        sys.stdout.writelines(f"{name} found: {finding}\n" for finding in findings)
        sys.stdout.flush()
        if asked.page:
            where = (
                f"{datetime.now(UTC):%Y-%m-%d}, {platform.system()}, {os.cpu_count()} processors, "
            )
            where += (
                f"Python {platform.python_version()}, load {load:.0f} to {os.getloadavg()[0]:.0f}"
            )
            row = row_of(name, case, report, seconds, [*faults, *map(short, findings)], where)
            text = PAGE.read_text(encoding="utf-8")
            PAGE.write_text(_HEAD + merged(text, {name: row}), encoding="utf-8")
    return 0 if is_well else 1


def merged(page: str, rows: dict[str, str]) -> str:
    """Give the rows of a page with some replaced or added, in the order of their numbers."""
    kept = {row.split("|")[1].strip(): row for row in page.splitlines() if row.startswith("| R")}
    both = sorted((kept | rows).items(), key=lambda item: in_order(item[0]))
    return "".join(row + "\n" for _, row in both)


def short(finding: str) -> str:
    """Make of a finding what fits into a row; all of it is printed."""
    text = " ".join(finding.split()).replace("|", r"\|")
    return text if len(text) <= _LONGEST else text[:_LONGEST] + "…"


def row_of(
    name: str, case: Case, report: Report, seconds: float, faults: list[str], where: str
) -> str:
    """Write the row of a case."""
    counted = ", ".join(f"{key} {value:.10g}" for key, value in report.items())
    told = "; ".join(faults) or "0"
    return f"| {name} | {case.about} | {counted} | {told} | {seconds:.0f} | {where} |"


if __name__ == "__main__":
    sys.exit(main())
