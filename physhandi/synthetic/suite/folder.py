"""The folder of a suite: its cells, and the tables made of them (`SuiteFolder`).

Tables depend on cells alone, so that they can be written while others are still computed, and so
that cells of an earlier order on the same sequences remain in them.
"""

from collections.abc import Iterable, Iterator, Mapping
from collections.abc import Sequence as Many
from pathlib import Path
from typing import Any, Literal, TypedDict, cast

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.files import named_fields, write_bytes, write_json
from physhandi.data.run_folder import read_json, read_record
from physhandi.data.sequence import Sequence
from physhandi.data.truth import read_truth
from physhandi.errors import RunError, UsageError
from physhandi.metrics.contact import THRESHOLDS, ContactLabels, contact_scores, true_labels
from physhandi.metrics.report import CONTACT_METRICS, METRICS
from physhandi.metrics.suite_report import (
    PAIRED_COLUMNS,
    SEED_COLUMNS,
    SUITE_COLUMNS,
    Score,
    compare,
    summarise,
    to_csv,
    with_seed_means,
    write_report,
)
from physhandi.synthetic.suite.cells import Outcome
from physhandi.synthetic.suite.pictures import write_motion_pictures
from physhandi.synthetic.suite.suite import FLOOR

DENSE_ACTIONS = ("squeeze", "wipe")
"""Synthetic actions in which the whole hand is on the body; others use fingertips."""
DENSE = 0.05
"""In other recordings contact is dense if a hand touches more than this share of the object's
contact points on average, over the frames in which it touches any."""
_SPLITS = ("reconstruction", "future")
_HANDS = {"chamfer_symmetric": "hand_chamfer", "mpjpe": "mpjpe", "surface_error": "hand_surface"}
_PICTURES = tuple(
    f"{score}{definition}"
    for definition in ("", "_proper", "_held_out")
    for score in ("iou", "psnr", "ssim", "lpips")
)
_TOPOLOGY = ("rrd_object", "rrd_virtual")
Figures = dict[str, dict[str, float]]
"""Figures by split and metric."""
CELLS = "cells.json"
"""Description of the orders, and every cell with its figures."""
CURVES_FILE = "curves.json"
"""Errors frame by frame of the same cells, in the same order."""
_KEY = ("protocol", "split", "method", "case")
CellScores = dict[str, Any]


class SuiteFolder:
    """The tables of a suite, which grow with every cell."""

    def __init__(self, out: Path, about: Mapping[str, Any]) -> None:
        """Read existing tables; nothing is written yet.

        Args:
            out: The folder.
            about: Description of the order: ``title methods seed_of oracles cases protocols
                made_from`` and more.

        Raises:
            UsageError: If the folder holds the table of another order.
        """
        self.out = out
        self.about = dict(about)
        self.done: list[CellScores] = []
        before = check_folder(out, about["title"], about["cases"])
        self._earlier: list[CellScores] = []
        self._skipped: list[str] = []
        self.notes: list[str] = []
        if before is None:
            return
        earlier = before["about"]
        methods = {n: text for n, text in earlier["methods"].items() if n not in about["methods"]}
        if earlier.get("made_from") == about["made_from"]:
            self._earlier = _with_curves(out, before["cells"])
            self._skipped = list(earlier["skipped"])
            self.about["methods"] = {**earlier["methods"], **about["methods"]}
            self.about["seed_of"] = {**earlier.get("seed_of", {}), **about["seed_of"]}
            self.about["oracles"] = list(dict.fromkeys([*earlier["oracles"], *about["oracles"]]))
            self.about["protocols"] = list(
                dict.fromkeys([*earlier["protocols"], *about["protocols"]])
            )
        elif methods:
            self.notes.append(
                "Left out, because they were computed with other code, settings or data: "
                f"{', '.join(methods)}. Evaluate them again to have them in this table."
            )

    def write(
        self,
        environment: Mapping[str, Any],
        skipped: Many[str],
        missing: int,
        recordings: Many[Sequence] = (),
        device: str = "cpu",
    ) -> dict[str, Any]:
        """Write cells, tables, report, charts and pictures of the finished cells.

        Args:
            environment: Machine and library versions.
            skipped: Reasons for skipped cells.
            missing: Number of unfinished cells of the order.
            recordings: Sequences of which pictures are drawn.
            device: Warp device that draws them.

        Returns:
            ``out``, ``table`` and ``report``: paths.
        """
        cells = self._all_cells()
        shown = {cell["method"] for cell in cells}
        about = self.about | {
            "methods": {n: text for n, text in self.about["methods"].items() if n in shown},
            "notes": [*self.about["notes"], *self.notes],
            "skipped": list(dict.fromkeys([*self._skipped, *skipped])),
            "missing": missing,
            "environment": dict(environment),
        }
        about["seed_of"] = {n: base for n, base in self.about["seed_of"].items() if n in shown}
        scores = with_seed_means(scores_of(cells), about["seed_of"])
        rows = summarise(scores, about["seed_of"])
        methods = list(dict.fromkeys(about["seed_of"].get(n, n) for n in about["methods"]))
        against = "phystwin" if "phystwin" in methods else (methods or [""])[0]
        differences = compare(scores, against)
        above = compare(scores, FLOOR) if against != FLOOR else []
        about["pictures"] = list(
            write_motion_pictures(self.out / "charts", recordings, cells, about["seed_of"], device)
        )
        files = write_report(about, rows, differences, above, cells)
        about["charts"] = [Path(file).name for file in files if file.startswith("charts/")]
        about["charts"] += about["pictures"]
        columns = SEED_COLUMNS if about["seed_of"] else SUITE_COLUMNS
        paired = to_csv([*differences, *above], PAIRED_COLUMNS)
        files |= {"table.csv": to_csv(rows, columns), "paired.csv": paired}
        for file, content in files.items():
            (self.out / file).parent.mkdir(parents=True, exist_ok=True)
            write_bytes(self.out / file, content.encode())
        write_json(self.out / CURVES_FILE, {"curves": [cell["curves"] for cell in cells]})
        plain = [{name: v for name, v in cell.items() if name != "curves"} for cell in cells]
        write_json(self.out / CELLS, {"about": about, "cells": plain})
        return {
            "out": str(self.out),
            "table": str(self.out / "table.csv"),
            "report": str(self.out / "report.md"),
        }

    def _all_cells(self) -> list[CellScores]:
        """Merge finished cells with those of earlier orders, in the order of the tables."""
        new = {_key(cell) for cell in self.done}
        earlier = [
            cell
            for cell in self._earlier
            if _key(cell) not in new and (not cell["run"] or self._has_run(cell["run"]))
        ]
        places = [list(self.about[name]) for name in ("protocols", "cases", "methods")]

        def place(cell: CellScores) -> tuple[int, ...]:
            named = (cell["protocol"], cell["case"], cell["method"])
            return tuple(names.index(name) for names, name in zip(places, named, strict=True))

        return sorted([*earlier, *self.done], key=place)

    def _has_run(self, name: str) -> bool:
        return (self.out / "cells" / name / "run.yaml").is_file()


