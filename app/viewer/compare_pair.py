"""Which two runs are compared, and what has to be said of the pair."""

from dataclasses import dataclass

from app.comparison import CompareAsk
from app.viewer.compare_clock import CompareClock
from app.viewer.compare_curve import Pairing
from app.viewer.content import Catalog, Content, open_run
from physhandi.data.run import Run
from physhandi.errors import UsageError


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


def pairing_of(pair: Pair) -> Pairing | None:
    """Tell which rollouts and frames are measured against each other; None if none can be."""
    first, second = (content.fitted for content in pair.contents)
    if not pair.can_measure or first is None or second is None:
        return None
    frames = tuple(pair.clock.frames(tick) for tick in range(pair.clock.tick_count))
    return Pairing(first=first, second=second, frames=frames)


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
