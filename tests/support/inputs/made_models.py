"""Networks as users have them in folders: a random SAM 2, and trackers that match windows."""

import os
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import torch

SIDE = 128
"""Side of the images that the made SAM 2 works at [px]."""

_SMALL: dict[str, Any] = {
    "prompt_encoder_config": {"hidden_size": 128, "image_size": SIDE},
    "mask_decoder_config": {
        "hidden_size": 128,
        "mlp_dim": 32,
        "iou_head_hidden_dim": 32,
        "num_attention_heads": 2,
    },
    "image_size": SIDE,
    "memory_attention_hidden_size": 128,
    "memory_attention_num_layers": 1,
    "memory_attention_rope_feat_sizes": [SIDE // 16] * 2,
    "memory_encoder_hidden_size": 128,
    "mask_downsampler_embed_dim": 128,
    "memory_fuser_embed_dim": 128,
    "memory_fuser_intermediate_dim": 32,
    "memory_fuser_num_layers": 1,
}
"""What both networks share, far smaller than they come."""

_MATCHING = '''
import os
from pathlib import Path

import torch

(Path(__file__).parent / "ran.txt").write_text(str(os.getpid()))


def patches(image, place, reach):
    """Values (point, window) of a gray image around whole places (point, 2) as x, y."""
    step = torch.arange(-reach, reach + 1, device=image.device)
    row = (place[:, 1, None] + step).clamp(0, image.shape[0] - 1)
    column = (place[:, 0, None] + step).clamp(0, image.shape[1] - 1)
    return image[row[:, :, None], column[:, None, :]].flatten(1)


class Matcher(torch.nn.Module):
    """Finds where a window of the first image is in others; needs its weight for that."""

    def __init__(self, window, search):
        super().__init__()
        self.gain = torch.nn.Parameter(torch.zeros(1))
        self.window, self.search = window, search

    def start(self, image, place):
        self.place = place.round().long()
        self.rest = place - self.place
        self.template = patches(image, self.place, self.window)

    def step(self, image):
        step = torch.arange(-self.search, self.search + 1, device=image.device)
        there = self.place[:, None] + torch.cartesian_prod(step, step).flip(1)
        seen = patches(image, there.flatten(0, 1), self.window).unflatten(0, there.shape[:2])
        least, best = ((seen - self.template[:, None]) ** 2).mean(2).min(1)
        self.place = there[torch.arange(len(there)), best]
        return self.gain * (self.place + self.rest), least
'''

_HUB = (
    _MATCHING
    + """

class Predictor(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.model = Matcher(4, 3)

    @torch.no_grad()
    def forward(self, video, queries=None, segm_mask=None, grid_size=0, grid_query_frame=0,
                backward_tracking=False):
        assert video.dtype == torch.float32 and video.max() > 2
        assert (queries[0, :, 0] == 0).all()
        images = video[0].mean(1)
        self.model.start(images[0], queries[0, :, 1:])
        found = [self.model.step(image) for image in images]
        return (torch.stack([place for place, _ in found])[None],
                torch.stack([cost < 400 for _, cost in found])[None])


def cotracker3_offline(*, pretrained=True, **kwargs):
    assert not pretrained, "it would be downloaded"
    return Predictor()
"""
)

BREAKS_OFF = "breaks_off"
"""A file in whose presence, in its folder, a TAPNext ends its process at once."""
_TAPNEXT = (
    _MATCHING
    + """

class TAPNext(torch.nn.Module):
    def __init__(self, image_size):
        super().__init__()
        self.image_size = image_size
        self.matcher = Matcher(8, 8)

    def forward(self, video, query_points=None, state=None):
        if (Path(__file__).parents[2] / "breaks_off").exists():
            os.abort()
        assert video.shape == (1, 1, *self.image_size, 3)
        assert -1 <= video.min() < -0.1 and video.max() <= 1
        image = 127.5 * (video[0, 0].mean(-1) + 1)
        if state is None:
            assert (query_points[0, :, 0] == 0).all()
            self.matcher.start(image, query_points[0, :, [2, 1]] - 0.5)
        place, cost = self.matcher.step(image)
        logit = torch.where(cost < 400, 3.0, -3.0)[None, None, :, None]
        return place.flip(-1)[None, None] + 0.5, None, logit, 1
"""
)

_TAPNEXT_TOOLS = """
import numpy as np
import torch


def restore_model_from_jax_checkpoint(model, ckpt_path):
    with np.load(ckpt_path) as stored, torch.no_grad():
        model.matcher.gain.copy_(torch.tensor(stored["gain"]))
    return model
"""


def write_cotracker(folder: Path, code: str = "") -> Path:
    """Write a folder like CoTracker's, and weights in it.

    Args:
        folder: Folder to make.
        code: More code at the start of its hubconf.py.
    """
    folder.mkdir()
    (folder / "hubconf.py").write_text(textwrap.dedent(code) + _HUB)
    torch.save({"gain": torch.ones(1)}, folder / "scaled_offline.pth")
    return folder


def write_tapnext(folder: Path) -> Path:
    """Write a folder like TAPNext's, and weights in it."""
    package = folder / "tapnet" / "tapnext"
    package.mkdir(parents=True)
    (package / "tapnext_torch.py").write_text(_TAPNEXT)
    (package / "tapnext_torch_utils.py").write_text(_TAPNEXT_TOOLS)
    np.savez(folder / "bootstapnext_ckpt.npz", gain=np.ones(1, dtype=np.float32))
    return folder


def write_sam2(folder: Path) -> Path:
    """Write a tiny SAM 2 with random weights, as Transformers stores models."""
    os.environ["HF_HUB_OFFLINE"] = "1"
    from transformers import Sam2VideoConfig, Sam2VideoModel, Sam2VisionConfig
    from transformers.models.sam2.configuration_sam2 import Sam2HieraDetConfig
    from transformers.utils import logging

    logging.disable_progress_bar()
    backbone = Sam2HieraDetConfig(
        hidden_size=8,
        num_attention_heads=1,
        image_size=[SIDE, SIDE],
        blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 1, 1, 1],
        window_size_per_stage=[4, 4, 4, 4],
        global_attention_blocks=[3],
    )
    vision = Sam2VisionConfig(
        backbone_config=backbone,
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=[[SIDE // 4] * 2, [SIDE // 8] * 2, [SIDE // 16] * 2],
        fpn_hidden_size=128,
    )
    config = Sam2VideoConfig(
        vision_config=vision,
        memory_attention_feed_forward_hidden_size=32,
        **_SMALL,
    )
    return _stored(Sam2VideoModel, config, folder)


def _stored(kind: Any, config: Any, folder: Path) -> Path:
    torch.manual_seed(0)
    model = kind(config)
    with torch.no_grad():
        # As they are made, their masks are nearly the same everywhere.
        for weight in model.parameters():
            weight.normal_(0, 0.15)
    model.save_pretrained(folder)
    return folder


def write_edgetam(folder: Path) -> Path:
    """Write a tiny EdgeTAM with random weights; four convolutions stand in for timm's backbone."""
    from torch import nn
    from transformers import (
        AutoConfig,
        AutoModel,
        EdgeTamVideoConfig,
        EdgeTamVideoModel,
        EdgeTamVisionConfig,
        PreTrainedConfig,
        PreTrainedModel,
    )
    from transformers.modeling_outputs import BaseModelOutput

    class StemConfig(PreTrainedConfig):
        model_type = "physhandi_stem"

    class Stem(PreTrainedModel):
        config_class = StemConfig
        main_input_name = "pixel_values"

        def __init__(self, config: StemConfig) -> None:
            super().__init__(config)
            widths = ((3, 8, 4), (8, 16, 2), (16, 32, 2), (32, 64, 2))
            self.parts = nn.ModuleList(nn.Conv2d(a, b, step, step) for a, b, step in widths)
            self.post_init()

        def forward(self, pixel_values: torch.Tensor, **_: Any) -> BaseModelOutput:
            maps = []
            for part in self.parts:
                pixel_values = part(pixel_values)
                maps.append(pixel_values)
            return BaseModelOutput(last_hidden_state=maps)

    AutoConfig.register(StemConfig.model_type, StemConfig, exist_ok=True)
    AutoModel.register(StemConfig, Stem, exist_ok=True)
    vision = EdgeTamVisionConfig(
        backbone_config=StemConfig(),
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=[[SIDE // 4] * 2, [SIDE // 8] * 2, [SIDE // 16] * 2],
        fpn_hidden_size=128,
    )
    config = EdgeTamVideoConfig(
        vision_config=vision,
        memory_attention_mlp_hidden_size=32,
        memory_attention_rope_k_sizes=[4, 4],
        perceiver_resampler_num_latents=16,
        perceiver_resampler_num_latents_2d=16,
        perceiver_resampler_num_layers=1,
        **_SMALL,
    )
    return _stored(EdgeTamVideoModel, config, folder)
