"""The command that completes an object by a mesh."""

import pytest
from support.inputs.half_seen_body import TURN, UNIT, body, write_half_seen, write_mesh

from app import cli
from physhandi.data.sequence import Sequence


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        cli.main([str(argument) for argument in arguments])
    return int(end.value.code or 0), *capsys.readouterr()


def test_a_mesh_is_stored_with_the_sequence_and_figures_are_told(tmp_path, capsys):
    sequence = write_half_seen(tmp_path / "toy")
    mesh = write_mesh(tmp_path / "toy.ply", *body())
    turns = ",".join(f"{turn:.0f}" for turn in TURN.inv().as_euler("xyz", degrees=True))
    command = ("shape", sequence.folder, mesh, "--scale", UNIT, f"--pose={turns}")
    code, out, error = call(capsys, *command)
    assert code == 0, error
    assert f"scale: {UNIT} m for one unit" in out
    assert "0 % of its surface where views see nothing" in out
    assert Sequence.load(sequence.folder).mesh is not None
    assert Sequence.load(sequence.folder).provenance["mesh"]["scale"] == UNIT
    for option, told in (("--scale=big", "neither a number nor auto"), ("--pose=1,2", "1,2")):
        code, out, error = call(capsys, "shape", sequence.folder, mesh, option)
        assert (code, out) == (2, "")
        assert told in error
