"""The pages that list: home, all runs and all sequences, chosen and ordered by their address."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, cast

from fastapi import APIRouter, Header, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from app.jobs.catalog import Catalog
from app.jobs.listing import STATES, RunQuery, page_of, select_runs
from app.jobs.scheduler import ENDED
from app.jobs.views import describe_sequence
from app.jobs.watch import Feed
from app.pages.render import Pages
from app.previews.store import PreviewKind, Previews
from physhandi.errors import UsageError
from physhandi.fitting.config import named_profile, profile_names

_RECENT_RUNS = 8
_HOME_SEQUENCES = 6
_PAGE = 100
COLUMNS = (
    ("name", "Run", "name", ""),
    ("state", "State", "state", ""),
    ("created", "Created", "-created", ""),
    ("duration", "Took", "duration", "Time that its finished stages took."),
    ("fitted", "Error fitted, mm", "fitted", "Track error in the frames that were fitted [mm]."),
    (
        "predicted",
        "Error predicted, mm",
        "predicted",
        "Track error in the frames that were not fitted [mm].",
    ),
)
"""Columns of the list: name in the address, title, what a first click sorts by, meaning."""
ORDERS = (
    ("", "newest first, bundled last"),
    ("-created", "newest first"),
    ("created", "oldest first"),
    ("name", "name"),
    ("sequence", "sequence"),
    ("profile", "profile"),
    ("state", "state"),
    ("duration", "quickest first"),
    ("-duration", "slowest first"),
    ("fitted", "smallest error, fitted"),
    ("predicted", "smallest error, predicted"),
    ("-predicted", "largest error, predicted"),
)
SEQUENCE_ORDERS = (
    ("", "own first"),
    ("name", "name"),
    ("-frame_count", "most frames first"),
    ("duration_s", "shortest first"),
    ("-run_count", "most runs first"),
)


class SequenceQuery(BaseModel):
    """Filter and order of sequences; the fields are the parameters of an address."""

    model_config = ConfigDict(extra="forbid")

    q: Annotated[str, Field(max_length=200)] = ""
    sort: Annotated[str, Field(max_length=20)] = ""


def add_lists(
    router: APIRouter,
    catalog: Catalog,
    feed: Feed,
    pages: Pages,
    *,
    previews: Previews,
) -> None:
    """Add the pages that list to the routes.

    Args:
        router: Gets the routes.
        catalog: Finds sequences and runs.
        feed: Tells how far runs are.
        pages: Renders.
        previews: Tells which pictures there are, and makes them.
    """

    def described_sequences(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
        counts = Counter(name for run in runs for name in run["sequences"])
        described = [describe_sequence(item) for item in catalog.sequences()]
        return [sequence | {"run_count": counts[sequence["name"]]} for sequence in described]

    def pictured(kind: PreviewKind, shown: Sequence[Any]) -> list[dict[str, Any]]:
        # From the last to the first: what was asked for last is drawn first.
        entries = [entry | {"picture": previews.look(kind, entry["id"])} for entry in shown[::-1]]
        return entries[::-1]

    def launch_values(sequences: list[dict[str, Any]]) -> dict[str, Any]:
        profiles = [(name, named_profile(name).description) for name in ordered_profiles()]
        return {"profiles": profiles, "usable": [s for s in sequences if not s["error"]]}

    @router.get("/")
    def home(request: Request) -> Response:
        cursor, runs = feed.snapshot()
        shown = runs[:_RECENT_RUNS] + [r for r in runs[_RECENT_RUNS:] if _is_kept(r)]
        sequences = described_sequences(runs)
        return pages.render(
            request,
            "home.html",
            cursor=cursor,
            runs=pictured("run", shown),
            run_count=len(runs),
            sequences=pictured("sequence", sequences[:_HOME_SEQUENCES]),
            sequence_count=len(sequences),
            columns=COLUMNS,
            featured=_featured(runs),
            **launch_values(sequences),
        )

    @router.get("/runs")
    def list_runs(
        request: Request,
        query: Annotated[RunQuery, Query()],
        hx_trigger: Annotated[str | None, Header(max_length=64)] = None,
    ) -> Response:
        cursor, runs = feed.snapshot()
        query = query if query.limit else query.model_copy(update={"limit": _PAGE})
        chosen, problem = _chosen(runs, query)
        page = pages.render(
            request,
            "runs.html",
            cursor=cursor,
            query=query,
            problem=problem,
            runs=pictured("run", page_of(chosen, query)),
            total=len(chosen),
            run_count=len(runs),
            facets=_facets(runs),
            columns=COLUMNS,
            orders=ORDERS,
            steps=_steps(query, len(chosen)),
            **launch_values([describe_sequence(item) for item in catalog.sequences()]),
        )
        if hx_trigger != "runs":  # The list itself only asks again for what it shows.
            is_typed = hx_trigger == "filter"
            name = "HX-Replace-Url" if is_typed else "HX-Push-Url"
            page.headers[name] = _address(query, offset=query.offset)
        return page

    @router.get("/sequences")
    def list_sequences(request: Request, query: Annotated[SequenceQuery, Query()]) -> Response:
        cursor, runs = feed.snapshot()
        sequences = described_sequences(runs)
        chosen = _chosen_sequences(sequences, query)
        return pages.render(
            request,
            "sequences.html",
            cursor=cursor,
            query=query,
            sequences=pictured("sequence", chosen),
            sequence_count=len(sequences),
            orders=SEQUENCE_ORDERS,
            **launch_values(sequences),
        )


def ordered_profiles() -> list[str]:
    """Give the profiles, the quickest first."""
    return sorted(profile_names(), key=lambda name: (name != "quick", name != "default", name))


def _is_kept(run: Mapping[str, Any]) -> bool:
    """Tell whether the home page lists a run however old it is."""
    return run["is_bundled"] or run["state"] not in ENDED


def _featured(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Choose the finished runs that the home page offers: the bundled ones, else the newest.

    One with an object comes first, since its physics can be changed.
    """
    finished = [run for run in runs if run["is_published"] and run["kind"] == "reconstruction"]
    bundled = [run for run in finished if run["is_bundled"]]
    bundled.sort(key=lambda run: not run["has_object"])
    return bundled or finished[:1]