class StoredAbout(TypedDict):
    """Order of the suite in ``cells.json``, as far as it is read again."""

    title: str
    methods: dict[str, str]
    cases: list[str]
    protocols: list[str]
    skipped: list[str]


class StoredTables(TypedDict):
    """``cells.json``: the order and its cells."""

    about: StoredAbout
    cells: list[CellScores]


def check_folder(out: Path, title: str, cases: Iterable[str]) -> dict[str, Any] | None:
    """Read the tables in a folder, and refuse those of another order.

    Args:
        out: The folder.
        title: Title of the present order.
        cases: Names of its sequences.

    Returns:
        ``about`` and ``cells``; None if there is no table.

    Raises:
        UsageError: If the table is of other sequences, or cannot be read.
    """
    path = out / CELLS
    try:
        content = read_record(path, StoredTables)
    except RunError as error:
        raise UsageError(f"{error} Delete it; finished cells are kept without it.") from None
    if content is None:
        return None
    about, cells = content["about"], content["cells"]
    wanted_cases = list(cases)
    if about["title"] != title or set(about["cases"]) != set(wanted_cases):
        raise UsageError(
            f"{out} holds the table '{about['title']}' of {', '.join(about['cases'])}, which "
            f"'{title}' of {', '.join(wanted_cases)} would replace. Choose another --out."
        )
    return {"about": about, "cells": cells}


def _with_curves(out: Path, cells: Many[CellScores]) -> list[CellScores]:
    path = out / CURVES_FILE
    curves = (named_fields(read_json(path)) or {}).get("curves") if path.is_file() else None
    if not isinstance(curves, list) or len(cast("list[Any]", curves)) != len(cells):
        curves = [{} for _ in cells]
    both = zip(cells, cast("list[Any]", curves), strict=True)
    return [{**cell, "curves": curve} for cell, curve in both]


def _key(cell: CellScores) -> tuple[str, ...]:
    return tuple(cell[name] for name in _KEY)


def contact_kind(recording: Sequence) -> Literal["dense", "point"] | None:
    """Classify contact by the action, else by the true contact; None if unknown."""
    settings = named_fields(recording.provenance.get("synthesize")) or {}
    if settings.get("action") is not None:
        return "dense" if settings["action"] in DENSE_ACTIONS else "point"
    contact = read_truth(recording.folder).contact
    if contact is None or not contact.any():
        return None
    share = contact.mean(axis=1)
    return "dense" if share[share > 0].mean() > DENSE else "point"


