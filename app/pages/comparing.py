"""The page that compares two runs, and the numbers behind it."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse

from app.ids import ItemId
from app.jobs.catalog import Catalog, RunItem
from app.jobs.scheduler import Scheduler
from app.jobs.views import describe_results, describe_run, read_frame_errors
from app.pages import Pages
from app.pages.diff import compare_runs
from app.viewer.color.difference import compare_frames, way_of
from app.viewer.compare.curve import Pairing
from app.viewer.compare.pair import chosen_sequences, open_pair, pairing_of
from app.viewer.compare.request import CompareAsk
from physhandi.data.files import named_fields
from physhandi.errors import RunError
from physhandi.run import Run

_ASIDES = ("Settings", "Computed with")
_QUANTITIES = ("track_error", "chamfer_l2")


def create_comparing(catalog: Catalog, scheduler: Scheduler, pages: Pages) -> APIRouter:
    """Make the routes.

    Args:
        catalog: Finds the runs.
        scheduler: Tells how far they are.
        pages: Renders.
    """
    router = APIRouter()

    @router.get("/compare", include_in_schema=False)
    def show_page(request: Request, ask: Annotated[CompareAsk, Query()]) -> HTMLResponse:
        items = [catalog.run_item(ask.a), catalog.run_item(ask.b)]
        first, second = (_opened(item) for item in items)
        shared = [name for name in first.sequence_names if name in second.sequence_names]
        described = [describe_run(item, scheduler) for item in items]
        return pages.render(
            request,
            "compare.html",
            ask=ask.model_dump(),
            runs=described,
            asides=_ASIDES,
            shared=shared,
            shown=chosen_sequences(first, second, ask.sequence)[0],
            sections=compare_runs(
                described,
                [first.config, second.config],
                [describe_results(first), describe_results(second)],
            ),
        )

    @router.get("/runs/{run_id}/compare", include_in_schema=False)
    def choose_other(request: Request, run_id: ItemId) -> HTMLResponse:
        """Offer the runs that one can be compared with, those of the same recordings first."""
        run = describe_run(catalog.run_item(run_id), scheduler)
        others = [describe_run(item, scheduler) for item in catalog.runs() if item.id != run_id]
        others = [other for other in others if other["is_published"]]
        shared = set(run["sequences"])
        return pages.render(
            request,
            "compare_with.html",
            run=run,
            near=[other for other in others if shared & set(other["sequences"])],
            far=[other for other in others if not shared & set(other["sequences"])],
        )

    @router.get("/api/v1/comparison")
    def show_numbers(ask: Annotated[CompareAsk, Query()]) -> dict[str, Any]:
        """Tell how far apart two runs are at every tick of their common clock.

        The answer has the ``notes`` on the pair, its ``frames`` (of A and B at each tick), ``rate``
        [Hz] and ``unit``, the ``difference`` (``way mean largest``, null if there is nothing to
        compare) and the ``errors`` of both runs at each tick by quantity, as far as they have them.
        """
        pair = open_pair(catalog, ask)
        runs = (catalog.run(ask.a), catalog.run(ask.b))
        frames = [pair.clock.frames(tick) for tick in range(pair.clock.tick_count)]
        names = [content.sequence_name for content in pair.contents]
        errors = [read_frame_errors(run).get(n, {}) for run, n in zip(runs, names, strict=True)]
        return {
            "sequences": names,
            "notes": list(pair.notes),
            "rate": pair.clock.rate,
            "unit": pair.contents[0].length_unit,
            "frames": frames,
            "future_start": errors[0].get("future_start"),
            "difference": _difference(pairing_of(pair)),
            "errors": {quantity: _errors(errors, quantity, frames) for quantity in _QUANTITIES},
        }

    return router


def _opened(item: RunItem) -> Run:
    if item.run is None:
        raise RunError(f"Run '{item.id}' cannot be opened: {item.error}")
    return item.run


def _difference(pairing: Pairing | None) -> dict[str, Any] | None:
    """Measure every tick; null if the pair has nothing to measure."""
    if pairing is None:
        return None
    way = way_of(pairing.first, pairing.second)
    measured = [
        compare_frames(pairing.first, first, pairing.second, second, way)
        for first, second in pairing.frames
    ]
    return {
        "way": way,
        "mean": [frame.mean for frame in measured],
        "largest": [frame.largest for frame in measured],
    }


def _errors(
    errors: list[dict[str, Any]], quantity: str, frames: list[tuple[int, int]]
) -> dict[str, list[float | None]]:
    """Look up a quantity of both runs at every tick; null where it was not measured."""
    by_side: dict[str, list[float | None]] = {}
    for side, name in enumerate("ab"):
        rollout = named_fields(errors[side].get("rollout")) or {}
        numbers: Any = errors[side].get("frames")
        values: Any = rollout.get(quantity)
        are_lists = isinstance(errors[side].get("frames"), list)
        if not are_lists or not isinstance(rollout.get(quantity), list):
            continue
        pairs: list[tuple[Any, Any]] = list(zip(numbers, values, strict=False))
        by_frame = dict(pairs)
        by_side[name] = [by_frame.get(pair[side]) for pair in frames]
    return by_side
