"""What the rollout and gradient benchmarks tell is measured, compared and complete."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from physhandi.benchmarks import gradient, rollout, timing
from physhandi.benchmarks.gradient import benchmark_gradient
from physhandi.benchmarks.phystwin_like import PhysTwinLike
from physhandi.benchmarks.rollout import benchmark_rollout
from physhandi.benchmarks.scenes import synthetic_block
from physhandi.errors import UsageError

KEYS = {
    "device", "nodes", "springs", "substeps", "ms_per_frame", "frames_per_s",
    "baseline_ms_per_frame", "speedup", "max_abs_difference_m", "device_name", "warp", "commit",
    "frames", "load_average", "stable_substeps", "motion_m", "bytes_per_frame", "bytes_formula",
    "bandwidth_fraction", "copy_gigabytes_per_s",
}  # fmt: skip
SMALL = {"node_count": 60, "frame_count": 3, "substeps_per_frame": 100}


@pytest.fixture(autouse=True)
def small_copies(monkeypatch):
    """Copy little, for a bandwidth that no test looks at closely."""
    monkeypatch.setattr(timing, "_COPY_SIZE", {"cpu": 1 << 20, "cuda": 1 << 20})


def check(result, device):
    """Assert what is true of every benchmark beside the baseline."""
    assert json.loads(json.dumps(result)) == result
    assert set(result) >= KEYS
    assert (result["device"], result["nodes"], result["frames"]) == (device, 60, 3)
    assert result["springs"] == 540 + result["virtual_springs"]
    assert result["frames_per_s"] * result["ms_per_frame"] == pytest.approx(1e3)
    ratio = result["baseline_ms_per_frame"] / result["ms_per_frame"]
    assert result["speedup"] == pytest.approx(ratio)
    assert 0.0 < result["max_abs_difference_m"] < 2e-6
    assert 2e-3 < result["motion_m"] < 0.02
    moved = 1e3 * result["bytes_per_frame"] / result["ms_per_frame"]
    assert result["gigabytes_per_s"] == pytest.approx(1e-9 * moved)
    share = result["gigabytes_per_s"] / result["copy_gigabytes_per_s"]
    assert result["bandwidth_fraction"] == pytest.approx(share)


def test_a_rollout_is_timed_and_compared(device):
    result = benchmark_rollout(device=device, **SMALL)
    check(result, device)
    # 20 B a spring, 48 B a node and 24 B for each of nine control nodes.
    assert result["bytes_per_frame"] == 100 * (20 * result["springs"] + 48 * 60 + 24 * 9)
    assert "20 B x springs + 48 B x nodes + 24 B x control nodes" in result["bytes_formula"]


def test_a_gradient_is_timed_and_compared(device):
    result = benchmark_gradient(device=device, **SMALL)
    check(result, device)
    assert result["gradient_norm"] > 1e-3
    assert 0.0 < result["gradient_relative_difference"] < 1e-4
    assert result["bytes_per_frame"] == 100 * (56 * result["springs"] + 168 * 60 + 48 * 9)
    # A position, a velocity and a velocity before contact, of four floats each; on a CPU the
    # control nodes too, in one part or in both.
    assert result["stored_frames"] == 3
    least = 3 * 100 * 60 * 48
    assert least <= result["trajectory_bytes"] <= least + 3 * 32 * (60 + 101 * 18)


def test_another_physics_is_not_called_the_same(device, monkeypatch):
    def floating(model, parameters, device):
        return PhysTwinLike(model, parameters.replace(gravity=0.0), device)

    monkeypatch.setattr(rollout, "PhysTwinLike", floating)
    monkeypatch.setattr(gradient, "PhysTwinLike", floating)
    for benchmark in (benchmark_rollout, benchmark_gradient):
        result = benchmark(device=device, **SMALL)
        assert result["max_abs_difference_m"] > 1e-4
    assert result["gradient_relative_difference"] > 0.01


def tell(monkeypatch, moments):
    """Let the benchmarks' clock tell these times."""
    clock = iter(moments)
    monkeypatch.setattr(timing, "time", SimpleNamespace(perf_counter=lambda: float(next(clock))))


def test_times_are_medians_of_the_timed_rounds_only(device, monkeypatch):
    tell(monkeypatch, np.cumsum([0, 9, 0, 9, 0, 1, 0, 5, 0, 3, 0, 4, 0, 2, 0, 6]))
    told = []
    works = {name: lambda name=name: told.append(name) for name in "ab"}
    assert timing.time_in_turns(works, device, 3) == {"a": 2.0, "b": 5.0}
    assert told == list("abababab")


def test_a_copy_is_counted_read_and_written(device, monkeypatch):
    tell(monkeypatch, [0.0, 4.0, 4.0, 6.0] + [10.0, 13.0] * 3)
    assert timing.copy_bandwidth(device) == 2 * (1 << 20) / 2.0


def test_numbers_that_make_no_sense_are_named(device):
    with pytest.raises(UsageError, match="frames of a benchmark is 0"):
        benchmark_rollout(device=device, node_count=8, frame_count=0)
    with pytest.raises(UsageError, match="nodes of a benchmark is -1"):
        benchmark_gradient(device=device, node_count=-1)


def test_the_two_simulators_agree_on_a_longer_and_stiffer_motion(device):
    scene = synthetic_block(120, frame_count=8, springs_at_node=30)
    stiff = replace(scene.model, stiffness=scene.model.stiffness * np.float32(10.0))
    result = rollout.measure_rollout(replace(scene, model=stiff), device, rounds=1)
    assert result["max_abs_difference_m"] < 5e-6
    assert result["motion_m"] > 5e-3
