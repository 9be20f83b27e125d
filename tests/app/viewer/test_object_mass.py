"""Forces as they are written for what an object weighs, against numbers computed by hand."""

from dataclasses import replace

import numpy as np
import pytest
from support.physics.spring_world import content_of, two_springs

from app.viewer.color.coloring import Painter
from app.viewer.compare.drawing import written_newtons
from app.viewer.compare.sides import ComparedSide
from app.viewer.content.layers import Layers
from app.viewer.inspect.picking import Pick
from app.viewer.inspect.readings import Readings, follow, hand_load, unit_of
from physhandi.data.object_mass import given_mass

NODE, SPRING = Pick(kind="node", index=0), Pick(kind="spring", index=1)


def test_forces_are_written_for_the_object_and_not_for_nodes_of_a_kilogram() -> None:
    rollout = two_springs()
    content = content_of(rollout, mass=given_mass(0.3))  # Three nodes: a tenth of the model.
    painter = Painter(content)
    readings = Readings(content, painter)
    assert dict(readings.rows(NODE, rollout, 2, 2))["held by"] == "control 0 (8 N)"
    row = dict(readings.rows(SPRING, rollout, 2, 2))
    assert (row["pull"], row["stiffness"]) == ("8 N", "8 N")
    unit, factor = unit_of("force", content, painter)
    assert unit == "N"
    curve = factor * follow(NODE, "force", rollout, content, painter)
    np.testing.assert_allclose(curve, 8.0, rtol=1e-6)
    painter.paint(rollout, 2, Layers(color="force"))
    legend = painter.legend
    assert legend is not None
    assert legend.scale.ticks[-1] == pytest.approx(8.0)  # Rounded as it is written.
    assert legend.scale.quantity.about.endswith("; for an object of 300 g (given)")
    painter.paint(rollout, 2, Layers(color="strain"))
    assert painter.legend is not None
    assert "300 g" not in painter.legend.scale.quantity.about


def test_a_mass_that_is_typed_counts_until_it_is_taken_back() -> None:
    rollout = two_springs()
    painter = Painter(content_of(rollout, mass=given_mass(0.3)))
    painter.weigh(3.0)
    assert painter.kilograms == 3.0
    assert painter.quantity("damping").factor == pytest.approx(1.0)
    assert painter.limits("force", rollout)[1] == pytest.approx(80.0)
    painter.weigh(None)
    assert painter.quantity("damping").factor == pytest.approx(0.1)
    # 80 N of the model are written as 8 N: the end of the scale is round in what is written.
    painter.weigh(0.3 / 7)
    high = painter.limits("force", rollout)[1] * painter.force_factor
    assert high == pytest.approx(1.2)


def test_without_a_mass_forces_are_those_of_the_model_and_say_so() -> None:
    rollout = two_springs()
    painter = Painter(content_of(rollout))
    assert (painter.force_factor, painter.kilograms) == (1.0, 3.0)
    assert painter.quantity("force").about.endswith("; for nodes of 1 kg each")


def test_sides_with_other_numbers_of_nodes_are_written_for_one_object() -> None:
    rollout = two_springs()
    model = rollout.model
    finer = replace(
        rollout,
        model=replace(
            model,
            object_node=np.concatenate([model.object_node] * 2),
            initial_velocity=np.zeros((6, 3), np.float32),
            spring_nodes=np.array([[0, 1], [6, 0]], np.int32),
            clearance=np.zeros(6, np.float32),
        ),
    )

    def side(rollout, mass) -> ComparedSide:
        content = content_of(rollout, mass=mass)
        return ComparedSide(
            name="x",
            title="",
            detail="",
            rollout=rollout,
            frame=0,
            content=content,
            content_frame=0,
        )

    sides = {"a": side(rollout, given_mass(0.3)), "b": side(finer, given_mass(0.3))}
    assert written_newtons(sides, None) == pytest.approx({"a": 0.1, "b": 0.05})
    assert written_newtons(sides, 0.6) == pytest.approx({"a": 0.2, "b": 0.1})
    unknown = sides | {"b": side(finer, None)}
    assert written_newtons(unknown, None) == {"a": 1.0, "b": 1.0}


def test_what_a_hand_does_is_summed_over_its_springs() -> None:
    position = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [9.0, 9.0, 9.0]])
    load = hand_load(
        np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]),
        node=np.array([0, 0, 1]),
        position=position,
        about=np.zeros(3),
    )
    assert (load.touched, load.strongest) == (2, 4.0)
    assert load.force.tolist() == [0.0, 0.0, 3.0]
    # (1, 0, 0) x (0, 0, 4) = (0, -4, 0) and (0, 2, 0) x (0, 0, -1) = (-2, 0, 0).
    assert load.moment.tolist() == [-2.0, -4.0, 0.0]
    none = np.zeros((0, 3))
    empty = hand_load(none, node=np.zeros(0, np.int64), position=position, about=np.zeros(3))
    assert (empty.touched, empty.strongest, empty.moment.tolist()) == (0, 0.0, [0.0, 0.0, 0.0])
