"""A suite of two small sheets: what is computed once, what stands in, and what is written."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.inputs.sheet_sequence import FACES, FITTED
from support.server.suite_world import SETTINGS, order_of, table, write_told

from physhandi.data.sequence import Sequence
from physhandi.errors import MissingInputError, UsageError
from physhandi.progress import Progress
from physhandi.run import Run
from physhandi.synthetic.suite import evaluation
from physhandi.synthetic.suite.cells import Bench
from physhandi.synthetic.suite.evaluation import evaluate_suite, list_tasks
from physhandi.synthetic.suite.folder import contact_kind
from physhandi.synthetic.suite.methods import parse_method


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> tuple[Sequence, ...]:
    root = tmp_path_factory.mktemp("recordings")
    return write_told(root / "low", 0.12), write_told(root / "high", 0.2, "wipe")


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory, recordings: tuple[Sequence, ...]) -> Path:
    folder = tmp_path_factory.mktemp("suite")
    found = evaluate_suite(order_of(recordings), folder)
    assert (found["cells"], found["failed"], found["skipped"]) == (14, 0, [])
    return folder


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
    evaluate_suite(order_of(recordings), out, Listener())
    assert set(stages) == {"suite"}
    assert (out / "table.csv").read_bytes() == before


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
        assert evaluate_suite(order, tmp_path)["failed"] == 1
    rows = table(tmp_path)
    assert (
        rows[lost, "future", "track_error"]["mean"]
        == rows["static", "future", "track_error"]["mean"]
    )
    assert (lost, "runtime", "seconds_per_frame") not in rows
    # It touches nothing, where 2 of 25 nodes are held in every frame.
    for split in ("reconstruction", "future", "future/dense"):
        assert float(rows[lost, split, "contact_accuracy_5mm"]["mean"]) == pytest.approx(23 / 25)
        assert float(rows[lost, split, "contact_f1_10mm"]["mean"]) == 0.0
    assert ("static", "future", "contact_accuracy_5mm") not in rows
    report = (tmp_path / "report.md").read_text()
    assert f"{lost} (static stands in)" in report
    assert "connection_radius" in report.partition("## Missing output")[2]


def test_an_object_that_no_hand_reaches_elsewhere_stays_where_it_is(
    tmp_path: Path, recordings: tuple[Sequence, ...]
) -> None:
    low = recordings[0]
    far = write_told(tmp_path / "far", 0.15, "wipe")
    control = np.load(far.folder / "control.npy")
    np.save(far.folder / "control.npy", control + np.float32([0.0, 0.0, 0.3]))
    far = Sequence.load(far.folder)
    order = order_of((low, far), methods=("static", "quick"), protocols=("unseen",))
    for _ in range(2):  # What was fitted in `far` is lost as well.
        assert evaluate_suite(order, tmp_path / "out")["failed"] == 2
    cells = json.loads((tmp_path / "out" / "cells.json").read_text())["cells"]
    still, lost = [cell for cell in cells if cell["case"] == "far"]
    assert "No virtual spring forms in sequence 'far'" in lost["error"]
    assert lost["figures"]["unseen"].pop("contact_f1_5mm") == 0.0
    assert still["figures"]["unseen"].items() <= lost["figures"]["unseen"].items()


def test_what_a_recording_cannot_give_is_not_asked_for(
    tmp_path: Path, recordings: tuple[Sequence, ...]
) -> None:
    order = order_of(
        recordings[:1], methods=("static", "oracle_hand"), protocols=("main", "single_view")
    )
    found = evaluate_suite(order, tmp_path)
    assert found["cells"] == 1
    assert len(found["skipped"]) == 2
    assert "true hand" in found["skipped"][0]


def test_the_true_motion_is_the_floor_that_methods_are_told_above(
    tmp_path: Path, recordings: tuple[Sequence, ...]
) -> None:
    low, high = recordings
    folder = shutil.copytree(low.folder, tmp_path / low.name)
    marker = np.load(folder / "marker.npy")
    np.save(folder / "truth/object_point.npy", marker)
    np.save(folder / "truth/object_face.npy", FACES)
    order = order_of(
        (Sequence.load(folder), high),
        methods=("static", "true_motion"),
        protocols=("main",),
    )
    found = evaluate_suite(order, tmp_path / "out")
    assert found["cells"] == 3
    (skipped,) = found["skipped"]
    assert "true_motion, high" in skipped
    assert "truth/object_point.npy" in skipped
    rows = table(tmp_path / "out")
    for split in ("reconstruction", "future"):
        # Nodes are markers, so they are where the truth carries them.
        assert float(rows["true_motion", split, "marker_error"]["mean"]) < 1e-6
        assert float(rows["static", split, "marker_error"]["mean"]) > 0.01
    report = (tmp_path / "out/report.md").read_text()
    assert "Method less `true_motion`" in report.partition("## Above the floor")[2]
    about = json.loads((tmp_path / "out/cells.json").read_text())["about"]
    assert about["oracles"] == ["true_motion"]
    with (tmp_path / "out/paired.csv").open() as stream:
        pairs = [row for row in csv.DictReader(stream) if row["against"] == "true_motion"]
    (gap,) = [
        row
        for row in pairs
        if (row["method"], row["split"], row["metric"]) == ("static", "future", "marker_error")
    ]
    still = np.linalg.norm(marker[FITTED:] - marker[0], axis=2).mean()
    assert float(gap["difference"]) == pytest.approx(still, rel=1e-5)
    assert gap["n"] == "1"
    assert not list((tmp_path / "out/inputs").rglob("truth"))


def test_fits_with_several_seeds_of_the_search_are_told_as_a_mean(
    tmp_path: Path, recordings: tuple[Sequence, ...]
) -> None:
    order = order_of(
        recordings[:1],
        methods=("static", "quick", "quick+last_residual"),
        protocols=("main",),
        search_seeds=(1, 2),
        # A bad start, which every candidate beats in its own way.
        settings=SETTINGS | {"simulation.virtual_stiffness": 50.0, "object_.search.population": 4},
    )
    assert evaluate_suite(order, tmp_path)["cells"] == 5
    rows = table(tmp_path)
    for name in ("quick{}", "quick{}+last_residual"):
        seeds = [
            float(
                rows[name.format(f"@object_.search.seed={seed}"), "future", "track_error"]["mean"]
            )
            for seed in (1, 2)
        ]
        assert seeds[0] != seeds[1]
        mean = rows[name.format(""), "future", "track_error"]
        assert float(mean["mean"]) == pytest.approx(np.mean(seeds), rel=1e-6)
        assert float(mean["spread"]) == pytest.approx(abs(seeds[0] - seeds[1]) / 2**0.5, rel=1e-5)
    assert rows["static", "future", "track_error"]["spread"] == ""
    report = (tmp_path / "report.md").read_text()
    tables = report.partition("## Reconstruction")[2].partition("## Charts")[0]
    assert "| quick | " in tables
    assert " ± " in tables
    assert "search.seed" not in tables
    assert report.count("* `quick`: ") == 1
    assert "* `quick@" not in report
    assert "quick@object_.search.seed=2" in report.partition("## Every sequence")[2]
    # An order without seeds adds to the table and leaves the means in it.
    evaluate_suite(replace(order, methods=("rigid_follow",), search_seeds=()), tmp_path)
    place = ("quick", "future", "track_error")
    assert table(tmp_path)[place] == rows[place]


def test_starts_and_disturbances_have_splits_of_their_own(
    tmp_path: Path, recordings: tuple[Sequence, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    order = order_of(recordings, methods=("quick",), protocols=("sensitivity", "robustness"))
    tasks = list(list_tasks(order, (parse_method("quick"),)))
    # Seven starts of the first sequence, and three disturbances of both.
    starts = [task for task in tasks if task.protocol == "sensitivity"]
    assert [task.recording.name for task in starts] == ["low"] * 7
    assert len({task.split for task in starts}) == 7
    assert {"start δ=2 mm d_max=50", "start δ=40 mm d_max=3"} < {task.split for task in starts}
    assert len(tasks) == 7 + 2 * 3
    monkeypatch.setattr(evaluation, "SENSITIVITY", ((0.002, 50), (0.04, 3)))
    found = evaluate_suite(order, tmp_path)
    # Two starts; depth noise of both; no view to tell pixels, no hand.
    assert (found["cells"], len(found["skipped"])) == (2 + 2, 4)
    splits = {split for _, split, _ in table(tmp_path)}
    assert "start δ=2 mm d_max=50/reconstruction" in splits
    assert "noisy_depth/future" in splits
    cells = json.loads((tmp_path / "cells.json").read_text())["cells"]
    cells = [cell for cell in cells if cell["protocol"] == "sensitivity"]
    assert {(cell["case"], cell["method"]) for cell in cells} == {("low", "quick")}
    assert len({cell["run"] for cell in cells}) == 2


@pytest.mark.parametrize(("action", "kind"), [("squeeze", "dense"), ("lift", "point")])
def test_a_made_recording_tells_its_kind_of_contact_by_its_action(
    recordings: tuple[Sequence, ...], action: str, kind: str
) -> None:
    made = {"synthesize": {"object": "sheet", "action": action}}
    low = recordings[0]
    assert contact_kind(Sequence(low.folder, replace(low.meta, provenance=made))) == kind


def test_contact_is_dense_where_much_is_held(recordings: tuple[Sequence, ...]) -> None:
    low = Sequence(recordings[0].folder, replace(recordings[0].meta, provenance={}))
    assert contact_kind(low) == "dense"  # 2 of 25 nodes
    path = low.folder / "truth/contact.npy"
    held = np.load(path)
    held[:, 4] = False
    try:
        np.save(path, held)
        assert contact_kind(low) == "point"  # 1 of 25
        np.save(path, np.zeros_like(held))
        assert contact_kind(low) is None
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
            evaluate_suite(wrong, tmp_path)
    assert not list(tmp_path.iterdir())


def blind(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let nothing be seen in a sequence."""
    real = Bench.reference

    def reference(self: Bench, recording: Sequence) -> Run:
        if recording.name == name:
            raise MissingInputError(f"Sequence '{name}' shows no object.")
        return real(self, recording)

    monkeypatch.setattr(Bench, "reference", reference)


