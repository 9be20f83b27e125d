"""What lights scenes from all around is as bright and colored as the image that it was made of."""

import re
from typing import Any

import cv2
import numpy as np
import viser._scene_api as viser_scenes
from numpy import ndarray

from app.viewer.scene.scene_server import SURROUNDINGS


def radiance(content: bytes) -> ndarray:
    """Decode an image with a gain map (ISO 21496-1), linear: row, column, channel."""
    second = content.index(b"\xff\xd8\xff", 4)
    parts = (np.frombuffer(part, np.uint8) for part in (content[:second], content[second:]))
    shown, gain = (cv2.imdecode(part, cv2.IMREAD_COLOR) / 255.0 for part in parts)
    base = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)

    def told(name: str) -> float:
        found = re.search(rf'hdrgm:{name}="([^"]+)"'.encode(), content)
        assert found is not None, name
        return float(found[1])

    low, high = told("GainMapMin"), told("GainMapMax")
    return (base + told("OffsetSDR")) * 2 ** (low + gain * (high - low)) - told("OffsetHDR")


def by_direction(image: ndarray) -> ndarray:
    """Average over eighths of all directions by their solid angles: row, column, channel."""
    rows, columns, _ = image.shape
    weight = np.sin(np.pi * (np.arange(rows) + 0.5) / rows).reshape(2, rows // 2, 1, 1, 1)
    parts = image.reshape(2, rows // 2, 4, columns // 4, 3)
    return (weight * parts).sum(axis=(1, 3)) / (weight.sum(axis=1) * (columns // 4))[..., 0, :]


def test_scenes_are_lit_as_by_the_image_of_sixteen_times_as_many_pixels() -> None:
    presets: Any = viser_scenes
    original, ours = (
        radiance(c) for c in (presets._read_hdri_preset("city"), SURROUNDINGS.read_bytes())
    )
    assert original.shape == (512, 1024, 3)
    assert ours.shape == (128, 256, 3)
    expected = by_direction(original)
    assert expected.max() > 3.0 * expected.min()  # Directions differ in what comes from them.
    np.testing.assert_allclose(by_direction(ours), expected, rtol=0.02)
