"""Filters, order and pages of the list of runs."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from pydantic import BaseModel, ConfigDict, Field

from physhandi.errors import UsageError

Sort = Literal[
    "name",
    "-name",
    "sequence",
    "-sequence",
    "profile",
    "-profile",
    "state",
    "-state",
    "created",
    "-created",
    "duration",
    "-duration",
    "fitted",
    "-fitted",
    "predicted",
    "-predicted",
]
"""A column to sort by; with a minus, from high to low."""
STATES = (
    *("queued", "starting", "running", "stopping"),
    *("succeeded", "failed", "cancelled", "damaged"),
)
"""States in the order in which they come."""
_FIELDS = {
    "name": "name",
    "profile": "profile",
    "created": "created",
    "duration": "duration_s",
    "fitted": "track_error_fitted",
    "predicted": "track_error_predicted",
}
_KEYS = ("is", "state", "profile", "sequence", "kind", "tag")
_FLAGS = ("bundled", "mine", "published", *STATES)

Word = Annotated[str, Field(max_length=120)]


class RunQuery(BaseModel):
    """Filter, order and page; the fields are the parameters of an address."""

    model_config = ConfigDict(extra="forbid")

    q: Annotated[str, Field(max_length=200)] = ""
    """Words that name, id, tags, sequences or profile contain, and conditions such as
    ``state:failed``, ``profile:quick``, ``sequence:towel_fold``, ``kind:simulation``, ``tag:best``
    or ``is:bundled``; a minus in front turns one around."""
    state: Word = ""
    """Only runs in this state."""
    profile: Word = ""
    """Only runs of this profile."""
    sequence: Word = ""
    """Only runs of this sequence."""
    kind: Word = ""
    """Only ``reconstruction`` or ``simulation``."""
    sort: Sort | Literal[""] = ""
    """Column to sort by; nothing puts the newest first and the bundled ones last."""
    limit: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """Most runs to give; none gives all."""
    offset: Annotated[int, Field(ge=0)] = 0
    """Runs to leave out at the beginning."""

    @property
    def is_filtered(self) -> bool:
        """Whether it leaves any run out."""
        return bool(self.q.strip() or self.state or self.profile or self.sequence or self.kind)

    def address(self, path: str = "runs", **changes: Any) -> str:
        """Write it as an address, with some fields changed; what is not set is left out."""
        fields = self.model_dump() | {"offset": 0} | changes
        defaults = RunQuery()
        fields_set = {k: v for k, v in fields.items() if v != getattr(defaults, k)}
        return f"{path}?{urlencode(fields_set)}" if fields_set else path


def select_runs(runs: Iterable[Mapping[str, Any]], query: RunQuery) -> list[Mapping[str, Any]]:
    """Give the runs that a query asks for in its order, whatever its limit and offset.

    Args:
        runs: Descriptions of `describe_run`, the newest first.
        query: What is asked for.

    Raises:
        UsageError: If a condition has an unknown name or value; names it.
    """
    conditions = _conditions(query)
    chosen = [run for run in runs if all(_fits(run, *condition) for condition in conditions)]
    if not query.sort:
        return chosen
    name = query.sort.removeprefix("-")
    # A run that lacks the figure comes last in either direction.
    sortable = [(key, run) for run in chosen if (key := _key(run, name)) is not None]
    sortable.sort(key=lambda pair: pair[0], reverse=query.sort.startswith("-"))
    return [run for _, run in sortable] + [run for run in chosen if _key(run, name) is None]


def page_of(runs: Sequence[Mapping[str, Any]], query: RunQuery) -> Sequence[Mapping[str, Any]]:
    """Cut out the part that limit and offset ask for."""
    end = None if query.limit is None else query.offset + query.limit
    return runs[query.offset : end]


def _conditions(query: RunQuery) -> list[tuple[str, str, bool]]:
    """List what must hold: a key (empty for free text), its value, and whether it must not."""
    chosen = [
        (key, str(getattr(query, key)).lower(), False)
        for key in ("state", "profile", "sequence", "kind")
        if getattr(query, key)
    ]
    for word in query.q.lower().split():
        is_not = len(word) > 1 and word.startswith("-")
        key, colon, value = word.removeprefix("-" if is_not else "").partition(":")
        if not colon:
            chosen.append(("", key, is_not))
        elif key not in _KEYS:
            names = ", ".join(f"{name}:" for name in _KEYS)
            raise UsageError(f"The filter knows no '{key}:'. It knows {names} and plain words.")
        elif key == "is" and value not in _FLAGS:
            names = ", ".join(_FLAGS)
            raise UsageError(f"The filter knows no 'is:{value}'. After 'is:' write one of {names}.")
        elif value:
            chosen.append((key, value, is_not))
    return chosen


def _fits(run: Mapping[str, Any], key: str, value: str, is_not: bool) -> bool:
    if key == "is":
        flags = {
            "bundled": run["is_bundled"],
            "mine": not run["is_bundled"],
            "published": run["is_published"],
        }
        is_match = flags.get(value, run["state"] == value)
    elif key == "sequence":
        is_match = value in (name.lower() for name in run["sequences"])
    elif key == "tag":
        is_match = value in (tag.lower() for tag in run["tags"])
    elif key:
        is_match = str(run[key]).lower() == value
    else:
        is_match = value in _text_of(run)
    return is_match is not is_not


def _text_of(run: Mapping[str, Any]) -> str:
    fields = (run["name"], run["id"], run["profile"], run.get("note", ""))
    parts = (*fields, *run["sequences"], *run["tags"])
    return "\n".join(parts).lower()


def _key(run: Mapping[str, Any], name: str) -> Any:
    """Give what a run is sorted by; None if it has no such thing."""
    if name == "state":
        return STATES.index(run["state"]) if run["state"] in STATES else None
    value = ", ".join(run["sequences"]) if name == "sequence" else run[_FIELDS[name]]
    if isinstance(value, str):
        return value.casefold() or None
    return value