def test_a_recording_that_shows_nothing_is_named_and_the_others_are_scored(
    tmp_path: Path, recordings: tuple[Sequence, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    blind("low", monkeypatch)
    order = order_of(recordings, methods=("static", "rigid_follow"), protocols=("main", "unseen"))
    found = evaluate_suite(order, tmp_path)
    assert found["skipped"] == ["low: Sequence 'low' shows no object."]
    assert found["cells"] == 2
    assert table(tmp_path)["static", "future", "track_error"]["n"] == "1"
    assert (
        "Not asked for: low: Sequence 'low' shows no object."
        in (tmp_path / "report.md").read_text()
    )
    with pytest.raises(MissingInputError, match=r"No sequence can be evaluated.*shows no object"):
        evaluate_suite(replace(order, recordings=recordings[:1]), tmp_path / "blind")


def test_an_unseen_interaction_needs_the_same_body_in_another_action(
    tmp_path: Path, recordings: tuple[Sequence, ...]
) -> None:
    low = recordings[0]
    again = write_told(tmp_path / "again", 0.2)
    order = order_of((low, again), methods=("static",), protocols=("unseen",))
    found = evaluate_suite(order, tmp_path / "same")
    assert found["cells"] == 0
    assert found["skipped"] == [
        f"{name}, unseen: no other sequence shows the same body in another action."
        for name in ("low", "again")
    ]
    assert found["skipped"][0] in (tmp_path / "same/report.md").read_text()
    other = write_told(tmp_path / "other", 0.2, "wipe", seed=1)
    order, static = replace(order, recordings=(low, again, other)), (parse_method("static"),)
    assert [task.fitted for task in list_tasks(order, static)] == [None] * 3
    # Another generator may make another body of the same seed.
    provenance = {**low.provenance, "generator": "older"}
    old = Sequence(low.folder, replace(low.meta, name="old", provenance=provenance))
    order = replace(order, recordings=(old, recordings[1]))
    assert [task.fitted for task in list_tasks(order, static)] == [None, None]
    order = replace(order, recordings=(low, again, recordings[1]))
    assert [task.fitted for task in list_tasks(order, static)] == [recordings[1]] * 2 + [low]
