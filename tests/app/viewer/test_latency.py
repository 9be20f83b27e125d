"""The time from a slider to the first new frame is measured in the process that simulates."""

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.viewer.viewer_world import FRAMES

from app.benchmarks import latency
from app.benchmarks.latency import measure_latency
from app.viewer import sessions
from physhandi.errors import MissingInputError, SimulationError
from physhandi.run import Run

ROOT = Path(__file__).parents[3]
KINDS = {
    f"{slider}, substeps {substeps}"
    for slider in ("stiffness", "radius")
    for substeps in ("as fitted", "automatic")
}


def test_sliders_are_answered_and_timed(run: Run) -> None:
    result = measure_latency(run, "lift", moves=2)
    assert json.loads(json.dumps(result)) == result
    assert (result["benchmark"], result["device"]) == ("live", "cpu")
    assert result["frames"] == FRAMES - 1
    assert set(result["kinds"]) == KINDS
    for kind in [result, *result["kinds"].values()]:
        first, worst = kind["first_new_frame_ms"], kind["worst_first_new_frame_ms"]
        assert 0.0 < first <= worst < math.inf
    for kind in result["kinds"].values():
        assert 0.0 < kind["springs_known_ms"] < kind["worst_first_new_frame_ms"]
        assert 0.0 < kind["ms_per_frame"] < math.inf
        assert kind["substeps"] > 0
        # The process knows of a request later, and of its answer sooner, than the server.
        assert 0.0 < kind["in_process_ms"] < kind["first_new_frame_ms"]
        assert kind["in_process_ms"] <= kind["worst_in_process_ms"]
        assert kind["ms_per_frame"] <= kind["p95_ms_per_frame"]
        mean = 1e3 / kind["frames_per_s"]
        assert 0.2 * kind["ms_per_frame"] < mean < 20.0 * kind["p95_ms_per_frame"]
    steered = result["steered"]
    assert 0.0 < steered["ms_per_frame"] <= steered["p95_ms_per_frame"]
    assert 0.0 < steered["frames_per_s"] < math.inf
    assert result["sequence_frames_per_s"] == 30.0
    assert result["start_ms"] > result["first_new_frame_ms"]
    worst = max(kind["worst_first_new_frame_ms"] for kind in result["kinds"].values())
    assert result["worst_first_new_frame_ms"] == worst


def test_the_pace_of_a_steered_hand_leaves_its_first_frames_out() -> None:
    # A quarter is late and slow; of the rest one comes every 20 ms, and takes 5 or 9 ms.
    count = latency._STEERED
    early = count // 4
    moments = [*np.arange(early) * 1.0, *(early + 0.02 * np.arange(count - early))]
    durations = [0.5] * early + [0.005, 0.005, 0.009] * ((count - early) // 3)
    assert latency._steered(moments, durations) == pytest.approx(
        {"ms_per_frame": 5.0, "p95_ms_per_frame": 9.0, "frames_per_s": 50.0}
    )


def test_what_cannot_be_simulated_is_told(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MissingInputError, match="no object in 'nothing'"):
        measure_latency(run, "nothing", moves=1)
    monkeypatch.setattr(latency, "_PATIENCE", 0.0)
    with pytest.raises(SimulationError, match="said nothing for 0 s"):
        measure_latency(run, "lift", moves=1)


def test_a_run_that_is_gone_fails_by_name(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    real = latency.LiveRequest

    def elsewhere(**about: object) -> object:
        return real(**(about | {"run": Path("/nowhere/at-all")}))

    monkeypatch.setattr(latency, "LiveRequest", elsewhere)
    # The process of all tests: it answers as one of its own would.
    monkeypatch.setattr(latency, "SimulationClient", sessions.SimulationClient)
    with pytest.raises(SimulationError, match=r"failed: .*at-all"):
        measure_latency(run, "lift", moves=1)


def test_it_needs_no_package_of_the_server() -> None:
    missing = ["fastapi", "pydantic", "torch", "tyro", "uvicorn", "viser"]
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({missing!r}))\n"
        "import app.benchmarks.latency, app.viewer.live.worker\n"
        "print('imported')"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.stdout.endswith("imported\n"), done.stderr