def figures_of(
    outcome: Outcome,
    recording: Sequence,
    protocol: str,
    name: str,
    unmoved: Float[ndarray, "node 3"] | None = None,
) -> Figures:
    """Collect the figures of a cell.

    Args:
        outcome: Result of the cell.
        recording: Sequence that it was scored against.
        protocol: Protocol of the cell.
        name: The cell's split in the protocol; prefix of every split but those of ``main``.
        unmoved: Object nodes of frame 0, if the method predicts contact [m].

    Returns:
        Every known figure. A method without output gets those of the static object, which touches
        nothing, and none of hands, topology and time; nor does an object in a sequence that it was
        not fitted on.
    """

    def named(split: str) -> str:
        return split if protocol == "main" else f"{name}/{split}"

    by_split: dict[str, Mapping[str, Any]] = {}
    for split in _SPLITS[:1] if protocol == "unseen" else _SPLITS:
        rollout = outcome.report.get(split, {}).get("rollout", {})
        figures = {metric: rollout.get(metric) for metric in (*METRICS, *_PICTURES)}
        if outcome.error and rollout and unmoved is not None:
            figures |= no_contact_scores(recording, unmoved, _frames(recording, protocol, split))
        # All frames of an unseen interaction are in the first split.
        by_split["unseen" if protocol == "unseen" else named(split)] = figures
    if not outcome.error and protocol != "unseen":
        by_split[named("hands")] = _hand_figures(outcome.report.get("hands", {}))
        topology = outcome.report.get("topology", {})
        by_split[named("topology")] = {metric: topology.get(metric) for metric in _TOPOLOGY}
        if protocol == "main":
            by_split["runtime"] = _times(outcome.seconds, recording.frame_count)
    numeric = {
        split: {m: float(v) for m, v in figures.items() if isinstance(v, int | float)}
        for split, figures in by_split.items()
    }
    return {split: figures for split, figures in numeric.items() if figures}


def scores_of(cells: Iterable[Mapping[str, Any]]) -> Iterator[Score]:
    """List the figures of cells; those of the protocol ``main`` also by their kind of contact.

    Args:
        cells: Entries with ``method case protocol contact figures``.
    """
    for cell in cells:
        figures = dict(cell["figures"])
        if cell["protocol"] == "main" and cell["contact"]:
            kind = cell["contact"]
            figures |= {f"{s}/{kind}": figures[s] for s in _SPLITS if s in figures}
        for split, by_metric in figures.items():
            for metric, value in by_metric.items():
                yield Score(
                    method=cell["method"],
                    case=cell["case"],
                    split=split,
                    metric=metric,
                    value=float(value),
                )


def no_contact_scores(
    recording: Sequence, node: Float[ndarray, "node 3"], frames: Iterable[int]
) -> dict[str, float | None]:
    """Score the prediction that nothing is ever touched, where the true contact is known.

    Otherwise a method that fails on hard contacts would be averaged over the easy ones only.

    Args:
        recording: The recording; without true contact there is no figure.
        node: Object nodes of frame 0 [m].
        frames: Frames to score; frame 0 is left out.
    """
    labels = true_labels(read_truth(recording.folder), node)
    chosen = [frame for frame in frames if frame > 0]
    if labels is None or not chosen:
        return {}
    in_frames = ContactLabels(
        is_contact=labels.is_contact[chosen], is_known=labels.is_known[chosen]
    )
    nothing = np.zeros_like(in_frames.is_contact)
    scores: dict[str, float | None] = {}
    for threshold in THRESHOLDS:
        scores |= contact_scores(nothing, in_frames, threshold)
    return {metric: scores.get(metric.removeprefix("contact_")) for metric in CONTACT_METRICS}


def _frames(recording: Sequence, protocol: str, split: str) -> range:
    if protocol == "unseen":
        return range(recording.frame_count)
    is_fitted = split == "reconstruction"
    return recording.reconstruction_frames if is_fitted else recording.future_frames


def _hand_figures(hands: Mapping[str, Any]) -> dict[str, Any]:
    """Average over the hands that have a figure."""
    means: dict[str, Any] = {}
    for key, name in _HANDS.items():
        values = [hand[key] for hand in hands.values() if isinstance(hand.get(key), float)]
        if values:
            means[name] = sum(values) / len(values)
    return means


def _times(seconds: Mapping[str, float], frame_count: int) -> dict[str, Any]:
    """Divide the time of each stage, and of all, by the number of video frames [s]."""
    times = {f"seconds_per_frame_{stage}": s / frame_count for stage, s in seconds.items()}
    return times | ({"seconds_per_frame": sum(times.values())} if times else {})
