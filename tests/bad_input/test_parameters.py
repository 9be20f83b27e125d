"""Parameters that make no sense, each given to ``physhandi simulate`` or ``reconstruct``."""

from pathlib import Path

import pytest
from support.hostile.bad_input_world import Terminal, table, tree

SIMULATE = {
    # option, value, what the message names
    "δ negative": ("--connection-radius", -0.02, ("connection_radius is -0.02",)),
    "δ NaN": ("--connection-radius", "nan", ("connection_radius is nan", "number from 0")),
    "δ infinite": ("--connection-radius", "inf", ("connection_radius is inf", "number from 0")),
    "δ of no spring": (
        "--connection-radius",
        1e-6,
        ("No object spring", "'sheet'", "connection_radius is 1e-06 m", "0.05 m apart"),
    ),
    "d_max 0": (
        "--max-neighbors",
        0,
        ("No object spring", "max_neighbors is 0", "at least 1"),
    ),
    "d_max negative": ("--max-neighbors", -1, ("max_neighbors is -1", "0 to 1000")),
    "d_max huge": ("--max-neighbors", 10**9, ("max_neighbors is 1000000000", "0 to 1000")),
    "virtual δ of no spring": (
        "--virtual-connection-radius",
        0.004,
        ("No virtual spring", "virtual_connection_radius is 0.004 m", "0.005 m from the object"),
    ),
    "virtual d_max 0": ("--virtual-max-neighbors", 0, ("No virtual spring", "at least 1")),
    "stiffness scale NaN": ("--stiffness-scale", "nan", ("stiffness_scale is nan",)),
    "damping negative": ("--damping", -1, ("damping is -1",)),
    "drag infinite": ("--drag", "1e999", ("drag is inf",)),
    "restitution above 1": ("--restitution", 1.5, ("restitution is 1.5", "0 to 1")),
    "friction negative": ("--friction", -0.1, ("friction is -0.1", "0 to 2")),
    "no substeps": ("--substeps-per-frame", 0, ("substeps_per_frame is 0", "from 1 to")),
}


@table(SIMULATE)
def test_a_senseless_parameter_is_refused(
    terminal: Terminal, fitted: Path, case: tuple[str, object, tuple[str, ...]]
) -> None:
    option, value, words = case
    terminal.refused(2, words, "simulate", fitted, "--out", "out", option, value, "--device", "cpu")


def test_a_diverging_simulation_names_what_to_change(terminal: Terminal, fitted: Path) -> None:
    words = ("diverged at frame", "substep", "node", "stiffness", "substeps_per_frame")
    order = ("simulate", fitted, "--out", "out", "--device", "cpu")
    terminal.refused(1, words, *order, "--stiffness-scale", 1e6)


ORDERS = {
    # words of the order, exit code, what the message names
    "unknown profile": (
        ["reconstruct", "sheet", "--out", "out", "--profile", "fastest"],
        2,
        ("'fastest'", "default, paper, phystwin, quick"),
    ),
    "unknown sequence": (["reconstruct", "towel", "--out", "out"], 2, ("'towel'", "Known are")),
    "path as a sequence": (
        ["reconstruct", "../../etc/passwd", "--out", "out"],
        2,
        ("'../../etc/passwd'", "sequence.yaml"),
    ),
    "no sequence": (["reconstruct", "--out", "out"], 2, ("at least one sequence",)),
    "unknown device": (
        ["reconstruct", "sheet", "--out", "out", "--device", "abacus"],
        2,
        ("'abacus'", "cpu"),
    ),
    "unknown run": (["simulate", "mine", "--out", "out"], 1, ("'mine'", "Known are")),
    "path as a run": (["export", "../..", "--format", "npz", "--out", "x"], 1, ("'../..'",)),
    "unknown sequence of a run": (
        ["export", "fitted", "--format", "csv", "--out", "x", "--sequence", "towel"],
        2,
        ("'towel'", "sheet"),
    ),
    "frame beyond the end": (
        ["export", "fitted", "--format", "ply", "--out", "x", "--frame", "10"],
        2,
        ("frames 0 to 9", "10"),
    ),
    "hands of a run without": (["evaluate", "hands", "fitted"], 1, ("no hands",)),
    "folder that cannot name a run": (["reconstruct", "sheet", "--out", "a.b"], 1, ("'a.b'",)),
    "checkpoint without its search": (
        ["import", "phystwin", "case", "--out", "x", "--checkpoint", "best.pth"],
        2,
        ("--optimal-params",),
    ),
    "port that is none": (["serve", "--port", "70000"], 2, ("port", "65535")),
    "host that is none": (["serve", "--host", "999.1.1.1", "--port", "0"], 1, ("999.1.1.1",)),
    "negative number of nodes": (
        ["benchmark", "rollout", "--nodes", "-4", "--device", "cpu"],
        2,
        ("nodes", "positive"),
    ),
    "no frames to time": (
        ["benchmark", "rollout", "--frames", "0", "--device", "cpu"],
        2,
        ("frames", "positive"),
    ),
    "benchmark model not there": (
        ["benchmark", "rollout", "--topology", "twin.npz", "--device", "cpu"],
        2,
        ("twin.npz",),
    ),
}


@table(ORDERS)
def test_a_senseless_order_is_refused(
    terminal: Terminal,
    sheet: Path,
    fitted: Path,
    monkeypatch: pytest.MonkeyPatch,
    case: tuple[list[str], int, tuple[str, ...]],
) -> None:
    order, code, words = case
    monkeypatch.undo()
    monkeypatch.chdir(terminal.folder)
    terminal.refused(code, words, *order)


USAGE = {
    "half a substep": ("--substeps-per-frame", "0.5"),
    "text for a number": ("--drag", "much"),
    "an option that is not there": ("--colour", "red"),
    "an option without a value": ("--friction",),
}


@table(USAGE)
def test_a_word_of_the_wrong_kind_is_shown_with_its_option(
    terminal: Terminal, fitted: Path, case: tuple[str, ...]
) -> None:
    before = tree(terminal.folder)
    code, out, error = terminal("simulate", fitted, "--out", "out", *case)
    assert (code, out) == (2, "")
    assert all(word in error for word in (*case, "--help"))
    assert "Traceback" not in error
    assert tree(terminal.folder) == before
