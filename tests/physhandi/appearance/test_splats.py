import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load, save

from physhandi.appearance.splats import Splats


def three_splats() -> dict[str, np.ndarray]:
    return {
        "center": np.arange(9, dtype=np.float32).reshape(3, 3) / 100,
        "scale": np.array([0.002, 0.003, 0.004], np.float32),
        "color": np.linspace(0, 1, 9, dtype=np.float32).reshape(3, 3),
        "opacity": np.array([0.0, 0.5, 1.0], np.float32),
        "rest_node": np.array([[0.0, 0.1, 0.2], [0.3, 0.4, 0.5]], np.float32),
    }


def test_splats_come_back_from_a_file_bit_by_bit() -> None:
    fields = three_splats()
    back = Splats.from_tensors(load(save(Splats(**fields).to_tensors())))
    for name, value in fields.items():
        assert getattr(back, name).dtype == np.float32
        np.testing.assert_array_equal(getattr(back, name), value)


Damage = Callable[[dict[str, Any]], object]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda t: t.pop("scale"), "Splats need the arrays center, color, opacity, rest_node"),
        (lambda t: t.update(more=t["scale"]), "got center, color, more, opacity"),
        (lambda t: t.update(scale=t["scale"][:2]), "scale is float32 (2,); expected float32 (3,)"),
        (
            lambda t: t.update(opacity=t["opacity"].astype(np.float64)),
            "opacity is float64 (3,); expected float32 (3,)",
        ),
        (lambda t: t.update(rest_node=t["rest_node"][:0]), "rest_node is empty"),
        (lambda t: t["center"].__setitem__((1, 2), np.nan), "center is not finite at 1, 2"),
        (lambda t: t["scale"].__setitem__(1, 0.0), "scale is not positive at splat 1"),
        (lambda t: t["color"].__setitem__((2, 0), 1.5), "color is not from 0 to 1 at 2, 0"),
        (lambda t: t["opacity"].__setitem__(0, -0.1), "opacity is not from 0 to 1 at 0"),
    ],
)
def test_wrong_arrays_are_named(damage: Damage, message: str) -> None:
    tensors = three_splats()
    damage(tensors)
    with pytest.raises(ValueError, match=re.escape(message)):
        Splats.from_tensors(tensors)
