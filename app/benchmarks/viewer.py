"""Figures of the whole application on this machine: pages, live scenes and their sliders."""

import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.benchmarks.browser import (
    measure_first_paint,
    measure_opening,
    measure_slider_in_browser,
    open_chromium,
)
from app.benchmarks.parts import PARTS, Part
from app.benchmarks.scenes import (
    HEAVY,
    HEAVY_FRAMES,
    HEAVY_NODES,
    make_heavy_run,
    make_many_runs,
)
from app.benchmarks.served import Served
from app.benchmarks.sliders import FIELDS, MeasuredSlider, measure_first_move, measure_slider
from app.benchmarks.streams import measure_scrub, measure_sessions, percentiles
from app.settings import BUNDLED
from physhandi.benchmarks.timing import describe_machine
from physhandi.data.layout import SequenceFiles
from physhandi.devices import start_warp
from physhandi.errors import MissingInputError
from physhandi.run import Run

if TYPE_CHECKING:
    from playwright.sync_api import Browser

_RATE = 30.0
_SESSIONS = 10
_LISTS = ("/", "/runs", "/api/v1/runs")


@dataclass(frozen=True)
class Goal:
    """Goal of a figure."""

    part: Part
    """Part that measures it."""
    path: tuple[str, ...]
    """Keys of the figure in the part's result."""
    limit: float
    """The goal."""
    is_least: bool = False
    """Whether the figure is to be at least the goal, instead of below it."""


GOALS: Mapping[str, Goal] = {
    "first_paint_ms": Goal("paint", ("p50_ms",), 1000.0),
    "click_to_result_p95_ms": Goal("open", ("p95_ms",), 2000.0),
    "scrub_p95_ms": Goal("scrub", ("p95_ms",), 60.0),
    "slider_p95_ms": Goal("slider", ("p95_ms",), 500.0),
    "slider_in_browser_p95_ms": Goal("browser", ("p95_ms",), 500.0),
    "first_move_after_start_ms": Goal("start", ("first_move_ms",), 500.0),
    "frame_bytes": Goal("bytes", ("frame_bytes", "p95"), 100_000.0),
    "ten_sessions_frames_per_s": Goal("sessions", ("worst_frames_per_s",), 29.0, is_least=True),
    "ten_sessions_skipped_per_s": Goal("sessions", ("worst_skipped_per_s",), 1.0),
    "list_of_1000_runs_p95_ms": Goal("runs", ("worst_p95_ms",), 300.0),
    "splats_frame_bytes": Goal("splats", ("frame_bytes",), 100_000.0),
    "splats_server_ms": Goal("splats", ("server_ms",), 5.0),
    "live_frames_per_s": Goal("live", ("frames_per_s",), _RATE, is_least=True),
    "steered_frames_per_s": Goal("live", ("steered", "frames_per_s"), 20.0, is_least=True),
}
"""The figures that are asked of the viewer."""


@dataclass(frozen=True)
class _Effort:
    """Numbers of repetitions."""

    moves: int
    visits: int
    seconds: float
    runs: int


_FULL = _Effort(moves=40, visits=10, seconds=20.0, runs=1000)
_QUICK = _Effort(moves=8, visits=3, seconds=4.0, runs=1000)


def measure_viewer(
    run: Run, sequence: str, *, parts: tuple[Part, ...] = PARTS, is_quick: bool = False
) -> dict[str, Any]:
    """Measure the real server on a free loopback port, with data of its own.

    Args:
        run: A finished run with an object, whose scene is played and whose sliders are moved.
        sequence: Its first sequence, which its scenes show.
        parts: What to measure.
        is_quick: Whether to repeat everything less often.

    Returns:
        The machine, ``figures`` (for each its ``value``, ``goal`` and whether it is ``reached``)
        and what each part found.

    Raises:
        MissingInputError: If the run has no object there, or a browser is asked for and missing.
        RunError: If the server does not start.
        ServerFailedError: If it does not do what it is asked.
    """
    start_warp()
    about = describe_machine("cpu")
    effort = _QUICK if is_quick else _FULL
    position = SequenceFiles(sequence).rollout
    if not run.has(position):
        raise MissingInputError(f"Run '{run.name}' has no object in '{sequence}' to simulate.")
    with (
        tempfile.TemporaryDirectory(prefix="physhandi_benchmark_") as folder,
        _Bench(run, sequence, Path(folder), effort) as bench,
    ):
        results = {part: bench.measure(part) for part in PARTS if part in parts}
    return {
        "benchmark": "viewer",
        **about,
        "load_average_after": os.getloadavg()[0],
        "cpu_count": os.cpu_count(),
        "scene": f"{run.name}: {sequence}",
        "is_quick": is_quick,
        "figures": compare_with_goals(results),
        **results,
    }


