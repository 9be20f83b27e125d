"""The command line: what it prints, what it writes and how it exits."""

import json
import re
import shutil
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from command_line_page import PAGE, bare, commands, is_positional, page
from support.inputs.sheet_sequence import FRAMES, NODE, write_sheet
from support.server.server_world import tiny_config

from app import cli
from app.cli import runs
from app.cli.lookup import read_settings
from app.settings import BUNDLED
from physhandi import pipeline
from physhandi.data.run import RunFolder
from physhandi.data.sequence import Sequence
from physhandi.errors import UsageError
from physhandi.fitting.artefacts import load_model, load_parameters
from physhandi.fitting.config import PipelineConfig
from physhandi.run import Run
from physhandi.simulation.stability import LONGEST_STEP, SAFETY, largest_stable_step

SHIPPED = ", ".join(sorted(path.parent.name for path in BUNDLED.glob("*/sequence.yaml")))
"""Names of the sequences that came with the program."""


class Terminal:
    """Calls the command line in a folder of its own."""

    def __init__(self, data_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.data_dir = data_dir
        self._capsys = capsys
        self.out = self.error = ""

    def __call__(self, *arguments: object) -> int:
        self._capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            cli.main([str(argument) for argument in arguments])
        self.out, self.error = self._capsys.readouterr()
        return int(end.value.code or 0)

    def refused(self, code: int, *arguments: object) -> str:
        """Call what must fail with one clear line; returns the line."""
        assert self(*arguments) == code
        assert "Traceback" not in self.error
        last = self.error.splitlines()[-1]
        assert last.startswith("physhandi: "), self.error
        assert self.out == ""
        return last


@pytest.fixture
def terminal(
    data_dir: Path,
    fitted_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Terminal:
    shutil.copytree(fitted_folder, data_dir / "runs" / "fitted")
    monkeypatch.chdir(data_dir.parent)
    return Terminal(data_dir, capsys)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> PipelineConfig:
    """Make the quick profile quicker."""
    config = tiny_config()
    monkeypatch.setattr(runs, "load_profile", lambda _: config)
    return config


@pytest.mark.parametrize(
    "arguments",
    [
        ["fly"],
        [],
        ["export", "fitted", "--format", "pkl", "--out", "x"],
        ["export", "fitted", "--format", "npz"],
        ["simulate", "fitted", "--out", "x", "--drag", "much"],
        ["simulate", "fitted", "--out", "x", "--substeps-per-frame", "few"],
        ["serve", "--port", "many"],
        ["doctor", "--nonsense"],
    ],
)
def test_bad_usage_exits_with_2_and_says_how_it_goes(
    terminal: Terminal, arguments: list[str]
) -> None:
    assert terminal(*arguments) == 2
    assert "Traceback" not in terminal.error + terminal.out
    assert "--help" in terminal.error + terminal.out
    assert not Path("x").exists()


def test_help_names_every_command_and_exits_with_0(terminal: Terminal) -> None:
    assert terminal("--help") == 0
    for command in (
        "serve",
        "reconstruct",
        "simulate",
        "evaluate",
        "synthesize",
        "import",
        "export",
        "check",
        "benchmark",
        "doctor",
    ):
        assert command in terminal.out
    assert terminal("simulate", "--help") == 0
    assert "--connection-radius" in terminal.out
    assert "δ: object nodes nearer than this get a spring" in terminal.out


def test_help_shows_what_may_be_left_out_by_what_it_takes(terminal: Terminal) -> None:
    names = [name for name, _ in commands(cli.build())]
    assert {"simulate", "import capture", "benchmark live"} <= set(names)
    for name in names:
        assert terminal(*name.split(), "--help") == 0
        assert "{None" not in terminal.out, name
        assert not re.search(r"\(default:[\s│]+None", terminal.out), name
    assert terminal("simulate", "--help") == 0
    for shown in ("--out PATH ", "--drag FLOAT ", "--self-collision {True,False}", "INT|{auto}"):
        assert shown in terminal.out
    assert re.search(r"\(default:[\s│]+none\)", terminal.out)
    # None may be typed all the same, and no option takes it for a word.
    typed = ("--drag", "--substeps-per-frame", "--self-collision", "--edits", "--out", "--data-dir")
    given = (word for option in typed for word in (option, "None"))
    assert "'nothing' is neither a run folder" in terminal.refused(1, "simulate", "nothing", *given)
    assert terminal("simulate", "nothing", "--drag", "much") == 2


def test_the_doctor_finds_all_well(terminal: Terminal) -> None:
    assert terminal("doctor") == 0
    lines = terminal.out.splitlines()
    assert [line.split()[0] for line in lines] == ["ok"] * len(lines)
    assert any("towel_fold" in line and "sheet" in line for line in lines)
    assert "falling node" in terminal.out


def test_the_doctor_names_what_is_wrong(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    def absent(side: str) -> None:
        raise FileNotFoundError(f"{side} hand is not there")

    monkeypatch.setattr("physhandi.hand.loading.load_hand_model", absent)
    assert terminal("doctor") == 1
    assert "FAIL  hand: right hand is not there" in terminal.out


def test_a_fit_is_made_told_and_not_made_twice(terminal: Terminal, quick: PipelineConfig) -> None:
    order = ("reconstruct", "sheet", "--out", "mine", "--profile", "quick", "--device", "cpu")
    assert terminal(*order) == 0
    run = Run.open("mine")
    assert (run.state, run.name, run.sequence_names) == ("succeeded", "mine", ["sheet"])
    losses = run.json("losses.json")["first_order"]
    assert f"after: {losses['after']:.6g}" in terminal.out
    assert "first order" in terminal.error.replace("_", " ")
    assert "finished" in terminal.refused(2, *order)
    other = ("reconstruct", "sheet", "sheet", "--out", "mine", "--device", "cpu")
    assert "another run" in terminal.refused(2, *other)
    assert Run.open("mine").state == "succeeded"


def test_a_fit_takes_a_profile_file_and_single_settings(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Mapping[str, Any]] = []

    def keep(run: RunFolder, _progress: object, **devices: object) -> None:
        made.append(run.config)
        assert devices == {"device": "cpu", "more_devices": (), "store": None}

    monkeypatch.setattr(pipeline, "run_job", keep)
    Path("mine.yaml").write_text("base: quick\nnode_spacing: 0.03\n")
    settings = ("--set", "object_.search.variables.stiffness.high=1e6", "--set", "control_count=7")
    order = ("reconstruct", "sheet", "--out", "mine", "--profile", "mine.yaml", "--device", "cpu")
    assert terminal(*order, *settings) == 0
    stored = PipelineConfig.from_dict(made[0]["profile"])
    assert (stored.profile, stored.node_spacing, stored.control_count) == ("mine", 0.03, 7)
    assert stored.object_.search.variables["stiffness"].high == 1e6
    assert set(made[0]["overrides"]) == {"control_count", "object_.search.variables.stiffness"}
    wrong = ("--set", "simulation.frictio=1", "--set", "node_spacing=9")
    line = terminal.refused(2, *order[:3], "other", *order[4:], *wrong)
    assert "Do you mean 'simulation.friction'" in line
    assert "node_spacing is 9; expected a number from 0.001 to 0.5" in line


def test_an_interrupted_fit_goes_on(terminal: Terminal, quick: PipelineConfig) -> None:
    order = ("reconstruct", "sheet", "--out", "mine", "--device", "cpu")
    original = pipeline.fit_steady_springs

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "fit_steady_springs", interrupt)
        assert terminal(*order) == 130
    assert terminal.error.splitlines()[-1] == "physhandi: interrupted"
    assert Run.open("mine").state == "cancelled"
    assert pipeline.fit_steady_springs is original
    assert terminal(*order, "--store", f"file://{Path.cwd()}/store") == 0
    assert "first_order" in terminal.error
    assert "zeroth_order" not in terminal.error
    # What was published in the store, too, comes back as a run of the data folder.
    assert terminal("import", "run", f"file://{Path.cwd()}/store/mine") == 0
    again = Run.open(terminal.data_dir / "runs" / "mine")
    again.verify()
    assert again.metrics == Run.open("mine").metrics
    line = terminal.refused(1, "import", "run", f"file://{Path.cwd()}/store/other")
    assert "there is none that is published" in line
    line = terminal.refused(2, *order[:3], "next", "--store", "nonsense://x")
    assert "The store nonsense://x cannot be used" in line
    assert not Path("next").exists()


def test_an_error_stands_on_a_line_of_its_own_below_the_progress(
    terminal: Terminal, quick: PipelineConfig
) -> None:
    folder = terminal.data_dir / "sequences" / "sheet"
    (folder / "marker.npy").unlink()
    (folder / "marker_node.npy").unlink()
    line = terminal.refused(1, "reconstruct", "sheet", "--out", "mine", "--device", "cpu")
    assert "'sheet' lacks depth, mask" in line


@pytest.mark.parametrize(
    ("arguments", "code", "reason"),
    [
        (["reconstruct", "nowhere", "--out", "x"], 2, f"Known are: sheet, {SHIPPED}"),
        (["reconstruct", "--out", "x"], 2, "at least one sequence"),
        (["reconstruct", "sheet", "--out", "x", "--profile", "fastest"], 2, "Choose one of"),
        (["reconstruct", "sheet", "--out", "x", "--device", "abacus"], 2, "no device 'abacus'"),
        (["reconstruct", "sheet", "--out", "a.b"], 1, "cannot name a run"),
        (["simulate", "nothing", "--out", "x"], 1, "Known are: fitted"),
        (["evaluate", "run", "nothing"], 1, "neither a run folder nor a known run"),
        (["evaluate", "hands", "fitted"], 1, "no hands"),
        (["export", "nothing", "--format", "npz", "--out", "x.npz"], 1, "known run"),
        (["export", "fitted", "--format", "npz", "--out", "x.npz", "--sequence", "q"], 2, "'q'"),
        (["export", "fitted", "--format", "npz", "--out", "x.npz", "--frame", "1"], 2, "ply only"),
        (["import", "stereo", "nothing", "--out", "x"], 1, "nothing"),
        (["serve", "--port", "70000"], 2, "port"),
    ],
)
def test_every_mistake_is_one_clear_line(
    terminal: Terminal, arguments: list[str], code: int, reason: str
) -> None:
    assert reason in terminal.refused(code, *arguments)
    assert not list(Path().glob("x*"))


def test_an_unfinished_run_is_neither_simulated_nor_measured_nor_exported(
    terminal: Terminal,
) -> None:
    folder = terminal.data_dir / "runs" / "new"
    sequence = str(terminal.data_dir / "sequences" / "sheet")
    Run.create(folder, name="new", kind="reconstruction", sequences=[sequence], config={})
    assert "is queued" in terminal.refused(1, "simulate", "new", "--out", "x")
    assert "is queued" in terminal.refused(1, "evaluate", "run", "new")
    assert "is queued" in terminal.refused(1, "export", "new", "--format", "npz", "--out", "x.npz")


def test_a_run_is_simulated_again_with_other_parameters(terminal: Terminal) -> None:
    order = ("simulate", "fitted", "--out", "softer", "--stiffness-scale", "0.5", "--device", "cpu")
    assert terminal(*order) == 0
    run = Run.open("softer")
    assert (run.kind, run.state) == ("simulation", "succeeded")
    assert load_parameters(run.out).stiffness_scale == 0.5
    fitted = Run.open(terminal.data_dir / "runs" / "fitted").array("sequences/sheet/rollout.npy")
    assert np.abs(run.array("sequences/sheet/rollout.npy") - fitted).max() > 1e-5


def test_a_run_is_simulated_in_several_recordings_each_moved_by_its_own_hands(
    terminal: Terminal, tmp_path: Path
) -> None:
    sequences = terminal.data_dir / "sequences"
    write_sheet(sequences / "higher", lift=0.2)
    namesake = write_sheet(tmp_path / "elsewhere" / "sheet", lift=0.2).folder
    order = ("simulate", "fitted", "--device", "cpu", "--out")
    assert terminal(*order, "both", "--sequence", "sheet", "higher") == 0
    assert terminal(*order, "namesakes", "--sequence", namesake, "--sequence", "higher") == 0
    for out, first in (("both", sequences / "sheet"), ("namesakes", namesake)):
        run = Run.open(out)
        assert run.sequence_names == ["sheet", "higher"]
        for folder in (first, sequences / "higher"):
            control = run.array(f"sequences/{folder.name}/control.npy")
            np.testing.assert_array_equal(control, np.load(folder / "control.npy"))
    own, other = Run.open("both").metrics, Run.open("namesakes").metrics
    assert other["higher"] == own["higher"]
    # The namesake is the higher lift under the name of the run's own recording.
    assert other["sheet"] == own["higher"]
    assert own["sheet"]["future"]["rollout"]["track_error"] > 0
    assert own["sheet"]["future"] != own["higher"]["future"]


def test_a_run_is_simulated_again_with_edits_of_a_file(terminal: Terminal, tmp_path) -> None:
    file = tmp_path / "edits.json"
    file.write_text('[{"kind": "cut", "springs": [[0, 1], [1, 2]]}]')
    order = ("simulate", "fitted", "--device", "cpu", "--edits", str(file))
    assert terminal(*order, "--out", "cut") == 0
    run = Run.open("cut")
    assert run.config["edits"]["steps"] == ["Cut 2 springs"]
    assert len(run.object.edits[0].springs) == 2
    file.write_text('[{"kind": "melt"}]')
    assert "edits.json holds no edits" in terminal.refused(2, *order, "--out", "x")
    assert "cannot be read" in terminal.refused(2, *order[:-1], "nothing.json", "--out", "x")
    assert not Path("x").exists()


def test_nodes_collide_when_a_simulation_is_told_so(terminal: Terminal) -> None:
    order = ("simulate", "fitted", "--device", "cpu", "--collides-rest-neighbors", "True")
    assert terminal(*order, "--out", "no") == 2
    order = ("simulate", "fitted", "--device", "cpu", "--self-collision", "True")
    assert terminal(*order, "--collision-distance", "0.02", "--out", "wide") == 0
    parameters = load_parameters(Run.open("wide").out)
    assert (parameters.self_collision, parameters.collision_distance) == (True, 0.02)
    assert "collision_distance" in terminal.refused(
        2, *order, "--collision-distance", "-1", "--out", "x"
    )


def test_substeps_are_chosen_for_the_springs_told_and_stored(terminal: Terminal) -> None:
    order = ("simulate", "fitted", "--device", "cpu", "--substeps-per-frame", "auto")
    chosen = []
    for out, scale in (("soft", "1"), ("stiff", "400")):
        assert terminal(*order, "--out", out, "--stiffness-scale", scale) == 0
        run = Run.open(out)
        parameters = load_parameters(run.out)
        model = load_model(run.out, "sheet")
        control = run.array("sequences/sheet/control.npy")[0]
        needed = SAFETY / largest_stable_step(model, parameters, control) / parameters.frame_rate
        coarsest = 1.0 / LONGEST_STEP / parameters.frame_rate
        assert parameters.substeps_per_frame == pytest.approx(max(needed, coarsest), abs=1)
        assert f"substeps_per_frame: {parameters.substeps_per_frame}\n" in terminal.out
        chosen.append(parameters.substeps_per_frame)
    assert chosen[1] > chosen[0]


def test_a_value_out_of_range_is_refused_by_name(terminal: Terminal) -> None:
    order = ("simulate", "fitted", "--device", "cpu", "--out", "x")
    for field, value in (
        ("connection_radius", "nan"),
        ("connection_radius", "-1"),
        ("max_neighbors", "1000000000"),
        ("drag", "1e999"),
        ("substeps_per_frame", "0"),
    ):
        line = terminal.refused(2, *order, "--" + field.replace("_", "-"), value)
        assert field in line
    assert not Path("x").exists()


def test_measures_are_json_that_any_program_reads(terminal: Terminal) -> None:
    assert terminal("evaluate", "run", "fitted", "--json") == 0

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    measured = json.loads(terminal.out, parse_constant=refuse)
    stored = Run.open(terminal.data_dir / "runs" / "fitted").json("metrics.json")
    assert measured == stored
    assert terminal("evaluate", "run", terminal.data_dir / "runs" / "fitted") == 0
    assert terminal.out.startswith("sheet:\n")


def test_exports_are_written_once_and_over_only_on_demand(terminal: Terminal) -> None:
    order = ("export", "fitted", "--format", "npz", "--out", "motion.npz")
    assert terminal(*order) == 0
    assert terminal.out.strip() == "motion.npz"
    with np.load("motion.npz", allow_pickle=False) as arrays:
        assert any(array.shape == (FRAMES, len(NODE), 3) for array in arrays.values())
    assert "exists already" in terminal.refused(2, *order)
    assert terminal(*order, "--overwrite") == 0
    assert terminal("export", "fitted", "--format", "ply", "--out", "mesh.ply", "--frame", 3) == 0
    assert Path("mesh.ply").read_bytes().startswith(b"ply\n")


def test_a_taken_port_is_told(terminal: Terminal) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        line = terminal.refused(1, "serve", "--port", port, "--device", "cpu")
    assert f"Port {port} of 127.0.0.1" in line


def test_the_environment_speaks_where_the_arguments_are_silent(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen = []
    monkeypatch.setattr("app.server.serve", lambda settings, **_: seen.append(settings))
    monkeypatch.setenv("PHYSHANDI_PORT", "8123")
    monkeypatch.setenv("PHYSHANDI_DATA_DIR", str(tmp_path / "elsewhere"))
    monkeypatch.setenv("PHYSHANDI_DEVICE", "cpu")
    terminal("serve")
    terminal("serve", "--port", "8124", "--data-dir", "here")
    assert [settings.port for settings in seen] == [8123, 8124]
    assert [settings.device for settings in seen] == ["cpu", "cpu"]
    assert seen[0].data_dir == tmp_path / "elsewhere"
    assert seen[1].data_dir == Path("here").resolve()
    assert f"Known are: {SHIPPED}" in terminal.refused(2, "reconstruct", "sheet", "--out", "x")
    monkeypatch.setenv("PHYSHANDI_PORT", "many")
    assert "port" in terminal.refused(2, "serve")
    monkeypatch.delenv("PHYSHANDI_PORT")
    monkeypatch.setenv("PHYSHANDI_TOKEN", "short")
    line = terminal.refused(2, "serve")
    assert "token" in line
    assert "short'" not in line


def test_runs_go_to_the_data_folder_unless_told_otherwise(
    terminal: Terminal, quick: PipelineConfig
) -> None:
    data = ("--device", "cpu", "--data-dir", terminal.data_dir)
    assert terminal("reconstruct", "sheet", *data, "--set", "node_spacing=0.02") == 0
    (line,) = (line for line in terminal.out.splitlines() if line.startswith("run: "))
    run = Run.open(line.removeprefix("run: "))
    assert run.folder.parent == terminal.data_dir.resolve() / "runs"
    assert run.config["profile"]["node_spacing"] == 0.02
    assert run.config["overrides"] == {"node_spacing": 0.02}
    assert run.name.startswith("sheet · ")
    assert terminal("simulate", run.id, *data, "--drag", 2) == 0
    assert "None" not in terminal.out
    (line,) = (line for line in terminal.out.splitlines() if line.startswith("run: "))
    assert Run.open(line.removeprefix("run: ")).config["parameters"] == {"drag": 2.0}


def test_a_setting_or_profile_that_is_wrong_is_refused_before_a_run_is_made(
    terminal: Terminal, tmp_path: Path
) -> None:
    own = tmp_path / "my.yaml"
    own.write_text("base: quick\nnode_spacing: -1\n")
    order = ("reconstruct", "sheet", "--device", "cpu", "--out", "x")
    assert "node_spacing" in terminal.refused(2, *order, "--profile", own)
    assert "PATH=VALUE" in terminal.refused(2, *order, "--set", "node_spacing")
    assert "node_spacin" in terminal.refused(2, *order, "--set", "node_spacin=0.02")
    assert not Path("x").exists()


def test_sequences_are_checked_file_by_file(terminal: Terminal) -> None:
    assert terminal("check", "sheet", "towel_fold", "--json") == 0
    reports = json.loads(terminal.out)
    assert reports["sheet"]["hands"] == "not in it"
    assert reports["sheet"]["shape"] == "is found by the fit"
    assert reports["towel_fold"]["hands"] == reports["towel_fold"]["object"]
    meta = terminal.data_dir / "sequences" / "sheet" / "sequence.yaml"
    described = meta.read_text()
    meta.write_text(f"{described}shape: rope\n")
    assert terminal("check", "sheet", "--json") == 0
    assert json.loads(terminal.out)["sheet"]["shape"] == "rope"
    meta.write_text(f"{described}shape: ropes\n")
    assert terminal("check", "sheet") == 1
    assert "sequence.yaml: shape is 'ropes'; expected one of sheet, solid, shell" in terminal.out
    meta.write_text(described)
    assert terminal("check", "sheet", "--json") == 0
    told = json.loads(terminal.out)
    assert list(told["stages"]) == list(pipeline.STAGES)
    assert told["stages"][pipeline.SEARCH] | {"why": ""} == {
        "ready": True,
        "missing": [],
        "state": "ready",
        "why": "",
        "remedy": "",
    }
    assert told["stages"][pipeline.HANDS]["missing"] == ["hands"]
    assert told["problems"] == []
    assert told["stages"] == told["sheet"]["stages"]
    assert terminal("check", "sheet") == 0
    assert "hand_reconstruction: will be skipped, which is no loss" in terminal.out
    assert "first_order: ready" in terminal.out
    shutil.copytree(meta.parent, meta.parents[1] / "whole")
    marker = terminal.data_dir / "sequences" / "sheet" / "marker.npy"
    marker.write_bytes(marker.read_bytes()[:-8])
    assert terminal("check", "sheet", "whole") == 1
    assert "marker.npy" in terminal.out
    assert "at least one sequence" in terminal.refused(2, "check")


def test_a_sequence_is_found_by_name_without_opening_all_others(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    load = Sequence.load

    def noted(folder: Path) -> Sequence:
        opened.append(Path(folder).name)
        return load(folder)

    monkeypatch.setattr(Sequence, "load", noted)
    assert terminal("check", "sheet") == 0
    assert set(opened) == {"sheet"}
    assert "Known are: sheet, " in terminal.refused(2, "reconstruct", "nowhere")
    assert len(set(opened)) > 1


def test_an_option_that_takes_several_values_may_be_given_several_times() -> None:
    lists = [
        (f"{words} --{name}", get_origin(get_args(bare(hint))[0]))
        for words, command in commands(cli.build())
        for name, hint in get_type_hints(command, include_extras=True).items()
        if get_origin(bare(hint)) is tuple and not is_positional(hint)
    ]
    assert len(lists) > 15
    plain = [place for place, inner in lists if inner is not tuple]
    # Each --set takes one setting, so that a sequence may follow it.
    assert plain == ["reconstruct --settings"]


def test_the_page_of_the_command_line_tells_what_the_commands_take() -> None:
    text = page()
    assert text == PAGE.read_text(encoding="utf-8"), "run tests/command_line_page.py"
    for name in ("`--connection-radius`", "`--set`", "### `physhandi import mocap`"):
        assert name in text


def test_settings_that_do_not_go_together_are_told_in_plain_words(tmp_path: Path) -> None:
    with pytest.raises(UsageError) as wrong:
        read_settings(data_dir=tmp_path, token="a" * 40, token_file=tmp_path / "token")
    assert str(wrong.value).startswith("settings: token and token_file are both set; ")
