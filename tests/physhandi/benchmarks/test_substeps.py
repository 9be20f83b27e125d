"""Automatic substeps end where the reference's 667 end, on the bundled towel."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from reference.scenes import as_model, cube_scene
from safetensors.numpy import load_file

from physhandi.benchmarks.substeps import benchmark_substeps
from physhandi.errors import SimulationDivergedError, UsageError
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.stability import stable_substeps

RUN = Path(__file__).resolve().parents[3] / "sequences/runs/towel_fold_quick/attempts/1/out"


def bundled():
    """Read the bundled run's object and the motion of its hand."""
    folder = RUN / "sequences/towel_fold"
    model = SpringMassModel.from_tensors(load_file(folder / "model.safetensors"))
    text = (RUN / "object/parameters.yaml").read_text(encoding="utf-8")
    parameters = SimulationParameters.from_dict(yaml.safe_load(text))
    return model, parameters, np.load(folder / "control.npy", allow_pickle=False)


def test_the_towel_stays_within_a_millimetre_of_the_reference(device):
    model, parameters, control = bundled()
    result = benchmark_substeps(
        model, parameters, control[:36], name="towel", device=device, substeps=(300,)
    )
    assert json.loads(json.dumps(result)) == result
    assert result["motion_m"] > 0.1
    # 30 frames a second and no substep longer than 1/3600 s.
    assert result["substeps"] == max(result["stable_substeps"], 120) < 667
    assert 1e-6 < result["mean_difference_m"] < 2e-4
    assert result["mean_difference_m"] < result["worst_frame_mean_difference_m"] < 1e-3
    assert result["worst_frame_mean_difference_m"] < result["max_abs_difference_m"]
    table = {row["substeps"]: row for row in result["table"]}
    assert set(table) == {result["substeps"], parameters.substeps_per_frame, 300, 666, 667, 700}
    assert table[667]["max_abs_difference_m"] == 0.0
    assert [row["substeps"] for row in result["scatter_of_reference"]] == [666, 700]
    for row in table.values():
        assert row["ms_per_frame"] > 0.0


def test_the_towel_diverges_beyond_the_limit_of_stability(device):
    model, parameters, control = bundled()
    limit = stable_substeps(model, parameters, control[0], safety=1.0)
    few = int(0.6 * limit)  # The estimate is a bound, below which a mode has to grow in time.
    with pytest.raises(SimulationDivergedError):
        benchmark_substeps(model, parameters, control, name="towel", device=device, substeps=(few,))


def test_a_motion_of_no_frame_is_refused(device):
    scene = cube_scene()
    model, parameters = as_model(scene)
    with pytest.raises(UsageError, match="cube has 1 frames"):
        benchmark_substeps(model, parameters, scene.control[:1], name="cube", device=device)
