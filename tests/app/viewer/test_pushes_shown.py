"""Pushes of hands among the force arrows, and in what a click tells."""

from dataclasses import replace

import numpy as np
import pytest
from support.physics.palm import WEIGHT, on_a_palm
from support.physics.spring_world import content_of

from app.viewer.color.coloring import Painter
from app.viewer.color.quantities import measure
from app.viewer.content.content import ShownHand
from app.viewer.inspect.picking import Pick
from app.viewer.inspect.readings import Readings, follow
from app.viewer.scene.object_drawing import force_arrows, strengths
from physhandi.object_rollout import ObjectRollout

AT = 11
UNIT = 0.003
"""Length of an arrow of 1 N."""


@pytest.fixture(scope="module")
def resting() -> ObjectRollout:
    return on_a_palm()


def arrows(rollout: ObjectRollout, longest: float = 9.0, most: int = 100) -> np.ndarray:
    return force_arrows(rollout, AT, UNIT, longest, most)


def test_arrows_of_what_rests_on_a_palm_add_up_to_its_weight(resting: ObjectRollout) -> None:
    shown = arrows(resting)
    total = (shown[:, 1] - shown[:, 0]).sum(axis=0) / UNIT
    np.testing.assert_allclose(total, [0.0, 0.0, WEIGHT], atol=0.01 * WEIGHT)
    order = np.argsort(-np.linalg.norm(resting.forces(AT), axis=1))
    np.testing.assert_allclose(shown[:, 0], resting.position[AT][order], atol=1e-7)
    assert len(arrows(resting, most=2)) == 2
    # Their length is chosen for them, and they are in the color of forces.
    assert np.median(strengths(resting)) == pytest.approx(WEIGHT / 4, rel=0.3)
    colored = measure("force", resting, AT).node
    np.testing.assert_allclose(colored, np.linalg.norm(resting.forces(AT), axis=1))
    off = replace(resting, parameters=resting.parameters.replace(hand_pushes=False))
    assert not len(arrows(off))


def test_a_click_tells_the_push_on_a_node_and_of_the_whole_hand(resting: ObjectRollout) -> None:
    hand = ShownHand(side="right", vertex=resting.control, face=resting.model.hand_face)
    content = content_of(resting, hands=(hand,))
    painter = Painter(content)
    readings = Readings(content, painter)
    factor = painter.force_factor
    node = Pick(kind="node", index=1)
    rows = dict(readings.rows(node, resting, AT, AT))
    push = factor * np.linalg.norm(resting.forces(AT)[1])
    assert float(rows["force of the hand"].split()[0]) == pytest.approx(push, rel=0.01)
    rows = dict(readings.rows(Pick(kind="control", index=0), resting, AT, AT))
    assert rows["right hand"] == "holds and pushes 4 nodes"
    assert float(rows["its force"].split()[0]) == pytest.approx(factor * WEIGHT, rel=0.01)
    for kind in ("force", "mean force"):
        curve = follow(node, kind, resting, content, painter)
        assert curve[AT] == pytest.approx(push / factor, rel=0.05), kind
    off = replace(resting, parameters=resting.parameters.replace(hand_pushes=False))
    rows = dict(readings.rows(Pick(kind="control", index=0), off, AT, AT))
    assert rows["right hand"] == "holds 0 nodes"
