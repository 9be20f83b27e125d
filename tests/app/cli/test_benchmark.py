"""The commands that measure speed print what programs can read."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from app import cli
from app.benchmarks import latency
from physhandi.benchmarks import timing
from physhandi.run import Run

BESIDE = {"nodes", "springs", "substeps", "ms_per_frame", "frames_per_s", "baseline_ms_per_frame",
          "speedup", "max_abs_difference_m"}  # fmt: skip


@pytest.fixture(autouse=True)
def small_copies(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "_COPY_SIZE", {"cpu": 1 << 20, "cuda": 1 << 20})


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        cli.main(["benchmark", *(str(argument) for argument in arguments)])
    return int(end.value.code or 0), *capsys.readouterr()


def measured(capsys: pytest.CaptureFixture[str], what: str, *arguments: object) -> dict[str, Any]:
    code, out, error = call(capsys, what, *arguments, "--device", "cpu", "--json")
    assert code == 0, error
    result = json.loads(out)
    assert (result["benchmark"], result["device"]) == (what, "cpu")
    return result


@pytest.mark.parametrize("what", ["rollout", "gradient", "batch"])
def test_a_block_is_measured_beside_the_baseline(
    what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    more = ("--candidates", 2) if what == "batch" else ()
    result = measured(capsys, what, "--nodes", 20, "--frames", 1, *more)
    assert set(result) >= BESIDE
    assert (result["nodes"], result["frames"], result["substeps"]) == (20, 1, 667)
    assert result["max_abs_difference_m"] < 1e-6
    if what == "batch":
        assert result["candidates"] == 2


def test_sizes_are_measured_side_by_side(capsys: pytest.CaptureFixture[str]) -> None:
    order = ("--nodes", 10, 20, "--springs-at-node", 6, "--frames", 1, "--time-limit-s", 60)
    result = measured(capsys, "scaling", *order)
    assert [row["nodes"] for row in result["table"]] == [10, 20]
    assert result["growth"][0]["springs_at_node"] == 6


@pytest.fixture
def fitted(fitted_folder: Path, tmp_path: Path) -> Path:
    shutil.copytree(fitted_folder, tmp_path / "fitted")
    return tmp_path / "fitted"


def test_a_run_is_simulated_with_fewer_substeps(
    fitted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = measured(capsys, "substeps", fitted, "--substeps", 150)
    assert {150, 666, 667, 700} <= {row["substeps"] for row in result["table"]}
    assert result["worst_frame_mean_difference_m"] < 1e-3 < result["motion_m"]


def test_a_slider_of_a_run_is_timed(
    fitted: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def measured_latency(run: Run, sequence: str, *, device: str) -> dict[str, Any]:
        asked = {"run": run.id, "sequence": sequence, "device": device}
        return {"benchmark": "live", "first_new_frame_ms": 8.5, **asked}

    monkeypatch.setattr(latency, "measure_latency", measured_latency)
    result = measured(capsys, "live", fitted)
    assert (result["run"], result["sequence"]) == ("fitted", "sheet")
    assert result["first_new_frame_ms"] == 8.5
    code, _, error = call(capsys, "live", fitted, "--sequence", "other", "--device", "cpu")
    assert (code, "has no sequence 'other', but sheet" in error) == (2, True)


def test_what_makes_no_sense_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for order, code, reason in (
        (("rollout", "--nodes", 0), 2, "nodes of a benchmark is 0"),
        (("rollout", "--topology", "gone.npz"), 2, "no object file gone.npz"),
        (("gradient", "--device", "cuda:7"), 2, "no device 'cuda:7'"),
        (("live", "nothing"), 1, "neither a run folder nor a known run"),
    ):
        device = () if "--device" in order else ("--device", "cpu")
        exit_code, out, error = call(capsys, *order, *device)
        assert (exit_code, out) == (code, "")
        assert reason in error.splitlines()[-1]
