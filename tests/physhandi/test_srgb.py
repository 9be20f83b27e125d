"""The curve of sRGB at values of its standard."""

import numpy as np

from physhandi.srgb import to_linear, to_srgb


def test_color_values_and_light_belong_together() -> None:
    value = np.arange(256) / 255
    light = to_linear(value)
    # By the table of IEC 61966-2-1; the straight part ends between 10 and 11.
    np.testing.assert_allclose(
        light[[0, 10, 11, 128, 255]], [0.0, 0.003035, 0.003347, 0.215861, 1.0], atol=5e-7
    )
    np.testing.assert_allclose(to_srgb(light), value, atol=2e-7)
