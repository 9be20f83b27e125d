"""The legend in the corner of a picture."""

from dataclasses import replace

import numpy as np
import pytest
from support.viewer.viewer_world import content_of, controls

from app.viewer.color.coloring import Painter
from app.viewer.color.legend import Legend, draw_legend
from app.viewer.content.layers import Layers


@pytest.fixture
def legend() -> Legend:
    content = content_of({}, controls((0.0, 0.0, 1.0)))
    painter = Painter(content)
    assert content.fitted is not None
    painter.paint(content.fitted, 3, Layers(color="strain", color_range=(-0.1, 0.1)))
    assert painter.legend is not None
    return painter.legend


def test_the_scale_runs_from_its_low_to_its_high_color(legend: Legend) -> None:
    image = np.full((360, 640, 3), 255, np.uint8)
    drawn = draw_legend(image, legend, is_dark=False)
    assert (image == 255).all()
    ramp = legend.scale.ramp
    bar = drawn[np.flatnonzero((drawn == ramp[0]).all(axis=-1).any(axis=1))[2]]
    colored = np.flatnonzero((bar != 255).any(axis=1))
    np.testing.assert_array_equal(bar[colored[0]], ramp[0])
    np.testing.assert_array_equal(bar[colored[-1]], ramp[-1])
    middle = bar[(colored[0] + colored[-1]) // 2].astype(int)
    assert np.abs(middle - ramp[len(ramp) // 2]).max() <= 6
    below = drawn[300:, :200]
    assert (below.max(axis=-1) < 170).sum() > 50  # The numbers, in ink.
    assert (drawn[:200] == 255).all()


def test_a_small_picture_keeps_its_room(legend: Legend) -> None:
    image = np.zeros((100, 640, 3), np.uint8)
    assert draw_legend(image, legend, is_dark=True) is image
    other = replace(legend, scale=replace(legend.scale, limits=(0.0, 1.0)))
    big = np.zeros((400, 400, 3), np.uint8)
    assert (draw_legend(big, legend, is_dark=True) != draw_legend(big, other, is_dark=True)).any()
