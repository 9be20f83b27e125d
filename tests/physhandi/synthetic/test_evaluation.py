"""A suite of two small sheets: what is computed once, what stands in, and what is written."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sheet_sequence import FITTED, FRAMES, NODE, write_sheet

from physhandi.data.run import Run
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_schema import SequenceMeta
from physhandi.data.sequence_writer import write_sequence
from physhandi.errors import CancelledError, UsageError
from physhandi.progress import Progress
from physhandi.synthetic.evaluation import Order, evaluate
from physhandi.synthetic.suite_scores import contact_kind

SETTINGS = {
    "object_.search.generations": 1,
    "object_.search.population": 2,
    "object_.first_order.iterations": 1,
    "object_.first_order.window": None,
    "simulation.connection_radius": 0.08,
    "simulation.virtual_connection_radius": 0.02,
    "simulation.stiffness": 400.0,
    "simulation.virtual_stiffness": 2000.0,
    "object_.search.variables.connection_radius": {"low": 0.06, "high": 0.12, "scale": "linear"},
    "object_.search.variables.virtual_connection_radius": {
        "low": 0.01,
        "high": 0.04,
        "scale": "linear",
    },
}
METHODS = ("static", "rigid_follow", "quick", "quick+last_residual")


def write_told(folder: Path, lift: float) -> Sequence:
    """A sheet that tells its object, and by labels that two of its nodes are held."""
    plain = write_sheet(folder / "plain", lift=lift)
    names = ("control", "marker", "marker_node", "object_node", "rest_node")
    arrays = {f"{name}.npy": np.load(plain.folder / f"{name}.npy") for name in names}
    held = np.zeros((FRAMES, len(NODE)), bool)
    held[:, [0, 4]] = True
    arrays |= {"truth/contact_point.npy": NODE.astype(np.float32), "truth/contact.npy": held}
    meta: SequenceMeta = replace(
        plain.meta, name=folder.name, provenance={"synthesize": {"object": "sheet", "seed": 0}}
    )
    return write_sequence(folder / folder.name, meta, arrays)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> tuple[Sequence, ...]:
    root = tmp_path_factory.mktemp("recordings")
    return write_told(root / "low", 0.12), write_told(root / "high", 0.2)


def order_of(recordings: tuple[Sequence, ...], **changes: Any) -> Order:
    fields = {"methods": METHODS, "settings": SETTINGS, "protocols": ("main", "unseen")}
    return Order(title="Two sheets", recordings=recordings, **(fields | changes))


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory, recordings: tuple[Sequence, ...]) -> Path:
    folder = tmp_path_factory.mktemp("suite")
    found = evaluate(order_of(recordings), folder)
    assert (found["cells"], found["failed"], found["skipped"]) == (14, 0, [])
    return folder


def table(out: Path) -> dict[tuple[str, str, str], dict[str, str]]:
    with (out / "table.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    return {(row["method"], row["split"], row["metric"]): row for row in rows}


def test_the_figures_are_those_of_the_runs_averaged_by_hand(
    out: Path, recordings: tuple[Sequence, ...]
) -> None:
    rows = table(out)
    for method, low, high in (("static", 0.05, 0.5), ("quick", 0.001, 0.06)):
        errors = []
        for recording in recordings:
            (folder,) = (out / "cells").glob(f"{recording.name}-{method}-*")
            rollout = Run.open(folder).array(f"sequences/{recording.name}/rollout.npy")
            gap = np.linalg.norm(rollout - np.asarray(recording.marker), axis=2)
            errors.append(gap[FITTED:].mean())
        row = rows[method, "future", "marker_error"]
        assert float(row["mean"]) == pytest.approx(np.mean(errors), rel=1e-5)
        assert float(row["low"]) == pytest.approx(min(errors), rel=1e-5)
        assert float(row["high"]) == pytest.approx(max(errors), rel=1e-5)
        assert row["n"] == "2"
        assert low < np.mean(errors) < high


def test_every_protocol_and_part_has_its_split(out: Path) -> None:
    rows = table(out)
    assert {split for _, split, _ in rows} == {
        *("reconstruction", "future", "unseen", "topology", "runtime"),
        *("reconstruction/dense", "future/dense"),
    }
    whole = rows["quick", "future", "track_error"]
    assert rows["quick", "future/dense", "track_error"]["mean"] == whole["mean"]
    assert ("quick+last_residual", "unseen", "track_error") not in rows
    assert float(rows["quick", "runtime", "seconds_per_frame"]["mean"]) > 0


def test_the_last_residual_changes_the_future_alone(out: Path) -> None:
    rows = table(out)
    for split, is_same in (("reconstruction", True), ("future", False)):
        plain = rows["quick", split, "track_error"]["mean"]
        assert (rows["quick+last_residual", split, "track_error"]["mean"] == plain) is is_same


def test_an_unseen_interaction_is_simulated_with_the_object_of_another_sequence(
    out: Path, recordings: tuple[Sequence, ...]
) -> None:
    cells = json.loads((out / "cells.json").read_text())["cells"]
    (cell,) = [
        c for c in cells if (c["method"], c["case"], c["protocol"]) == ("quick", "high", "unseen")
    ]
    run = Run.open(out / "cells" / cell["run"])
    assert run.kind == "simulation"
    assert Path(run.config["source"]).name.startswith("low-quick-")
    rollout = run.array("sequences/high/rollout.npy")
    gap = np.linalg.norm(rollout - np.asarray(recordings[1].marker), axis=2)
    assert cell["figures"]["unseen"]["marker_error"] == pytest.approx(gap[1:].mean(), rel=1e-5)
    assert gap[1:].mean() < 0.06


def test_no_method_sees_the_truth(out: Path) -> None:
    inputs = list((out / "inputs").rglob("*.npy"))
    assert inputs
    assert not [path for path in inputs if "truth" in path.parts]


def test_a_second_time_nothing_is_computed(out: Path, recordings: tuple[Sequence, ...]) -> None:
    stages: list[str] = []

    class Listener(Progress):
        def report(self, stage: str, *rest: Any, **more: Any) -> None:
            stages.append(stage)

    before = (out / "table.csv").read_bytes()
    evaluate(order_of(recordings), out, Listener())
    assert set(stages) == {"suite"}
    assert (out / "table.csv").read_bytes() == before


def test_what_was_cancelled_goes_on(tmp_path: Path, recordings: tuple[Sequence, ...]) -> None:
    class Stopper(Progress):
        def report(self, stage: str, *rest: Any, **more: Any) -> None:
            if stage == "zeroth_order":
                raise CancelledError("enough")

    order = order_of(recordings[:1], methods=("static", "quick"), protocols=("main",))
    with pytest.raises(CancelledError):
        evaluate(order, tmp_path, Stopper())
    assert not (tmp_path / "table.csv").exists()
    (static,) = (tmp_path / "cells").glob("low-static-*")
    published = (static / "current").stat().st_mtime_ns
    assert evaluate(order, tmp_path)["cells"] == 2
    assert (static / "current").stat().st_mtime_ns == published
    assert ("quick", "future", "track_error") in table(tmp_path)


def test_a_method_without_output_scores_as_static_and_is_told(
    tmp_path: Path, recordings: tuple[Sequence, ...]
) -> None:
    # No spring is short enough to be found, so there is nothing to search.
    lost = "quick@simulation.connection_radius=0.01"
    radius = "object_.search.variables.connection_radius"
    settings = SETTINGS | {radius: {"low": 0.001, "high": 0.02, "scale": "linear"}}
    order = order_of(
        recordings[:1], methods=("static", lost), settings=settings, protocols=("main",)
    )
    for _ in range(2):
        assert evaluate(order, tmp_path)["failed"] == 1
    rows = table(tmp_path)
    assert (
        rows[lost, "future", "track_error"]["mean"]
        == rows["static", "future", "track_error"]["mean"]
    )
    assert (lost, "runtime", "seconds_per_frame") not in rows
    report = (tmp_path / "report.md").read_text()
    assert f"{lost} (static stands in)" in report
    assert "connection_radius" in report.partition("## Missing output")[2]


def test_an_object_that_no_hand_reaches_elsewhere_stays_where_it_is(
    tmp_path: Path, recordings: tuple[Sequence, ...]
) -> None:
    low = recordings[0]
    far = write_told(tmp_path / "far", 0.15)
    control = np.load(far.folder / "control.npy")
    np.save(far.folder / "control.npy", control + np.float32([0.0, 0.0, 0.3]))
    far = Sequence.load(far.folder)
    order = order_of((low, far), methods=("static", "quick"), protocols=("unseen",))
    for _ in range(2):  # What was fitted in `far` is lost as well.
        assert evaluate(order, tmp_path / "out")["failed"] == 2
    cells = json.loads((tmp_path / "out" / "cells.json").read_text())["cells"]
    still, lost = [cell for cell in cells if cell["case"] == "far"]
    assert "No virtual spring forms in sequence 'far'" in lost["error"]
    assert lost["figures"]["unseen"] == still["figures"]["unseen"]


def test_what_a_recording_cannot_give_is_not_asked_for(
    tmp_path: Path, recordings: tuple[Sequence, ...]
) -> None:
    order = order_of(
        recordings[:1], methods=("static", "oracle_hand"), protocols=("main", "single_view")
    )
    found = evaluate(order, tmp_path)
    assert found["cells"] == 1
    assert len(found["skipped"]) == 2
    assert "true hand" in found["skipped"][0]


def test_starts_and_disturbances_have_splits_of_their_own(
    tmp_path: Path, recordings: tuple[Sequence, ...]
) -> None:
    order = order_of(
        recordings, methods=("static", "quick"), protocols=("sensitivity", "robustness")
    )
    found = evaluate(order, tmp_path)
    # Seven starts of the first sequence; depth noise of both; no view to tell pixels, no hand.
    assert (found["cells"], len(found["skipped"])) == (7 + 4, 8)
    splits = {split for _, split, _ in table(tmp_path)}
    assert "start δ=2 mm d_max=50/reconstruction" in splits
    assert "noisy_depth/future" in splits
    cells = json.loads((tmp_path / "cells.json").read_text())["cells"]
    starts = [cell for cell in cells if cell["protocol"] == "sensitivity"]
    assert {(cell["case"], cell["method"]) for cell in starts} == {("low", "quick")}
    assert len({cell["run"] for cell in starts}) == 7


@pytest.mark.parametrize(("action", "kind"), [("squeeze", "dense"), ("lift", "point")])
def test_a_made_recording_tells_its_kind_of_contact_by_its_action(
    recordings: tuple[Sequence, ...], action: str, kind: str
) -> None:
    made = {"synthesize": {"object": "sheet", "action": action}}
    low = recordings[0]
    assert contact_kind(Sequence(low.folder, replace(low.meta, provenance=made))) == kind


def test_contact_is_dense_where_much_is_held(recordings: tuple[Sequence, ...]) -> None:
    assert contact_kind(recordings[0]) == "dense"  # 2 of 25 nodes
    path = recordings[0].folder / "truth/contact.npy"
    held = np.load(path)
    held[:, 4] = False
    try:
        np.save(path, held)
        assert contact_kind(recordings[0]) == "point"  # 1 of 25
        np.save(path, np.zeros_like(held))
        assert contact_kind(recordings[0]) is None
    finally:
        held[:, 4] = True
        np.save(path, held)


def test_an_order_that_makes_no_sense_is_refused(
    tmp_path: Path, recordings: tuple[Sequence, ...]
) -> None:
    low = recordings[0]
    for wrong, told in (
        (order_of(()), "at least one sequence"),
        (order_of((low, low)), "Two sequences are named 'low'"),
        (order_of((low,), methods=("magic",)), "no method 'magic'"),
        (order_of((low,), settings={"node_spacin": 1.0}), "node_spacin"),
    ):
        with pytest.raises(UsageError, match=told):
            evaluate(wrong, tmp_path)
    assert not list(tmp_path.iterdir())
