"""What the batch benchmark tells is measured, and compared candidate by candidate."""

import json
from dataclasses import replace

import numpy as np
import pytest

from physhandi.benchmarks import batch, timing
from physhandi.benchmarks.batch import benchmark_batch
from physhandi.benchmarks.phystwin_like import PhysTwinLike
from physhandi.errors import UsageError
from physhandi.simulation.engines.batch import losses_at_once

SMALL = {"node_count": 60, "frame_count": 3, "candidate_count": 5, "substeps_per_frame": 100}


@pytest.fixture(autouse=True)
def small_copies(monkeypatch):
    """Copy little, for a bandwidth that no test looks at closely."""
    monkeypatch.setattr(timing, "_COPY_SIZE", {"cpu": 1 << 20, "cuda": 1 << 20})


def test_a_batch_is_timed_a_candidate_and_compared(device):
    result = benchmark_batch(device=device, **SMALL)
    assert json.loads(json.dumps(result)) == result
    assert (result["nodes"], result["candidates"], result["diverged"]) == (60, 5, 0)
    assert 300 < result["median_springs"] < result["springs"]
    assert result["frames_per_s"] * result["ms_per_frame"] == pytest.approx(1e3)
    ratio = result["baseline_ms_per_frame"] / result["ms_per_frame"]
    assert result["speedup"] == pytest.approx(ratio)
    # The baseline's atomics add in any order, and a node may touch the ground a substep earlier.
    assert 0.0 < result["max_abs_difference_m"] < (2e-6 if device == "cpu" else 5e-5)
    assert 2e-3 < result["motion_m"] < 0.02
    assert result["bytes_per_frame"] == 100 * 48 * 60


def test_a_shared_batch_is_timed_and_compared_with_the_whole_one(monkeypatch):
    brief = SMALL | {"substeps_per_frame": 60}
    result = benchmark_batch(device="cpu", more_devices=("cpu",), **brief)
    assert json.loads(json.dumps(result)) == result
    shared = result["shared"]
    assert shared["devices"] == 2
    assert shared["speedup"] == pytest.approx(result["ms_per_frame"] / shared["ms_per_frame"])
    assert shared["largest_loss_difference"] == 0.0
    swapped = lambda simulators, *scene: losses_at_once(simulators[::-1], *scene)  # noqa: E731
    monkeypatch.setattr(batch, "losses_at_once", swapped)
    other = benchmark_batch(device="cpu", more_devices=("cpu",), **brief)["shared"]
    assert other["largest_loss_difference"] > 1e-4


def test_another_physics_is_not_called_the_same(device, monkeypatch):
    def softer(model, parameters, device):
        soft = replace(model, stiffness=model.stiffness * np.float32(0.5))
        return PhysTwinLike(soft, parameters, device)

    monkeypatch.setattr(batch, "PhysTwinLike", softer)
    assert benchmark_batch(device=device, **SMALL)["max_abs_difference_m"] > 1e-4


def test_candidates_that_make_no_sense_are_named(device):
    with pytest.raises(UsageError, match="candidates of a benchmark is 0"):
        benchmark_batch(device=device, **(SMALL | {"candidate_count": 0}))
