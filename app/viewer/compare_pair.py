"""Which two runs are compared, and what has to be said of the pair."""

import re
from dataclasses import dataclass
from urllib.parse import parse_qsl, urlencode

from app.viewer.compare_clock import CompareClock
from app.viewer.compare_look import MODES, Look, Mode, Tint
from app.viewer.content import Catalog, Content, open_run
from physhandi.data.run import Run
from physhandi.errors import UsageError

_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")
_TINTS: tuple[Tint, ...] = ("side", "difference")
_LAST_FRAME = 10_000_000


@dataclass(frozen=True, kw_only=True)
class CompareAsk:
    """What a comparison is to show; its query is the part of an address after ``/compare?``."""

    a: str
    """Id of run A."""
    b: str
    """Id of run B."""
    sequence: str | None = None
    """A sequence of both; None for the first that both have."""
    mode: Mode = "side"
    """How both are placed."""
    color: Tint = "side"
    """What the colors of the nodes mean."""
    f: int = 0
    """Tick of the common clock, the frame if both have one rate."""

    def __post_init__(self) -> None:
        for name, value in (("a", self.a), ("b", self.b)):
            if not _ID.fullmatch(value):
                raise UsageError(f"{name}: {value[:64]!r} is no id of a run.")
        if self.a == self.b:
            raise UsageError(
                f"b: A and B are both run '{self.a}'. To compare two parameter sets of one run, "
                "open it and pin one of them."
            )
        if self.mode not in MODES:
            raise UsageError(f"mode: {self.mode!r} is not one of {', '.join(MODES)}.")
        if self.color not in _TINTS:
            raise UsageError(f"color: {self.color!r} is not one of {', '.join(_TINTS)}.")
        if not 0 <= self.f <= _LAST_FRAME:
            raise UsageError(f"f: {self.f} is not between 0 and {_LAST_FRAME}.")

    @property
    def query(self) -> str:
        """The address' query; what is as usual is left out."""
        usual = {"sequence": None, "mode": "side", "color": "side", "f": 0}
        fields = {"a": self.a, "b": self.b, "sequence": self.sequence, "mode": self.mode}
        fields |= {"color": self.color, "f": self.f}
        return urlencode({k: v for k, v in fields.items() if k not in usual or v != usual[k]})

    @classmethod
    def parse(cls, query: str) -> "CompareAsk":
        """Read an address' query.

        Raises:
            UsageError: If a field is missing, unknown or makes no sense; names the field.
        """
        fields = dict(parse_qsl(query))
        unknown = set(fields) - {"a", "b", "sequence", "mode", "color", "f"}
        if unknown or not {"a", "b"} <= set(fields):
            wrong = min(unknown, default="a" if "a" not in fields else "b")
            raise UsageError(f"{wrong[:40]!r}: a comparison has a, b, sequence, mode, color and f.")
        number = fields.pop("f", "0")
        if not (number.isascii() and number.isdigit() and len(number) < 10):
            raise UsageError(f"f: {number[:40]!r} is no frame.")
        values: dict[str, str] = fields
        return cls(**values, f=int(number))  # pyright: ignore[reportArgumentType]  # checked there

    @property
    def look(self) -> Look:
        """How the comparison begins."""
        return Look(mode=self.mode, tint=self.color)


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """Two runs that are shown together."""

    contents: tuple[Content, Content]
    """What A and B show."""
    clock: CompareClock
    """The time that both share."""
    notes: tuple[str, ...]
    """What a user should know before believing what is seen."""
    can_measure: bool
    """Whether the difference means something."""

    @property
    def title(self) -> str:
        """Both names."""
        first, second = self.contents
        return f"{first.title} and {second.title}"


def open_pair(catalog: Catalog, ask: CompareAsk) -> Pair:
    """Open both runs at a sequence that they share, if there is one.

    Args:
        catalog: Finds the runs.
        ask: Which ones.

    Raises:
        UsageError: If the sequence is not in both; names those that are.
        PhysHandiError: If a run cannot be found or shown.
    """
    first, second = catalog.run(ask.a), catalog.run(ask.b)
    names = chosen_sequences(first, second, ask.sequence)
    contents = (open_run(catalog, ask.a, names[0]), open_run(catalog, ask.b, names[1]))
    clock = CompareClock.of(*contents)
    notes: list[str] = []
    if names[0] != names[1]:
        notes.append(
            f"A shows '{names[0]}' and B '{names[1]}', other recordings: hands differ too."
        )
    notes += [clock.note] if clock.note else []
    lacking = [name for name, c in zip("AB", contents, strict=True) if c.fitted is None]
    if lacking:
        has = "have" if len(lacking) == 2 else "has"
        notes.append(f"{' and '.join(lacking)} {has} no fitted object to compare.")
    units = [content.length_unit for content in contents]
    if units[0] != units[1]:
        notes.append(f"A is in {units[0]} and B in {units[1]}: lengths cannot be compared.")
    return Pair(
        contents=contents,
        clock=clock,
        notes=tuple(notes),
        can_measure=not lacking and units[0] == units[1],
    )


def chosen_sequences(first: Run, second: Run, wanted: str | None) -> tuple[str, str]:
    """Choose what two runs show: the sequence that is wanted, a common one, or the first of each.

    Raises:
        UsageError: If the wanted one is not in both; names those that are.
    """
    shared = [name for name in first.sequence_names if name in second.sequence_names]
    if wanted is not None and wanted not in shared:
        told = ", ".join(shared) or "none"
        raise UsageError(f"sequence: '{wanted[:80]}' is not in both runs. In both: {told}.")
    if wanted is not None or shared:
        name = wanted or next((n for n in shared if _has(first, n) and _has(second, n)), shared[0])
        return name, name
    return first.sequence_names[0], second.sequence_names[0]


def _has(run: Run, name: str) -> bool:
    return run.has(f"sequences/{name}/meta.yaml")
