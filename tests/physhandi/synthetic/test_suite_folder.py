"""What a suite's folder keeps: tables on the way, of fewer methods, and of other orders."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.server.suite_world import order_of, table, write_told

from physhandi.data.sequence import Sequence
from physhandi.errors import CancelledError, UsageError
from physhandi.progress import Progress
from physhandi.synthetic.code_version import generator_version
from physhandi.synthetic.suite import evaluation
from physhandi.synthetic.suite.cells import Bench
from physhandi.synthetic.suite.evaluation import evaluate_suite


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> tuple[Sequence, ...]:
    root = tmp_path_factory.mktemp("recordings")
    return write_told(root / "low", 0.12), write_told(root / "high", 0.2, "wipe")


def test_what_was_cancelled_goes_on(tmp_path: Path, recordings: tuple[Sequence, ...]) -> None:
    class Stopper(Progress):
        def report(self, stage: str, *rest: Any, **more: Any) -> None:
            if stage == "zeroth_order":
                raise CancelledError("enough")

    order = order_of(recordings[:1], methods=("static", "quick"), protocols=("main",))
    with pytest.raises(CancelledError):
        evaluate_suite(order, tmp_path, Stopper())
    assert {method for method, *_ in table(tmp_path)} == {"static"}
    assert "**Not finished**: 1 cells are missing" in (tmp_path / "report.md").read_text()
    (static,) = (tmp_path / "cells").glob("low-static-*")
    published = (static / "current").stat().st_mtime_ns
    assert evaluate_suite(order, tmp_path)["cells"] == 2
    assert "Not finished" not in (tmp_path / "report.md").read_text()
    assert (static / "current").stat().st_mtime_ns == published
    assert ("quick", "future", "track_error") in table(tmp_path)


def test_tables_are_written_after_each_protocol_and_survive_a_crash(
    tmp_path: Path, recordings: tuple[Sequence, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[bool] = []

    def crash(*_: Any) -> None:
        seen.append((tmp_path / "table.csv").is_file())
        raise RuntimeError("out of luck")

    monkeypatch.setattr(Bench, "unseen", crash)
    order = order_of(recordings, methods=("static", "rigid_follow"))
    with pytest.raises(RuntimeError, match="out of luck"):
        evaluate_suite(order, tmp_path)
    assert seen == [True]
    assert table(tmp_path)["rigid_follow", "future", "track_error"]["n"] == "2"
    assert "**Not finished**: 4 cells" in (tmp_path / "report.md").read_text()


def test_tables_are_written_on_the_way_and_an_order_of_fewer_methods_keeps_what_was_known(
    tmp_path: Path, recordings: tuple[Sequence, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    known: list[int] = []

    class Listener(Progress):
        def report(self, stage: str, iteration: int, *rest: Any, **more: Any) -> None:
            if stage == "suite":
                file = tmp_path / "cells.json"
                known.append(len(json.loads(file.read_text())["cells"]) if file.is_file() else 0)

    whole = order_of(recordings, methods=("static", "rigid_follow"))
    with monkeypatch.context() as patch:
        patch.setattr(evaluation, "WRITE_EVERY", -1.0)
        evaluate_suite(whole, tmp_path, Listener())
    # Told before each cell; the last one is written at the end.
    assert known == [*range(8), 7]
    before = (tmp_path / "table.csv").read_bytes()
    report = (tmp_path / "report.md").read_text().partition("## Computed with")[0]
    evaluate_suite(replace(whole, methods=("rigid_follow",), protocols=("main",)), tmp_path)
    assert (tmp_path / "table.csv").read_bytes() == before
    assert (tmp_path / "report.md").read_text().partition("## Computed with")[0] == report
    curves = json.loads((tmp_path / "curves.json").read_text())["curves"]
    cells = json.loads((tmp_path / "cells.json").read_text())["cells"]
    assert len(curves) == len(cells) == 8
    assert all(curve["track_error"] for curve in curves)
    assert not any("curves" in cell for cell in cells)
    # A run that was deleted has no place in the table.
    (gone,) = (tmp_path / "cells").glob("high-rigid_follow-*")
    shutil.rmtree(gone)
    evaluate_suite(replace(whole, methods=("static",)), tmp_path)
    assert table(tmp_path)["rigid_follow", "future", "track_error"]["n"] == "1"


def test_methods_that_were_computed_otherwise_are_named_when_they_leave_the_table(
    tmp_path: Path, recordings: tuple[Sequence, ...]
) -> None:
    order = order_of(recordings[:1], methods=("static", "rigid_follow"), protocols=("main",))
    evaluate_suite(order, tmp_path)
    found = evaluate_suite(
        replace(order, methods=("static",), settings={"node_spacing": 0.5}), tmp_path
    )
    assert "rigid_follow" in found["notes"][0]
    assert "rigid_follow. Evaluate them again" in (tmp_path / "report.md").read_text()
    assert {method for method, *_ in table(tmp_path)} == {"static"}


def test_a_folder_with_the_table_of_other_sequences_is_refused(
    tmp_path: Path, recordings: tuple[Sequence, ...]
) -> None:
    order = order_of(recordings[:1], methods=("static",), protocols=("main",))
    evaluate_suite(order, tmp_path)
    before = (tmp_path / "cells.json").read_bytes()
    for other in (replace(order, recordings=recordings), replace(order, title="Suite dev")):
        with pytest.raises(UsageError, match=r"holds the table 'Two sheets' of low.*another --out"):
            evaluate_suite(other, tmp_path)
    assert (tmp_path / "cells.json").read_bytes() == before
    (tmp_path / "cells.json").write_text('{"about": {}}')
    with pytest.raises(UsageError, match=r"cells\.json is damaged"):
        evaluate_suite(order, tmp_path)


def test_a_sequence_called_like_a_split_has_a_chart_of_its_own(tmp_path: Path) -> None:
    order = order_of(
        (write_told(tmp_path / "future", 0.1),), methods=("static",), protocols=("main",)
    )
    evaluate_suite(order, tmp_path / "out")
    charts = json.loads((tmp_path / "out/cells.json").read_text())["about"]["charts"]
    assert charts == ["reconstruction.svg", "future.svg", "sequence_future.svg"]
    bars, lines = ((tmp_path / "out/charts" / name).read_text() for name in charts[1:])
    assert "CD_full, future" in bars
    assert "Track error on future" in lines


def test_the_report_tells_how_to_make_it_again_and_marks_reserved_seeds(tmp_path: Path) -> None:
    for seed, is_marked in ((3, False), (1000, True)):
        folder = tmp_path / f"of_{seed}"
        recording = write_told(folder / "sheet", 0.1, seed=seed)
        order = order_of((recording,), methods=("static",), protocols=("main", "main"))
        order = replace(order, command="physhandi evaluate suite --suite dev")
        assert evaluate_suite(order, folder / "out")["cells"] == 1
        report = (folder / "out/report.md").read_text()
        for line in (
            "* command: `physhandi evaluate suite --suite dev`\n",
            f"* seeds: {seed}\n",
            "* presets: clean\n",
            f"* generators: {generator_version()}\n",
        ):
            assert line in report
        assert report.startswith("# Two sheets (verification)\n") is is_marked
        assert ("## Reconstruction and future prediction (verification)" in report) is is_marked


def test_recordings_of_another_generator_are_told_in_log_and_report(
    tmp_path: Path, recordings: tuple[Sequence, ...], caplog: pytest.LogCaptureFixture
) -> None:
    low = recordings[0]
    provenance = {**low.provenance, "generator": "0123456789ab-mujoco-1.0"}
    old = Sequence(low.folder, replace(low.meta, provenance=provenance))
    order = order_of((old,), methods=("static",), protocols=("main",))
    (note,) = evaluate_suite(order, tmp_path)["notes"]
    assert "0123456789ab-mujoco-1.0" in note
    assert note in caplog.text
    assert f"**Note**: {note}" in (tmp_path / "report.md").read_text()