def compare_with_goals(results: Mapping[Part, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Hold what was measured against the goals.

    Args:
        results: What each part returned.

    Returns:
        For each figure of these parts its ``value``, ``goal``, and whether it is ``reached``.
    """
    figures: dict[str, dict[str, Any]] = {}
    for name, goal in GOALS.items():
        if goal.part not in results:
            continue
        value: Any = results[goal.part]
        for key in goal.path:
            value = value[key]
        is_reached = value >= goal.limit if goal.is_least else value < goal.limit
        figures[name] = {"value": value, "goal": goal.limit, "reached": bool(is_reached)}
    return figures


class _Bench:
    """Measures one part after the other, those that show the run with one server."""

    def __init__(self, run: Run, sequence: str, folder: Path, effort: _Effort) -> None:
        self._run = run
        self._sequence = sequence
        self._folder = folder
        self._effort = effort
        self._stack = ExitStack()
        self._server: Served | None = None
        self._chromium: Browser | None = None

    def __enter__(self) -> "_Bench":
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def measure(self, part: Part) -> dict[str, Any]:
        """Measure one part."""
        works: dict[Part, Callable[[], dict[str, Any]]] = {
            "paint": self._paint,
            "open": self._open,
            "scrub": self._scrub,
            "slider": self._slider,
            "browser": self._browser,
            "start": self._start,
            "bytes": lambda: self._heavy(1),
            "sessions": lambda: self._heavy(_SESSIONS),
            "runs": self._many_runs,
            "live": self._live,
            "splats": self._splats,
        }
        load = os.getloadavg()[0]
        return {"load_average": load, **works[part]()}

    def _data(self, name: str) -> Path:
        """Make a data folder in which the run is, unless the program brings it along."""
        data = self._folder / name
        (data / "runs").mkdir(parents=True, exist_ok=True)
        target = data / "runs" / self._run.id
        if self._run.folder.parent != BUNDLED / "runs" and not target.exists():
            shutil.copytree(self._run.folder, target)
        return data

    def _served(self) -> Served:
        """Start the server that shows the run, unless it was started before."""
        if self._server is None:
            self._server = self._stack.enter_context(Served(self._data("plain")))
        return self._server

    def _opened_browser(self) -> "Browser":
        """Open the browser of all parts, unless it was opened before; each has pages of its own."""
        if self._chromium is None:
            self._chromium = self._stack.enter_context(open_chromium())
        return self._chromium

    def _paint(self) -> dict[str, Any]:
        browser = self._opened_browser()
        return measure_first_paint(self._served(), browser, self._effort.visits)

    def _open(self) -> dict[str, Any]:
        browser, served = self._opened_browser(), self._served()
        return measure_opening(served, browser, self._run.id, self._effort.visits)

    def _scrub(self) -> dict[str, Any]:
        shown = MeasuredSlider(self._run, self._sequence, FIELDS[0]).fitted
        return measure_scrub(self._served(), self._run.id, shown, 3 * self._effort.moves)

    def _slider(self) -> dict[str, Any]:
        kinds: dict[str, Any] = {}
        seconds: list[float] = []
        served = self._served()
        for field in FIELDS:
            slider = MeasuredSlider(self._run, self._sequence, field)
            moves = slider.moves(self._effort.moves)
            for is_playing in (True, False):
                measured = measure_slider(
                    served, self._run.id, slider, moves, is_playing=is_playing
                )
                seconds += measured.pop("seconds")
                how = "playing" if is_playing else "paused"
                kinds[f"{field}, {how}"] = measured
        return {"moves": len(seconds), **percentiles(seconds), "kinds": kinds}

    def _browser(self) -> dict[str, Any]:
        slider = MeasuredSlider(self._run, self._sequence, FIELDS[0])
        moves = slider.moves(self._effort.moves)
        browser, served = self._opened_browser(), self._served()
        return measure_slider_in_browser(served, browser, self._run.id, slider, moves)

    def _start(self) -> dict[str, Any]:
        slider = MeasuredSlider(self._run, self._sequence, FIELDS[0])
        moves = slider.moves(2)
        measured: dict[str, Any] = {}
        with Served(self._data("fresh")) as served:
            measured |= measure_first_move(served, self._run.id, slider, moves)
        # Nothing compiled before is found in an empty cache.
        empty = {"WARP_CACHE_PATH": str(self._folder / "kernels")}
        with Served(self._data("fresh"), environment=empty) as served:
            measured["nothing_compiled"] = measure_first_move(served, self._run.id, slider, moves)
        return measured

    def _heavy(self, count: int) -> dict[str, Any]:
        data = self._folder / "heavy"
        if not data.exists():
            make_heavy_run(data / "runs")
        with Served(data) as served:
            measured = measure_sessions(
                served,
                HEAVY,
                count=count,
                frame_count=HEAVY_FRAMES,
                frame_rate=_RATE,
                seconds=self._effort.seconds,
            )
        return {"nodes": HEAVY_NODES, "hands": 2, **measured}

    def _many_runs(self) -> dict[str, Any]:
        data = self._data("many")
        make_many_runs(data / "runs", self._effort.runs)
        measured: dict[str, Any] = {"runs": self._effort.runs}
        with Served(data) as served:
            measured["first_ms"] = 1e3 * served.get(_LISTS[0])[0]
            for path in _LISTS:
                busy = served.cpu_seconds()
                seconds = [served.get(path)[0] for _ in range(2 * self._effort.visits)]
                busy = (served.cpu_seconds() - busy) / len(seconds)
                size = len(served.get(path)[1])
                measured[path] = {
                    **percentiles(seconds),
                    "server_cpu_ms": 1e3 * busy,
                    "bytes": size,
                }
        return {**measured, "worst_p95_ms": max(measured[path]["p95_ms"] for path in _LISTS)}

    def _splats(self) -> dict[str, Any]:
        from app.benchmarks.splats import measure_splats

        seconds = self._effort.seconds / 2
        return measure_splats(self._run, self._sequence, self._opened_browser(), seconds)

    def _live(self) -> dict[str, Any]:
        from app.benchmarks.latency import MOVES, measure_latency

        moves = min(MOVES, self._effort.moves)
        measured = measure_latency(self._run, self._sequence, device="cpu", moves=moves)
        kind = measured["kinds"]["stiffness, substeps automatic"]
        named = ("sequence_frames_per_s", "steered")
        return {**kind, **{name: measured[name] for name in named}}
