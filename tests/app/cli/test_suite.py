"""`physhandi evaluate suite`, as a user calls it."""

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from app import cli
from physhandi.data.sequence import Sequence
from physhandi.data.truth import read_truth
from physhandi.run import Run
from physhandi.synthetic.code_version import generator_version
from physhandi.synthetic.suite.suite import FLOOR, SUITES, SuiteScene, find_suite


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        cli.main(["evaluate", "suite", *(str(argument) for argument in arguments)])
    return (int(end.value.code or 0), *capsys.readouterr())


def rows_of(path: Path) -> dict[tuple[str, str, str], float]:
    with path.open() as stream:
        lines = list(csv.DictReader(stream))
    return {(r["method"], r["split"], r["metric"]): float(r["mean"]) for r in lines}


def test_named_sequences_are_evaluated_where_the_server_finds_them(
    data_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    order = ("--sequences", "sheet", "--methods", "static", "rigid_follow", "--device", "cpu")
    code, out, _ = call(capsys, *order, "--json", "--data-dir", data_dir)
    assert code == 0
    found = json.loads(out)
    assert (found["cells"], found["failed"]) == (2, 0)
    folder = Path(found["out"])
    assert folder.parent == data_dir.resolve() / "suites"
    assert re.fullmatch(r"sheet-[0-9a-f]{8}", folder.name)
    assert Path(found["table"]) == folder / "table.csv"
    rows = rows_of(Path(found["table"]))
    assert rows["static", "future", "track_error"] > 0.03
    report = Path(found["report"]).read_text()
    assert (
        "* command: `physhandi evaluate suite --methods static rigid_follow "
        "--sequences sheet --device cpu`" in report
    )
    # Nothing cuts methods' own effort down unless a suite is named.
    assert "settings that all methods share: node_spacing = 0.01\n" in report
    code, out, _ = call(
        capsys,
        "--suite",
        "tiny",
        *order,
        "--json",
        "--data-dir",
        data_dir,
        "--out",
        folder / "tiny",
    )
    assert code == 0
    assert "object_.search.generations = 2" in Path(json.loads(out)["report"]).read_text()


def test_other_sequences_have_a_folder_of_their_own_and_no_other_gets_their_table(
    data_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = shutil.copytree(data_dir / "sequences/sheet", data_dir / "sequences/other")
    content = (other / "sequence.yaml").read_text()
    (other / "sequence.yaml").write_text(content.replace("name: sheet", "name: other"))
    plain = ("--methods", "static", "--device", "cpu", "--json", "--data-dir", data_dir)
    folders = set()
    for names in (("sheet",), ("sheet", "other"), (data_dir / "sequences/sheet",)):
        code, out, error = call(capsys, "--sequences", *names, *plain)
        assert code == 0, error
        folders.add(json.loads(out)["out"])
    assert len(folders) == 2  # By name or by folder, it is the same sequence.
    out = next(Path(folder) for folder in folders if "more" not in folder)
    code, _, error = call(capsys, "--suite", "tiny", *plain, "--out", out)
    assert code == 2
    assert "holds the table 'Named sequences' of sheet" in error
    assert not (out / "sequences").exists()


def test_help_tells_what_is_taken_by_default(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = call(capsys, "--help")
    assert code == 0
    said = " ".join(out.replace("│", " ").split())  # Wherever lines end.
    assert said.count("(default: the suite's") == 4
    assert "(default: )" not in said


def test_an_order_says_how_many_splats_show_an_object_and_0_compares_no_pictures(
    data_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    order = ("--sequences", "sheet", "--methods", "static", "--device", "cpu", "--json")
    for count, told in ((0, "appearance.enabled = False"), (40, "appearance.splat_count = 40")):
        out = data_dir / f"with_{count}"
        place = ("--data-dir", data_dir, "--out", out, "--splats", count)
        assert call(capsys, *order, *place)[0] == 0
        report = (out / "report.md").read_text()
        assert f"--splats {count} --sequences sheet" in report
        assert f"settings that all methods share: node_spacing = 0.01, {told}\n" in report


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--sequences", "sheet", "--methods", "magic"), "no method 'magic'"),
        (("--sequences", "sheet", "--seeds", "1"), "--seeds belongs"),
        (("--sequences", "nowhere"), "'nowhere' is neither"),
        (("--suite", "tiny", "--seeds", "-3"), "negative"),
        (("--suite", "tiny", "--jobs", "0"), "--jobs 0 makes no sense; choose 1 to 64"),
        (("--suite", "tiny", "--methods", "quick@nothing=1"), "nothing"),
        (("--sequences", "sheet", "--splats", "-1"), "appearance.splat_count is -1"),
    ],
)
def test_an_order_that_makes_no_sense_writes_nothing(
    data_dir: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], told: str
) -> None:
    code, out, error = call(capsys, *arguments, "--data-dir", data_dir, "--device", "cpu")
    assert (code, out) == (2, "")
    assert told in error
    assert "Traceback" not in error
    assert not (data_dir / "suites").exists()


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_tiny_suite_is_made_by_one_command_and_taken_up_by_the_next(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mujoco")
    out = tmp_path / "tiny"
    order = ("--suite", "tiny", "--out", out, "--device", "cpu")
    tiny = find_suite("tiny")
    tiny = replace(
        tiny,
        methods=("static", "quick", FLOOR, "oracle_hand"),
        scenes=(SuiteScene(object_="rope", action="lift"),),  # MuJoCo's cloth takes thrice as long.
        settings={**tiny.settings, "node_spacing": 0.012, "simulation.connection_radius": 0.02},
        recording={**tiny.recording, "frames": 18},
    )
    monkeypatch.setitem(SUITES, "tiny", tiny)
    # The process that makes the sequence fills the only cell, too.
    code, told, error = call(capsys, *order, "--methods", "static", "--jobs", "2", "--json")
    assert code == 0, error
    assert json.loads(told)["seconds"] > 1
    command = "evaluate suite --suite tiny --methods static --jobs 2 --device cpu"
    assert command in (out / "report.md").read_text()
    alone = rows_of(out / "table.csv")
    # What follows is computed here, where all that computes is imported already.
    code, _, error = call(capsys, *order)
    assert code == 0, error
    rows = rows_of(out / "table.csv")
    assert alone.items() <= rows.items()  # What was known stays.
    assert tuple(dict.fromkeys(method for method, *_ in rows)) == tiny.methods
    still = rows["static", "future", "track_error"]  # Until then it has hardly moved.
    assert still > 0.004
    for method in ("quick", "oracle_hand"):  # Another engine made it: true hands are not perfect.
        assert 0.001 < rows[method, "future", "track_error"] < 0.5 * still
    for split in ("reconstruction", "future"):
        # Nodes carried by the truth miss what was observed by their spacing alone.
        assert rows["true_motion", split, "track_error"] < 0.001
        floor = rows["true_motion", split, "chamfer_phystwin"]
        assert 0.001 < floor < rows["quick", split, "chamfer_phystwin"]
    assert 0.001 < rows["quick", "hands", "mpjpe"] < 0.02
    (folder,) = (out / "sequences").iterdir()
    sequence = Sequence.load(folder)
    assert sequence.provenance["generator"] == generator_version()
    assert (out / "report.md").read_text().count(generator_version()) == 1
    contact_point = read_truth(folder).contact_point
    assert contact_point is not None
    assert 50 < len(contact_point) <= 441
    fits = list((out / "cells").glob(f"{sequence.name}-*"))
    # Where an oracle has true hands, the object that stays has them, too.
    assert sorted(fit.name.split("-")[1] for fit in fits) == sorted([*tiny.methods, "static"])
    assert {Run.open(fit).attempt for fit in fits} == {1}
    for fit in fits:
        nodes = Run.open(fit).array(f"sequences/{sequence.name}/rollout.npy").shape[1]
        assert 50 < nodes <= 441
    shutil.rmtree(out)
