"""Resolution and radius deviation on a grid, and against SciPy's full distances."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from physhandi.metrics.topology import radius_deviation, resolution


def test_resolution_of_a_square_grid() -> None:
    axis = np.arange(3) * 0.01
    node = np.stack([*np.meshgrid(axis, axis, indexing="ij"), np.zeros((3, 3))], -1).reshape(-1, 3)
    # Centre: 4 x 1; edges: 3 x 1 and one √2; corners: 2 x 1, one √2 and one 2.
    root = np.sqrt(2)
    per_node = [1.0] + [(3 + root) / 4] * 4 + [(4 + root) / 4] * 4
    assert resolution(node) == pytest.approx(0.01 * np.mean(per_node))


def test_resolution_agrees_with_all_distances() -> None:
    node = np.random.default_rng(1).normal(size=(50, 3))
    nearest = np.sort(cdist(node, node), axis=1)[:, 1:5]
    assert resolution(node) == pytest.approx(nearest.mean())


def test_few_nodes_have_few_neighbours() -> None:
    assert resolution(np.array([[0.0, 0, 0], [0.0, 0, 2.0]])) == pytest.approx(2.0)
    with pytest.raises(ValueError, match="1 nodes"):
        resolution(np.zeros((1, 3)))


def test_the_papers_ratio() -> None:
    # physics.md, section 9: with Δx = 4.6 mm PhysTwin's 22.6 and 50.1 mm give 0.64 and 2.63.
    assert radius_deviation(0.0226, 0.0046) == pytest.approx(0.64, abs=0.005)
    assert radius_deviation(0.0501, 0.0046) == pytest.approx(2.63, abs=0.005)
    assert radius_deviation(0.006, 0.004) == pytest.approx(0.5)  # Too short counts as well.
    assert radius_deviation(0.012, 0.004) == pytest.approx(0.0)