def _chosen(
    runs: list[dict[str, Any]], query: RunQuery
) -> tuple[list[Mapping[str, Any]], str | None]:
    """Choose runs; a wrong condition, perhaps half typed, is shown beside an empty list."""
    try:
        return select_runs(runs, query), None
    except UsageError as error:
        return [], str(error)


def _facets(runs: list[dict[str, Any]]) -> dict[str, list[tuple[str, int]]]:
    """Count what runs can be filtered by, so that only what exists is offered."""
    counts_of = {
        "state": Counter(run["state"] for run in runs),
        "profile": Counter(run["profile"] for run in runs if run["profile"]),
        "sequence": Counter(name for run in runs for name in run["sequences"]),
        "kind": Counter(run["kind"] for run in runs if run["kind"]),
    }
    order = {state: number for number, state in enumerate(STATES)}
    return {
        name: sorted(counts.items(), key=lambda pair: (order.get(pair[0], 0), pair[0]))
        for name, counts in counts_of.items()
    }


def _address(query: RunQuery, **changes: Any) -> str:
    """Write a list as the shortest address that leads to it."""
    limit = None if query.limit == _PAGE else query.limit
    return query.address(limit=limit, **changes)


def _steps(query: RunQuery, total: int) -> dict[str, Any]:
    """Give the addresses of the pages before and after, and of this page sorted otherwise."""
    limit = cast("int", query.limit)
    before, after = max(0, query.offset - limit), query.offset + limit
    sorts = {}
    for name, _, first, _ in COLUMNS:
        turned = name if query.sort.startswith("-") else f"-{name}"
        is_current = query.sort.removeprefix("-") == name
        sorts[name] = _address(query, sort=turned if is_current else first)
    return {
        "here": _address(query, offset=query.offset),
        "cleared": RunQuery(sort=query.sort).address(),
        "before": _address(query, offset=before) if query.offset else None,
        "after": _address(query, offset=after) if after < total else None,
        "first": min(query.offset + 1, total),
        "last": min(after, total),
        "sorts": sorts,
    }


def _chosen_sequences(
    sequences: list[dict[str, Any]], query: SequenceQuery
) -> list[dict[str, Any]]:
    words = query.q.lower().split()
    chosen = [
        sequence for sequence in sequences if all(word in _text_of(sequence) for word in words)
    ]
    if query.sort in dict(SEQUENCE_ORDERS) and query.sort:
        name = query.sort.removeprefix("-")
        with_value = [sequence for sequence in chosen if sequence.get(name) is not None]
        with_value.sort(key=lambda sequence: sequence[name], reverse=query.sort.startswith("-"))
        chosen = with_value + [sequence for sequence in chosen if sequence.get(name) is None]
    return chosen


def _text_of(sequence: Mapping[str, Any]) -> str:
    parts = [sequence["name"], sequence["id"], sequence.get("description") or ""]
    parts += [sequence.get("label") or "", *sequence.get("parts", ()), *sequence.get("hands", ())]
    parts += ["is:bundled"] if sequence["is_bundled"] else []
    return "\n".join(parts).lower()
