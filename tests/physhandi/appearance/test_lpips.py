"""LPIPS by random weights of the official shapes, against its sums written out in NumPy."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file
from support.hostile.foreign_pickle import Call, Global, python2_pickle
from support.inputs.lpips_weights import (
    ALEXNET,
    Weights,
    alexnet_weights,
    head_weights,
    write_lpips,
    write_weights,
)

from physhandi.appearance.lpips import Lpips, user_lpips
from physhandi.errors import UsageError

SHAPE = (47, 70)


@pytest.fixture(scope="module")
def backbone() -> Weights:
    return alexnet_weights()


@pytest.fixture(scope="module")
def heads() -> Weights:
    return head_weights()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_lpips(tmp_path)


def two_pictures() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(3)
    first = random.uniform(0.0, 1.0, (*SHAPE, 3))
    return first, np.clip(first + random.normal(0.0, 0.2, first.shape), 0.0, 1.0)


def windows(image: np.ndarray, size: int, stride: int) -> np.ndarray:
    """Cut (channel, row, column, size, size) out of an image of channels."""
    found = np.lib.stride_tricks.sliding_window_view(image, (size, size), axis=(1, 2))
    return found[:, ::stride, ::stride]


def layers_by_hand(
    first: np.ndarray, second: np.ndarray, backbone: Weights, heads: Weights
) -> list[np.ndarray]:
    """The weighted squared difference of each layer, at each of its places."""
    both = []
    for picture in (first, second):
        colors = 2.0 * picture.transpose(2, 0, 1) - 1.0
        middle = np.array([-0.030, -0.088, -0.188])[:, None, None]
        x = (colors - middle) / np.array([0.458, 0.448, 0.450])[:, None, None]
        units = []
        for name, _, _, size, stride, padding, is_pooled in ALEXNET:
            if is_pooled:
                x = windows(x, 3, 2).max(axis=(3, 4))
            x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
            weight = backbone[f"{name}.weight"].astype(np.float64)
            x = np.einsum("oiab,irsab->ors", weight, windows(x, size, stride), optimize=True)
            x = np.maximum(x + backbone[f"{name}.bias"][:, None, None], 0.0)
            units.append(x / (np.sqrt((x**2).sum(axis=0)) + 1e-10))
        both.append(units)
    return [
        np.einsum("o,ors->rs", heads[f"lin{number}.model.1.weight"][0, :, 0, 0], (a - b) ** 2)
        for number, (a, b) in enumerate(zip(*both, strict=True))
    ]


def spread(count: int, size: int) -> np.ndarray:
    """Weights (pixel, place) of linear interpolation; places lie in the middle of equal parts."""
    at = np.clip((np.arange(size) + 0.5) * count / size - 0.5, 0, count - 1)
    return np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(count)))


def test_the_distance_is_the_sum_of_layers_as_the_paper_has_it(
    folder: Path, backbone: Weights, heads: Weights
) -> None:
    first, second = two_pictures()
    network = Lpips(folder)
    layers = layers_by_hand(first, second, backbone, heads)
    expected = sum(layer.mean() for layer in layers)
    assert expected > 0.1
    assert [layer.shape for layer in layers] == [(11, 16), (5, 7), (2, 3), (2, 3), (2, 3)]
    assert network(first, second) == pytest.approx(expected, rel=1e-4)
    assert network(second, first) == pytest.approx(expected, rel=1e-4)
    assert network(first, first) == 0.0


def test_over_some_pixels_it_is_the_mean_of_interpolated_layers(
    folder: Path, backbone: Weights, heads: Weights
) -> None:
    first, second = two_pictures()
    second[:, :35] = first[:, :35]
    where = np.zeros(SHAPE, bool)
    where[5:30, 40:66] = True
    expected = 0.0
    for layer in layers_by_hand(first, second, backbone, heads):
        rows, columns = (spread(layer.shape[axis], SHAPE[axis]) for axis in (0, 1))
        expected += (rows @ layer @ columns.T)[where].mean()
    network = Lpips(folder)
    found = network(first, second, where)
    assert found == pytest.approx(expected, rel=1e-4)
    assert found > 1.2 * network(first, second)
    assert np.isnan(network(first, second, np.zeros(SHAPE, bool)))


def test_pictures_that_are_too_small_have_none(folder: Path) -> None:
    first, second = two_pictures()
    network = Lpips(folder)
    assert network(first[:31, :31], second[:31, :31]) > 0.0
    assert np.isnan(network(first[:30], second[:30]))


def test_safetensors_and_old_files_of_pytorch_give_the_same(
    folder: Path, tmp_path: Path, backbone: Weights, heads: Weights
) -> None:
    other = tmp_path / "other"
    other.mkdir()
    save_file(backbone, other / "alexnet.safetensors")
    write_weights(other / "alex.pt", heads, is_zipped=False)
    one, same = Lpips(folder), Lpips(other)
    assert one(*two_pictures()) == same(*two_pictures())
    assert one.sha256 != same.sha256  # Of other files.


def test_only_a_folder_that_the_user_names_is_read(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PHYSHANDI_LPIPS", raising=False)
    assert user_lpips() is None
    monkeypatch.setenv("PHYSHANDI_LPIPS", str(folder))
    found = user_lpips()
    assert found is not None
    assert found.sha256 == Lpips(folder).sha256
    (folder / "alex.pth").unlink()
    with pytest.raises(UsageError, match=r"PHYSHANDI_LPIPS: .*one file alex\.pth .* there: none\."):
        user_lpips()


def without(key: str) -> Callable[[Weights], Weights]:
    return lambda weights: {name: value for name, value in weights.items() if name != key}


def filled(key: str, shape: tuple[int, ...], value: float = 1.0) -> Callable[[Weights], Weights]:
    return lambda weights: weights | {key: np.full(shape, value, np.float32)}


@pytest.mark.parametrize(
    ("name", "change", "told"),
    [
        ("alexnet-owt-7be5be79.pth", without("features.6.bias"), "no weight 'features.6.bias'"),
        (
            "alexnet-owt-7be5be79.pth",
            filled("features.0.weight", (64, 3, 3, 3)),
            "'features.0.weight' has shape (64, 3, 3, 3); expected (64, 3, 11, 11)",
        ),
        ("alex.pth", without("lin4.model.1.weight"), "no weight 'lin4.model.1.weight'"),
        (
            "alex.pth",
            filled("lin1.model.1.weight", (1, 128, 1, 1)),
            "'lin1.model.1.weight' has shape (1, 128, 1, 1); expected (1, 192, 1, 1)",
        ),
        (
            "alex.pth",
            filled("lin0.model.1.weight", (1, 64, 1, 1), np.nan),
            "'lin0.model.1.weight' holds values that are not finite",
        ),
    ],
)
def test_weights_of_something_else_are_refused_by_file_and_key(
    folder: Path,
    backbone: Weights,
    heads: Weights,
    name: str,
    change: Callable[[Weights], Weights],
    told: str,
) -> None:
    write_weights(folder / name, change(heads if name == "alex.pth" else backbone))
    with pytest.raises(UsageError) as refused:
        Lpips(folder)
    assert f"{name}: " in str(refused.value)
    assert told in str(refused.value)


def test_files_that_hold_code_or_nothing_named_are_refused_unexecuted(folder: Path) -> None:
    trace = folder / "executed"
    call = Call(Global("pathlib", "Path.touch"), (str(trace),))
    for content in (python2_pickle({"lin0.model.1.weight": call}), b"nothing of the kind"):
        (folder / "alex.pth").write_bytes(content)
        with pytest.raises(UsageError, match=r"alex\.pth cannot be read as plain tensors"):
            Lpips(folder)
    torch.save(torch.ones(3), folder / "alex.pth")
    with pytest.raises(UsageError, match=r"alex\.pth holds no tensors by name"):
        Lpips(folder)
    assert not trace.exists()


def test_two_backbones_are_not_chosen_from(folder: Path) -> None:
    (folder / "alexnet.pt").write_bytes(b"")
    with pytest.raises(UsageError, match=r"there: alexnet-owt-7be5be79\.pth, alexnet\.pt"):
        Lpips(folder)
