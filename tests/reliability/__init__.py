"""What the server survives, in counts: ``make reliability`` writes ``docs/reliability.md``.

Every other module of this folder has ``CASES``, a dictionary of `Case` by short names like "R1".
A case's function is given a count (kills, clients, clocks, …), does that many of them to something
real in a folder of its own, and returns a `Report`: what it counted, by plain names. Those in
`FAULTS` must be 0, and ``done`` must be the count that it was given. It needs no pytest, waits for
events instead of pauses (`waiting.until`), and leaves no process behind.

    def kill_workers(count: int, folder: Path) -> Report: ...

    CASES = {"R1": Case("A fit's process is killed", 200, 2, kill_workers)}

`tests/reliability/test_short.py` runs the short form of all of them among the other tests; a case
with 0 there is only in the long form. ``PYTHONPATH=tests python -m reliability R1 R6`` runs these
two in their long form and prints their counts, ``--count 5`` with that count.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from itertools import takewhile
from pathlib import Path
from pkgutil import iter_modules

Report = Mapping[str, float]
"""What a case counted: ``done``, what of `FAULTS` it looked for, and measures; see `Counts`."""
FAULTS = frozenset(
    {"lost", "corrupt", "orphans", "published twice", "wrong", "unanswered", "leaked", "hung"}
)
"""Counts that must be 0."""

_MOST_FINDINGS = 100
"""Findings that are kept; more of them tell nothing new."""


class Counts(Counter[str]):
    """What a case has counted so far, and what was found in words, which the page keeps."""

    def __init__(self, *faults: str) -> None:
        """Begin with 0 of those faults that are looked for."""
        super().__init__(dict.fromkeys(faults, 0))
        self.findings: list[str] = []
        """What went wrong, each with all that is needed to see it again."""

    def find(self, fault: str, finding: str) -> None:
        """Count a fault and keep what it was."""
        self[fault] += 1
        if len(self.findings) < _MOST_FINDINGS:
            self.findings.append(finding)

    def require(self, is_so: bool, otherwise: str) -> None:
        """Count as wrong what is not so, and keep what is said of it."""
        if not is_so:
            self.find("wrong", otherwise)

    def __reduce__(self) -> tuple[object, ...]:
        """Send findings to another process, too."""
        return Counts, (), {"findings": self.findings}, None, iter(self.items())


@dataclass(frozen=True)
class Case:
    """Something bad that is done many times."""

    about: str
    """What is done, as the page says it."""
    count: int
    """How often in the long form."""
    short: int
    """How often among the other tests; 0 for not at all."""
    run: Callable[[int, Path], Report]
    """Does it; given the count and an empty folder."""
    last: Callable[[float, Path], Report] | None = None
    """Does it for so long [s], in the long form, and says how often that was."""
    minutes: float = 0.0
    """How long that is in the long form [min]."""


def all_cases() -> dict[str, Case]:
    """Collect the cases of all modules, in the order of their numbers."""
    found: dict[str, Case] = {}
    for module in iter_modules(__path__):
        if module.name.startswith(("__", "test_")):
            continue
        for name, case in import_module(f"{__name__}.{module.name}").CASES.items():
            assert name not in found, f"two cases are named {name}"
            found[name] = case
    return dict(sorted(found.items(), key=lambda item: in_order(item[0])))


def in_order(name: str) -> tuple[int, str]:
    """Sort names of cases by their numbers."""
    digits = "".join(takewhile(str.isdigit, name[1:]))
    return int(digits), name


def faults_of(case_count: int, report: Report) -> list[str]:
    """Say what went wrong in a case; nothing if all is well."""
    faults = [f"{name}: {report[name]:g}" for name in sorted(FAULTS & set(report)) if report[name]]
    if not FAULTS & set(report):
        faults.append(f"it looked for none of {', '.join(sorted(FAULTS))}")
    if report.get("done") != case_count:
        faults.append(f"done {report.get('done')} of {case_count}")
    return faults
