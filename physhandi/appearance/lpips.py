"""How different two pictures look to a network (LPIPS), if the user has its weights.

Zhang et al., *The Unreasonable Effectiveness of Deep Features as a Perceptual Metric*, 2018,
version 0.1 with AlexNet: features of the five convolutions, brought to unit length, are subtracted,
squared and summed with weights that were fitted to what people see. Weights are read from a folder
of this machine as plain tensors; nothing is downloaded.
"""

import os
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor
from torch.nn import functional

from physhandi.errors import UsageError
from physhandi.perception.mask_model import content_hash
from physhandi.perception.track_model import read_weights

LPIPS_VARIABLE = "PHYSHANDI_LPIPS"
LEAST_SIDE = 31
"""Pixels that both sides of an image must have, since the network halves it again and again."""
_BACKBONE, _HEADS = "alexnet", "alex"
"""How the names of the two files begin and what the other is called, but for their endings."""
_ENDINGS = {".pth", ".pt", ".safetensors"}
_LAYERS = {
    "features.0": ((64, 3, 11, 11), 4, 2),
    "features.3": ((192, 64, 5, 5), 1, 2),
    "features.6": ((384, 192, 3, 3), 1, 1),
    "features.8": ((256, 384, 3, 3), 1, 1),
    "features.10": ((256, 256, 3, 3), 1, 1),
}
"""AlexNet's convolutions as torchvision names them: shape of the weight, stride and padding."""
_POOLED = {"features.3", "features.6"}
"""Those that take the largest of each 3 x 3 features, every other row and column."""
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Of colors from -1 to 1."""
_LEAST_LENGTH = 1e-10
_REMEDY = "docs/metrics.md (Pictures) says which two files the folder needs, and where they are."


class Lpips:
    """The network, which compares two pictures at a time."""

    def __init__(self, folder: Path, device: str = "cpu") -> None:
        """Read its weights.

        Args:
            folder: One ``alexnet*`` of torchvision and one ``alex`` of the package lpips (version
                0.1), each as ``.pth``, ``.pt`` or ``.safetensors``.
            device: Where it computes, as PyTorch or Warp names it.

        Raises:
            UsageError: If a file is missing or damaged, or holds weights of something else.
        """
        backbone = _file(folder, f"{_BACKBONE}*")
        heads = _file(folder, _HEADS)
        features, linear = read_weights(backbone), read_weights(heads)
        self.sha256 = content_hash([backbone, heads])
        """Of names and contents of both files."""
        self._device = device
        self._weights: list[tuple[Tensor, Tensor, Tensor]] = []
        for number, (name, (shape, _, _)) in enumerate(_LAYERS.items()):
            head = (1, shape[0], 1, 1)
            weight = _tensor(features, f"{name}.weight", shape, backbone)
            bias = _tensor(features, f"{name}.bias", shape[:1], backbone)
            linear_weight = _tensor(linear, f"lin{number}.model.1.weight", head, heads)
            self._weights.append((weight.to(device), bias.to(device), linear_weight.to(device)))

    def __call__(
        self,
        first: Float[ndarray, "row column 3"],
        second: Float[ndarray, "row column 3"],
        where: Bool[ndarray, "row column"] | None = None,
    ) -> float:
        """Compare two pictures of a size (sRGB, 0 to 1).

        Args:
            first: One of them; which one makes no difference.
            second: The other.
            where: Pixels over which the mean is taken, for which the difference of each layer is
                interpolated to the size of the pictures; None for the mean of each whole layer.

        Returns:
            Sum over layers, 0 for equal pictures; NaN for pictures that are smaller than
            `LEAST_SIDE`, and where no pixel is chosen.
        """
        size = first.shape[:2]
        if min(size) < LEAST_SIDE or (where is not None and not where.any()):
            return float("nan")
        pair = torch.from_numpy(np.stack([first, second]).astype(np.float32)).to(self._device)
        shift, scale = (pair.new_tensor(value) for value in (_SHIFT, _SCALE))
        # With all bits of float32 and by a fixed algorithm: the same figure every time.
        exact = torch.backends.cudnn.flags(
            enabled=True, benchmark=False, deterministic=True, allow_tf32=False
        )
        with torch.no_grad(), exact:
            feature = ((2.0 * pair - 1.0 - shift) / scale).permute(0, 3, 1, 2)
            total = pair.new_zeros(())
            for (name, (_, stride, padding)), (weight, bias, head) in zip(
                _LAYERS.items(), self._weights, strict=True
            ):
                if name in _POOLED:
                    feature = functional.max_pool2d(feature, kernel_size=3, stride=2)
                feature = functional.conv2d(feature, weight, bias, stride, padding).relu()
                unit = feature / (feature.norm(dim=1, keepdim=True) + _LEAST_LENGTH)
                difference = ((unit[:1] - unit[1:]) ** 2 * head).sum(dim=1, keepdim=True)
                if where is not None:
                    difference = functional.interpolate(
                        difference, size, mode="bilinear", align_corners=False
                    )[0, 0][torch.from_numpy(where).to(self._device)]
                total = total + difference.mean()
        return float(total)


def user_lpips(device: str = "cpu") -> Lpips | None:
    """Read the network from the folder that ``$PHYSHANDI_LPIPS`` names; None if it names none.

    Raises:
        UsageError: If the folder lacks a file, or one cannot be used.
    """
    folder = os.environ.get(LPIPS_VARIABLE)
    return Lpips(Path(folder).absolute(), device) if folder else None


def _file(folder: Path, stem: str) -> Path:
    """Find the one file of weights whose name is this but for its ending."""
    matches = sorted(path for path in folder.glob(f"{stem}.*") if path.suffix in _ENDINGS)
    if len(matches) != 1:
        there = ", ".join(path.name for path in matches) or "none"
        raise UsageError(
            f"{LPIPS_VARIABLE}: {folder} must hold one file {stem}.pth (or .pt, .safetensors); "
            f"there: {there}. {_REMEDY}"
        )
    return matches[0]


def _tensor(stored: dict[str, Tensor], key: str, shape: tuple[int, ...], path: Path) -> Tensor:
    """Look up a weight, and check it."""
    tensor = stored.get(key)
    if not isinstance(tensor, Tensor):
        raise UsageError(f"{path}: has no weight '{key}'. {_REMEDY}")
    if tensor.shape != shape:
        raise UsageError(
            f"{path}: '{key}' has shape {tuple(tensor.shape)}; expected {shape}. {_REMEDY}"
        )
    tensor = tensor.detach().float()
    if not tensor.isfinite().all():
        raise UsageError(f"{path}: '{key}' holds values that are not finite. {_REMEDY}")
    return tensor
