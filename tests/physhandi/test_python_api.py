"""The Python API as docs/python.md promises it, on a small sheet that two grippers lift."""

import io
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from reference.gradients import directional_difference, loss_weights
from reference.scenes import as_model, cube_scene
from support.inputs.sheet_sequence import FITTED, FRAMES, NODE, sheet_config, write_sheet
from support.viewer.gltf_player import Player

import physhandi as ph
from physhandi.data.layout import SequenceFiles
from physhandi.errors import MissingInputError, RunError, SequenceError, UsageError
from physhandi.fitted_object import FittedObject
from physhandi.object_rollout import ObjectRollout
from physhandi.progress import NullProgress, PrintedProgress, ToldProgress, watched
from physhandi.simulation.edits import Cut, Pin, Release, ScaleMaterial, checked_edits

SMALL = sheet_config(generations=3, population=6, iterations=3)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings of one sheet; `copy/towel_fold` has the name of the first, not its motion."""
    root = tmp_path_factory.mktemp("sequences")
    write_sheet(root / "towel_fold", lift=0.12)
    write_sheet(root / "towel_pull", lift=0.2)
    write_sheet(root / "copy" / "towel_fold", lift=0.2)
    return root


@pytest.fixture(scope="module")
def reports() -> list[tuple]:
    return []


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, recordings: Path, reports: list[tuple]) -> ph.Run:
    return ph.reconstruct(
        ph.load(recordings / "towel_fold"),
        profile=SMALL,
        overrides={"refinement.iterations": 0},
        out=tmp_path_factory.mktemp("runs") / "towel",
        progress=lambda *report: reports.append(report),
    )


def test_importing_it_loads_neither_torch_nor_warp() -> None:
    code = (
        "import sys, physhandi; assert dir(physhandi) and physhandi.__version__\n"
        "print(sorted({'torch', 'warp', 'numpy', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, check=True, encoding="utf-8"
    )
    assert done.stdout.strip() == "[]"


def test_looking_at_recordings_and_results_loads_neither_torch_nor_warp(
    run: ph.Run, recordings: Path
) -> None:
    code = (
        "import sys, physhandi as ph\n"
        f"print(ph.load({str(recordings / 'towel_fold')!r}).frame_count)\n"
        f"print(ph.open_run({str(run.folder)!r}).metrics['towel_fold']['future'] != {{}})\n"
        "print(sorted({'torch', 'warp', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, check=True, encoding="utf-8"
    )
    assert done.stdout.split("\n")[:3] == [str(FRAMES), "True", "[]"]


def test_unknown_names_are_refused() -> None:
    with pytest.raises(AttributeError, match="no attribute 'reconstrict'"):
        _ = ph.reconstrict  # type: ignore[attr-defined]  # it is not there


def test_the_example_of_the_documentation(
    run: ph.Run, recordings: Path, reports: list[tuple], tmp_path: Path
) -> None:
    assert {"zeroth_order", "first_order", "evaluation"} <= {report[0] for report in reports}
    assert all(len(report) == 5 for report in reports)
    obj = run.object
    assert obj.parameters.stiffness > 0
    assert run.metrics["towel_fold"]["future"]["rollout"]["track_error"] > 0

    roll = obj.simulate(stiffness_scale=0.3, connection_radius=0.11)
    assert roll.position.shape == (FRAMES, len(NODE), 3)
    assert roll.velocity is not None
    assert roll.velocity.shape == roll.position.shape
    assert roll.forces(6).shape == (len(NODE), 3)
    assert np.linalg.norm(roll.forces(6), axis=1).max() > 0.1
    assert roll.model.object_spring_count > obj.model.object_spring_count
    assert np.abs(roll.position - obj.fitted.position).max() > 1e-3

    other = obj.simulate(sequence=ph.load(recordings / "towel_pull"))
    marker = np.load(recordings / "towel_pull" / "marker.npy")
    np.testing.assert_array_equal(
        other.control[-1], np.load(recordings / "towel_pull/control.npy")[-1]
    )
    assert np.linalg.norm(other.position - marker, axis=2).mean() < 0.03

    theta = torch.tensor(math.log(obj.parameters.stiffness), requires_grad=True)
    target = torch.from_numpy(marker)
    loss = obj.rollout(log_stiffness=theta).sub(target).square().mean()
    loss.backward()
    assert theta.grad is not None
    assert theta.grad.abs() > 0

    written = roll.export(tmp_path / "towel.glb")
    np.testing.assert_allclose(
        Player(written).vertices("object", FRAMES - 1), roll.position[-1], atol=1e-6
    )


def test_an_unchanged_simulation_repeats_the_bits_of_the_run(run: ph.Run) -> None:
    again = run.object.simulate()
    np.testing.assert_array_equal(again.position, run.array("sequences/towel_fold/rollout.npy"))


def test_the_same_content_elsewhere_is_the_run_s_own_recording(run: ph.Run, tmp_path: Path) -> None:
    write_sheet(tmp_path / "towel_fold", lift=0.12)
    moved = ph.load(tmp_path / "towel_fold")
    assert moved.folder != Path(run.sequences[0])
    assert run.holds(moved)
    obj = run.object
    assert obj.placed_in(moved, NullProgress()) is obj


def test_a_recording_of_the_same_name_is_another_recording(
    run: ph.Run, recordings: Path, tmp_path: Path
) -> None:
    namesake = ph.load(recordings / "copy" / "towel_fold")
    assert not run.holds(namesake)
    again = ph.simulate(run, namesake, out=tmp_path / "namesake")
    control = again.array("sequences/towel_fold/control.npy")
    np.testing.assert_array_equal(control, np.load(namesake.folder / "control.npy"))
    both = ph.simulate(
        run,
        [namesake, ph.load(recordings / "towel_pull")][1:],
        out=tmp_path / "pull",
    )
    np.testing.assert_array_equal(
        again.array("sequences/towel_fold/rollout.npy"),
        both.array("sequences/towel_pull/rollout.npy"),
    )


def test_a_stored_simulation_covers_several_recordings_and_is_what_the_object_gives(
    run: ph.Run, recordings: Path, tmp_path: Path
) -> None:
    both = [ph.load(recordings / name) for name in ("towel_fold", "towel_pull")]
    stored = ph.simulate(run, both, out=tmp_path / "soft", stiffness_scale=0.5)
    assert set(stored.metrics) == {"towel_fold", "towel_pull"}
    for sequence in both:
        expected = run.object.simulate(sequence=sequence, stiffness_scale=0.5)
        rollout = stored.array(f"sequences/{sequence.name}/rollout.npy")
        np.testing.assert_array_equal(rollout, expected.position)
    assert (
        ph.simulate(run, both, out=tmp_path / "soft", stiffness_scale=0.5).folder == stored.folder
    )
    with pytest.raises(UsageError, match="already holds another run"):
        ph.simulate(run, both, out=tmp_path / "soft", stiffness_scale=0.6)


def test_an_edited_object_is_stored_with_its_edits_and_changed_again(
    run: ph.Run, recordings: Path, tmp_path: Path
) -> None:
    fold = ph.load(recordings / "towel_fold")
    obj = run.object
    pairs = [tuple(map(int, ends)) for ends in obj.model.spring_nodes[:3]]
    corner = obj.model.object_node[24]
    edits = [
        Cut(springs=pairs),
        Pin(nodes=[24], places=[[float(x) for x in corner]]),
        ScaleMaterial(quantity="stiffness", factor=0.5, springs=[(20, 21)]),
    ]
    rollout = obj.simulate(edits=edits)
    away = np.linalg.norm(rollout.position - obj.fitted.position, axis=2).mean(axis=1)
    assert away[-1] > 0.01
    assert np.linalg.norm(rollout.position[:, 24] - corner, axis=1).max() < 0.02
    assert rollout.restart is None
    assert obj.simulate(edits=edits[2:]).restart is obj.fitted.restart
    np.testing.assert_array_equal(obj.simulate(edits=[]).position, obj.simulate().position)

    out = tmp_path / "edited"
    stored = ph.simulate(run, fold, out=out, edits=edits)
    assert stored.config["edits"]["steps"] == [
        "Cut 3 springs",
        "Pin 1 node",
        "Stiffness ×0.5 of 1 spring",
    ]
    again = stored.object
    np.testing.assert_array_equal(again.fitted.position, rollout.position)
    np.testing.assert_array_equal(again.simulate().position, rollout.position)
    assert again.edits == checked_edits(edits)
    assert again.fitted.control.shape[1] == obj.fitted.control.shape[1] + 1
    assert ph.simulate(run, fold, out=out, edits=edits).folder == stored.folder
    with pytest.raises(UsageError, match="already holds another run"):
        ph.simulate(run, fold, out=out, edits=edits[:1])
    # Other springs are laid as without edits, which are made again; and they can be taken back.
    wider = {"connection_radius": 0.15, "max_neighbors": 20, "stiffness": 300.0}
    expected = obj.simulate(edits=edits, **wider)
    assert expected.model.object_spring_count > rollout.model.object_spring_count
    np.testing.assert_array_equal(again.simulate(**wider).position, expected.position)
    np.testing.assert_array_equal(
        again.simulate(edits=[]).position[:FITTED], obj.simulate().position[:FITTED]
    )
    twice = ph.simulate(stored, fold, out=tmp_path / "twice", stiffness=300.0)
    np.testing.assert_array_equal(
        twice.object.fitted.position, obj.simulate(edits=edits, stiffness=300.0).position
    )
    # Where control nodes and frames are others only what is the object's own is done again.
    pull = ph.load(recordings / "towel_pull")
    with pytest.raises(UsageError, match=r"Edit 2 \(Pin 1 node\) belongs to the recording"):
        again.simulate(sequence=pull)
    cut = obj.simulate(sequence=pull, edits=edits[:1])
    uncut = obj.simulate(sequence=pull)
    assert cut.model.object_spring_count == uncut.model.object_spring_count - 3
    assert np.abs(cut.position - uncut.position).max() > 1e-4


def test_damaged_edits_of_a_run_are_named(run: ph.Run, recordings: Path, tmp_path: Path) -> None:
    fold = ph.load(recordings / "towel_fold")
    stored = ph.simulate(run, fold, out=tmp_path / "cut", edits=[Cut(springs=[(0, 1)])])
    file = stored.out / SequenceFiles("towel_fold").edits
    file.write_text('[{"kind": "cut", "springs": [[0]]}]')
    with pytest.raises(RunError, match=r"edits.json .*\$\[0\].springs"):
        _ = ph.open_run(stored.folder).object
    with pytest.raises(UsageError, match=r"Edit 1 \(Release 1 node\): there is no object node 99"):
        run.object.simulate(edits=[Release(nodes=[99])])
    with pytest.raises(UsageError, match="These are no edits"):
        run.object.simulate(edits=[ScaleMaterial(quantity="stiffness", factor=-1.0)])


def test_substeps_that_are_too_few_for_another_recording_are_raised(
    run: ph.Run, recordings: Path
) -> None:
    obj = run.object
    pull = ph.load(recordings / "towel_pull")
    stiff = obj.simulate(sequence=pull, stiffness_scale=400.0)
    assert stiff.parameters.substeps_per_frame > obj.parameters.substeps_per_frame
    assert np.isfinite(stiff.position).all()
    few = obj.simulate(sequence=pull, substeps_per_frame=obj.parameters.substeps_per_frame + 7)
    assert few.parameters.substeps_per_frame == obj.parameters.substeps_per_frame + 7


def test_a_finished_run_is_opened_and_another_one_is_not_overwritten(
    run: ph.Run, recordings: Path
) -> None:
    sequence = ph.load(recordings / "towel_fold")
    same = {"profile": SMALL, "overrides": {"refinement.iterations": 0}, "out": run.folder}
    assert ph.reconstruct(sequence, **same).folder == run.folder
    with pytest.raises(UsageError, match="already holds another run"):
        ph.reconstruct(sequence, profile="quick", out=run.folder)


def test_bad_input_is_refused_before_anything_is_made(
    run: ph.Run, recordings: Path, tmp_path: Path
) -> None:
    sequence = ph.load(recordings / "towel_fold")
    with pytest.raises(SequenceError, match=r"sequence\.yaml"):
        ph.load(tmp_path)
    with pytest.raises(RunError, match="is not a run"):
        ph.open_run(tmp_path)
    with pytest.raises(UsageError, match="no profile 'quik'"):
        ph.reconstruct(sequence, profile="quik", out=tmp_path / "x")
    with pytest.raises(UsageError, match="no setting"):
        ph.reconstruct(sequence, overrides={"object_.serch": 1}, out=tmp_path / "x")
    with pytest.raises(UsageError, match="Name at least one sequence"):
        ph.reconstruct([], out=tmp_path / "x")
    with pytest.raises(UsageError, match=r"physhandi\.load"):
        ph.reconstruct([str(sequence.folder)], out=tmp_path / "x")  # type: ignore[list-item]
    with pytest.raises(UsageError, match="stifness"):
        ph.simulate(run, out=tmp_path / "x", stifness=3.0)
    with pytest.raises(UsageError, match="progress is 'yes'"):
        run.object.simulate(progress="yes")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="names no format"):
        run.object.fitted.export(tmp_path / "towel.obj")
    with pytest.raises(UsageError, match="connection_radius"):
        run.object.simulate(connection_radius=1e-4)
    with pytest.raises(MissingInputError, match="no fitted object for sequence 'towel_push'"):
        run.object_in("towel_push")
    assert not (tmp_path / "x").exists()


def cube_object() -> FittedObject:
    scene = cube_scene()
    model, parameters = as_model(scene)
    control = scene.control.astype(np.float32)
    return FittedObject(ObjectRollout.empty(model, parameters, control))


@pytest.mark.parametrize(
    ("name", "argument"),
    [
        ("log_stiffness", "log_stiffness"),
        ("log_virtual_stiffness", "log_stiffness"),
        ("log_damping", "damping"),
    ],
)
def test_one_number_for_all_springs_has_the_gradient_of_the_oracle(
    name: str, argument: str
) -> None:
    scene, obj = cube_scene(), cube_object()
    weights = loss_weights(scene)
    weights = weights[0], np.zeros_like(weights[1])
    own = np.all(scene.springs < len(scene.node), axis=1)
    moved = {"log_stiffness": own, "log_virtual_stiffness": ~own, "log_damping": own | ~own}[name]
    # The derivative of damping c exp(t) by t is c.
    direction = moved * (scene.damping if argument == "damping" else 1.0)
    expected = directional_difference(scene, weights, argument, direction)
    reference = name.removeprefix("log_")
    theta = torch.tensor(math.log(getattr(obj.parameters, reference)), requires_grad=True)
    position = obj.rollout(**{name: theta})
    (torch.tensor(weights[0]) * position.double()).sum().backward()
    assert theta.grad is not None
    assert abs(expected) > 1e-4
    assert float(theta.grad) == pytest.approx(expected, rel=1e-4)


def test_a_number_for_each_spring_has_the_gradient_of_the_oracle() -> None:
    scene, obj = cube_scene(), cube_object()
    weights = loss_weights(scene)
    weights = weights[0], np.zeros_like(weights[1])
    direction = np.random.default_rng(3).normal(size=len(scene.springs))
    expected = directional_difference(scene, weights, "log_stiffness", direction)
    theta = torch.log(torch.from_numpy(obj.model.stiffness)).requires_grad_()
    position = obj.rollout(log_stiffness=theta)
    (torch.tensor(weights[0]) * position.double()).sum().backward()
    assert theta.grad is not None
    assert float(theta.grad.double() @ torch.from_numpy(direction)) == pytest.approx(
        expected, rel=1e-4
    )
    with pytest.raises(UsageError, match=r"log_stiffness has shape \(3,\); expected one number"):
        obj.rollout(log_stiffness=torch.zeros(3))
    with pytest.raises(UsageError, match="cannot be simulated"):
        obj.rollout(stifness=torch.zeros(()))


def test_a_logarithm_moves_the_object_as_the_number_does(run: ph.Run) -> None:
    obj = run.object
    stiffness = 0.4 * obj.parameters.stiffness
    expected = obj.simulate(stiffness=stiffness).position
    position = obj.rollout(log_stiffness=torch.tensor(math.log(stiffness))).numpy()
    np.testing.assert_allclose(position[:FITTED], expected[:FITTED], atol=2e-5)
    assert np.abs(expected - obj.fitted.position)[:FITTED].max() > 1e-3
    assert np.abs(position - expected)[FITTED:].max() > 1e-3  # It does not restart.


def test_progress_is_a_line_a_quarter_where_there_is_no_terminal() -> None:
    stream = io.StringIO()
    progress = PrintedProgress(stream)
    for iteration in range(101):
        progress.report("search", iteration, 100, loss=0.5)
    progress.report("springs", 4, 4)
    progress.report("springs", 1, 1, message="done")
    progress.finish()
    assert stream.getvalue().splitlines() == [
        *(f"search {iteration}/100  loss 0.5" for iteration in (0, 25, 50, 75, 100)),
        "springs 4/4",
        "springs 1/1  done",
    ]


def test_progress_that_reaches_no_quarter_is_a_line_a_minute() -> None:
    stream, now = io.StringIO(), [0.0]
    progress = PrintedProgress(stream, clock=lambda: now[0])
    progress.report("suite", 0, 102)
    for number, now[0] in enumerate((59.0, 60.5, 119.0, 121.0), start=1):
        progress.report("suite", number, 102, message=f"cell {number}")
    progress.report("waits for process 7", 0, 0)
    assert stream.getvalue().splitlines() == [
        "suite 0/102",
        "suite 2/102  cell 2",
        "suite 4/102  cell 4",
        "waits for process 7",
    ]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_is_a_bar_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with watched(True) as progress:
        progress.report("search", 1, 2, loss=0.25)
        progress.report("search", 2, 2, loss=0.125)
    assert "search" in terminal.getvalue()
    assert "2/2" in terminal.getvalue()
    assert "0.125" in terminal.getvalue()
    assert terminal.getvalue().removesuffix("\x1b[?25h").endswith("\n")
    with watched(False) as silent:
        silent.report("search", 1, 2)
    assert "1/2" not in terminal.getvalue().rpartition("2/2")[2]
    of_several = Terminal()
    PrintedProgress(of_several, has_bar=False).report("search", 1, 2, loss=0.25)
    assert of_several.getvalue() == "search 1/2  loss 0.25\n"


def test_a_parent_is_told_a_few_times_a_second_and_of_each_stage_that_ends() -> None:
    told: list[dict[str, object]] = []
    now = iter([10.0, 10.4, 10.6, 10.7, 10.8])
    progress = ToldProgress(lambda **report: told.append(report), 0.5, clock=lambda: next(now))
    for iteration in (1, 2, 3, 4):
        progress.report("search", iteration, 4, message=f"candidate {iteration}")
    progress.report("waits", 0, 0)
    assert [(one["stage"], one["iteration"]) for one in told] == [
        *(("search", iteration) for iteration in (1, 3, 4)),
        ("waits", 0),
    ]
    assert told[1] == {"stage": "search", "iteration": 3, "total": 4, "message": "candidate 3"}
