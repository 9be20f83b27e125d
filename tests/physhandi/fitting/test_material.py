"""What the first-order stage learns, and where it stops learning."""

import math

import numpy as np
import pytest
import torch

from physhandi.adam import Adam
from physhandi.errors import FitError
from physhandi.fitting.config import FirstOrderConfig
from physhandi.fitting.spring_optimisation import Material
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters

PARAMETERS = SimulationParameters(
    restitution=0.4, friction=0.9, self_restitution=0.2, self_friction=1.1
)


def chain(*stiffness: float) -> SpringMassModel:
    """Nodes in a row, the last of which a control node holds."""
    count = len(stiffness)
    end = np.arange(count, dtype=np.int32)
    return SpringMassModel(
        object_node=np.outer(end, [0.1, 0.0, 0.0]).astype(np.float32),
        initial_velocity=np.zeros((count, 3), np.float32),
        spring_nodes=np.stack([end, end + 1], axis=1),
        rest_length=np.full(count, 0.1, np.float32),
        stiffness=np.array(stiffness, np.float32),
        damping=np.full(count, 5.0, np.float32),
        object_spring_count=count - 1,
        control_count=1,
    )


def material(model: SpringMassModel, **settings: object) -> Material:
    return Material({"a": model}, PARAMETERS, FirstOrderConfig(**settings))


def test_a_model_comes_back_as_it_was() -> None:
    model = chain(100.0, 200.0, 3e4)
    again = material(model).model("a", model)
    np.testing.assert_allclose(again.stiffness, model.stiffness, rtol=1e-5)
    np.testing.assert_allclose(again.damping, model.damping, rtol=1e-5)


def test_a_spring_above_the_most_acts_at_the_most_and_learns_nothing() -> None:
    model = chain(5e4, 2e5, 1e5)
    made = material(model, most_stiffness=1e5)
    log_stiffness, _ = made.of("a")
    assert log_stiffness.tolist() == pytest.approx([math.log(5e4), math.log(1e5), math.log(1e5)])
    log_stiffness.sum().backward()
    assert made.gradient("a").tolist()[:2] == [1.0, 0.0]
    assert made.model("a", model).stiffness[1] == pytest.approx(1e5, rel=1e-5)
    free = material(model)
    free.of("a")[0].sum().backward()
    assert free.gradient("a").tolist() == [1.0, 1.0, 1.0]


def test_a_spring_that_is_off_stays_off_while_others_take_adams_step() -> None:
    model = chain(100.0, 0.0, 300.0)
    made = material(model, learns_damping=False)
    optimizer = Adam([(tensor, 1e-3) for tensor in made.tensors()], betas=(0.9, 0.99))
    log_stiffness, damping = made.of("a")
    assert log_stiffness[1] == -math.inf
    assert damping.tolist() == pytest.approx([5.0, 0.0, 5.0])
    (log_stiffness.exp() * torch.tensor([1.0, 1.0, -1.0])).sum().backward()
    assert made.gradient("a").tolist() == pytest.approx([100.0, 0.0, -300.0])
    optimizer.step()
    # The first step of Adam is the learning rate, whatever the gradient's size.
    after = made.model("a", model)
    expected = [100.0 * math.exp(-1e-3), 0.0, 300.0 * math.exp(1e-3)]
    np.testing.assert_allclose(after.stiffness, expected, rtol=1e-5)
    np.testing.assert_allclose(after.damping, [5.0, 0.0, 5.0], rtol=1e-5)
    assert made.distance_from_start().item() == pytest.approx(2e-6, rel=1e-3)


def test_contact_is_learned_only_if_asked_for_and_stays_in_its_interval() -> None:
    model = chain(100.0, 200.0)
    assert material(model).contact() == {}
    assert material(model).parameters(PARAMETERS) == PARAMETERS
    made = material(model, learns_contact=True)
    contact = made.contact()
    assert {name: float(value.detach()) for name, value in contact.items()} == pytest.approx(
        {"restitution": 0.4, "friction": 0.9, "self_restitution": 0.2, "self_friction": 1.1}
    )
    assert len(made.tensors()) == len(made.logarithms()) + 4
    with torch.no_grad():
        contact["restitution"] -= 0.4047
        contact["friction"] += 1.1026
        contact["self_friction"] += 0.1
    expected = PARAMETERS.replace(restitution=0.0, friction=2.0, self_friction=1.2)
    learned = made.parameters(PARAMETERS)
    assert (learned.restitution, learned.friction) == (0.0, 2.0)
    assert learned.self_friction == pytest.approx(expected.self_friction)
    assert learned.self_restitution == pytest.approx(0.2)


def test_another_object_is_refused() -> None:
    models = {"a": chain(1.0, 1.0), "b": chain(1.0, 1.0, 1.0)}
    with pytest.raises(FitError, match="'b' connects"):
        Material(models, PARAMETERS, FirstOrderConfig())
