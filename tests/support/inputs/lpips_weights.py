"""Random weights for LPIPS, of the shapes and under the names of the published ones."""

from pathlib import Path

import numpy as np
import torch

Weights = dict[str, np.ndarray]
ALEXNET = (
    # Channels, size, stride and padding of each convolution; whether it begins with pooling.
    ("features.0", 3, 64, 11, 4, 2, False),
    ("features.3", 64, 192, 5, 1, 2, True),
    ("features.6", 192, 384, 3, 1, 1, True),
    ("features.8", 384, 256, 3, 1, 1, False),
    ("features.10", 256, 256, 3, 1, 1, False),
)


def alexnet_weights() -> Weights:
    """AlexNet as torchvision stores it, with a weight of the classifier, which is not needed."""
    random = np.random.default_rng(1)
    weights: Weights = {"classifier.6.bias": np.zeros(1000, np.float32)}
    for name, before, after, size, *_ in ALEXNET:
        deviation = (2.0 / (before * size**2)) ** 0.5
        weight = random.normal(0.0, deviation, (after, before, size, size))
        weights[f"{name}.weight"] = weight.astype(np.float32)
        weights[f"{name}.bias"] = random.normal(0.0, 0.1, after).astype(np.float32)
    return weights


def head_weights() -> Weights:
    """Weights of the differences, none of them negative."""
    random = np.random.default_rng(2)
    return {
        f"lin{number}.model.1.weight": random.uniform(0, 0.5, (1, layer[2], 1, 1)).astype("f4")
        for number, layer in enumerate(ALEXNET)
    }


def write_weights(path: Path, weights: Weights, *, is_zipped: bool = True) -> None:
    """Write them as PyTorch does, or did before it wrote archives."""
    tensors = {key: torch.nn.Parameter(torch.from_numpy(value)) for key, value in weights.items()}
    torch.save(tensors, path, _use_new_zipfile_serialization=is_zipped)


def write_lpips(folder: Path) -> Path:
    """Write both files under the names that they are published with."""
    folder.mkdir(parents=True, exist_ok=True)
    write_weights(folder / "alexnet-owt-7be5be79.pth", alexnet_weights())
    write_weights(folder / "alex.pth", head_weights())
    return folder
