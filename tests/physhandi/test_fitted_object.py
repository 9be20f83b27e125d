from pathlib import Path

import numpy as np
import pytest
import yaml
from viewer_world import PARAMETERS, make_run

from physhandi.fitted_object import FittedObject
from physhandi.object_rollout import load_fitted
from physhandi.run import Run
from physhandi.simulation.topology import retopologize


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Run:
    return make_run(tmp_path_factory.mktemp("runs") / "sheet")


@pytest.fixture
def fitted(run) -> FittedObject:
    return FittedObject.of(run, "lift")


@pytest.mark.parametrize(
    ("field", "factor", "own", "virtual", "damping"),
    [
        ("stiffness", 0.5, 0.5, 1.0, 1.0),
        ("virtual_stiffness", 3.0, 1.0, 3.0, 1.0),
        ("damping", 4.0, 1.0, 1.0, 4.0),
    ],
)
def test_material_is_scaled_for_its_own_springs_alone(
    fitted, field, factor, own, virtual, damping
) -> None:
    was = fitted.begin(PARAMETERS).model
    count = was.object_spring_count
    assert 0 < count < len(was.stiffness)
    now = fitted.begin(PARAMETERS.replace(**{field: factor * getattr(PARAMETERS, field)})).model
    np.testing.assert_allclose(now.stiffness[:count], own * was.stiffness[:count], rtol=1e-6)
    np.testing.assert_allclose(now.stiffness[count:], virtual * was.stiffness[count:], rtol=1e-6)
    np.testing.assert_allclose(now.damping, damping * was.damping, rtol=1e-6)


def test_material_is_what_a_run_of_its_own_would_get(fitted, run) -> None:
    changed = PARAMETERS.replace(stiffness=90.0, virtual_stiffness=7000.0, damping=11.0)
    now = fitted.begin(changed).model
    model, control = fitted.model, run.array("sequences/lift/control.npy")
    rest = run.tensors("object/material.safetensors")["rest_node"]
    anew = retopologize(model, changed, control[0], fitted=PARAMETERS, rest_node=rest)
    np.testing.assert_array_equal(now.spring_nodes, anew.spring_nodes)
    np.testing.assert_allclose(now.stiffness, anew.stiffness, rtol=1e-5)
    np.testing.assert_allclose(now.damping, anew.damping, rtol=1e-5)


def test_the_world_is_that_of_the_sequence(tmp_path: Path) -> None:
    run = make_run(tmp_path / "moon")
    meta = run.out / "sequences/lift/meta.yaml"
    content = yaml.safe_load(meta.read_text())
    content |= {"frame_rate": 60.0, "gravity": 1.62, "ground_height": None}
    meta.write_text(yaml.safe_dump(content))
    for name, world in (("lift", (60.0, None, 1.62)), ("drag", (30.0, 0.0, 9.81))):
        take = load_fitted(run, name)
        assert take is not None
        found = take.parameters
        assert (found.frame_rate, found.ground_height, found.gravity) == world
