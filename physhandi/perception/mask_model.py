"""Finds object and hands by SAM 2 or EdgeTAM, if the user has the weights.

Both (Ravi et al. 2024; Zhou et al. 2025) run through Hugging Face's Transformers, an extra. Only a
folder of this machine is read, of it only ``config.json`` and safetensors: nothing is downloaded,
and no code of the folder is executed.
"""

import hashlib
import importlib
import json
import os
from collections.abc import Iterator, Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.view import View
from physhandi.errors import UsageError

_ARCHITECTURES = {
    "sam2_video": ("sam2", "Sam2VideoModel", "sam2_video.modeling_sam2_video", "Sam2Video"),
    "edgetam_video": (
        "edgetam",
        "EdgeTamVideoModel",
        "edgetam_video.modeling_edgetam_video",
        "EdgeTamVideo",
    ),
}
"""By what ``config.json`` calls itself: our name for it, and where Transformers has it."""
_MEAN = np.array([0.485, 0.456, 0.406], dtype=np.float32)
"""Mean of ImageNet's colors, which both networks were trained with."""
_DEVIATION = np.array([0.229, 0.224, 0.225], dtype=np.float32)
_REMEMBERED = 20
"""Frames whose results are kept; the networks look back at most 16."""
_PIECE = 12
"""Images that are kept while a video is read backwards."""
_REMEDY = (
    "Give the folder of facebook/sam2.1-hiera-tiny (or another size) or yonigozlan/EdgeTAM-hf as "
    "Hugging Face has it; docs/your-data.md says how to get it."
)


@dataclass(frozen=True)
class Prompt:
    """Pixels of a frame of which it is known whether they belong to a thing."""

    frame: int
    """Number of the frame."""
    inside: Float[ndarray, "point 2"]
    """Pixels of the thing [px]."""
    outside: Float[ndarray, "point 2"]
    """Pixels of others [px]."""


class MaskModel:
    """A network that follows things through the images of a view."""

    def __init__(self, folder: Path) -> None:
        """Read it.

        Args:
            folder: ``config.json`` and ``model.safetensors``, as Transformers stores models.

        Raises:
            UsageError: If the folder holds something else, or the extra is not installed.
        """
        kind, weights = _described(folder)
        self.source, name, module, prefix = _ARCHITECTURES[kind]
        os.environ["HF_HUB_OFFLINE"] = "1"
        try:
            import torch
            import transformers
            from transformers.utils import logging
        except ImportError as error:
            raise UsageError(
                f'--mask-model needs the extra "models" ({error.name} is missing): '
                'pip install "physhandi[models]".'
            ) from None
        logging.set_verbosity_error()
        logging.disable_progress_bar()
        self._torch = torch
        self._device = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            model, loading_info = getattr(transformers, name).from_pretrained(
                folder,
                local_files_only=True,
                trust_remote_code=False,
                use_safetensors=True,
                dtype=torch.float32,
                output_loading_info=True,
            )
        except Exception as error:  # noqa: BLE001 - its reader lets nearly anything out
            reason = " ".join(str(error).split())[:300]
            raise UsageError(f"{folder}: the model cannot be read ({reason}). {_REMEDY}") from None
        lacking = [
            *loading_info["missing_keys"],
            *(str(key) for key in loading_info["mismatched_keys"]),
        ]
        if lacking:
            raise UsageError(
                f"{folder}: {len(lacking)} weights are missing or of another size, among them "
                f"{lacking[0]}. {_REMEDY}"
            )
        self._model = model.to(self._device)
        modeling = importlib.import_module(f"transformers.models.{module}")
        self._session = getattr(modeling, f"{prefix}InferenceSession")
        size = model.config.image_size
        self._size: tuple[int, int] = (size, size) if isinstance(size, int) else tuple(size)
        self._weights = [folder / "config.json", *weights]

    def provenance(self) -> dict[str, str]:
        """Tell what a sequence keeps about the model: its kind and the hash of its files."""
        return {"source": self.source, "model_sha256": content_hash(self._weights)}

    def follow(
        self, view: View, prompts: Mapping[int, Many[Prompt]]
    ) -> Iterator[tuple[int, dict[int, Float[ndarray, "row column"]]]]:
        """Find things in all frames.

        Args:
            view: View with color.
            prompts: What is known of each thing, in the order of frames; at least one each.

        Yields:
            Each frame once, in the order in which they are finished: its number, and for each thing
            logits at the size of the view's images, positive where the thing is.
        """
        frames = _Frames(view, self._size)
        memory: Any = None
        sessions: dict[int, Any] = {}
        for thing, own in prompts.items():
            session = self._session(
                video_height=view.camera.height,
                video_width=view.camera.width,
                inference_device=self._device,
                inference_state_device=self._device,
                dtype=self._torch.float32,
            )
            session.processed_frames = frames
            # One look at an image serves for all things.
            memory = session.cache = memory or session.cache
            for prompt in own:
                self._tell(session, view, prompt)
            sessions[thing] = session
        first = {thing: own[0].frame for thing, own in prompts.items()}
        logits: dict[int, dict[int, ndarray]] = {frame: {} for frame in range(view.frame_count)}
        ahead = [(frame, False) for frame in range(min(first.values()), view.frame_count)]
        back = [(frame, True) for frame in range(max(first.values()) - 1, -1, -1)]
        for frame, is_back in ahead + back:
            for thing, session in sessions.items():
                if (frame < first[thing]) == is_back:
                    logits[frame][thing] = self._step(session, view, frame, is_back=is_back)
            if len(logits[frame]) == len(prompts):
                yield frame, logits.pop(frame)

    def _tell(self, session: Any, view: View, prompt: Prompt) -> None:
        torch = self._torch
        pixel = np.concatenate([prompt.inside, prompt.outside])
        scale = np.array([self._size[1] / view.camera.width, self._size[0] / view.camera.height])
        label = np.repeat([1, 0], [len(prompt.inside), len(prompt.outside)])
        thing = session.obj_id_to_idx(1)
        session.add_point_inputs(
            thing,
            prompt.frame,
            {
                "point_coords": torch.tensor(pixel * scale, dtype=torch.float32)[None, None],
                "point_labels": torch.tensor(label, dtype=torch.int32)[None, None],
            },
        )
        session.obj_with_new_inputs = [1]
        self._model(session, frame_idx=prompt.frame)

    def _step(
        self, session: Any, view: View, frame: int, *, is_back: bool
    ) -> Float[ndarray, "row column"]:
        masks = self._model(session, frame_idx=frame, reverse=is_back).pred_masks
        past = session.output_dict_per_obj[0]["non_cond_frame_outputs"]
        for other in [other for other in past if abs(other - frame) > _REMEMBERED]:
            del past[other]
        logit = self._torch.nn.functional.interpolate(
            masks.float(), (view.camera.height, view.camera.width), mode="bilinear"
        )
        return logit[0, 0].cpu().numpy()


class _Frames:
    """The images of a view as a network wants them, read when it asks.

    All at once would fill the memory.
    """

    def __init__(self, view: View, size: tuple[int, int]) -> None:
        self._view, self._size = view, size
        self._image: dict[int, ndarray] = {}
        self._last = -1

    def __len__(self) -> int:
        return self._view.frame_count

    def __getitem__(self, frame: int) -> Any:
        import torch

        if frame not in self._image:
            # Videos are read forwards only, so on the way back a piece of them is kept.
            begin = max(0, frame - _PIECE + 1) if frame < self._last else frame
            self._image = {at: self._view.color(at) for at in range(begin, frame + 1)}
        self._last = frame
        height, width = self._size
        image = self._image[frame].astype(np.float32)
        is_shrunk = image.shape[0] > height
        way = cv2.INTER_AREA if is_shrunk else cv2.INTER_LINEAR
        image = cv2.resize(image, (width, height), interpolation=way)
        color = (image / 255 - _MEAN) / _DEVIATION
        return torch.from_numpy(np.ascontiguousarray(color.transpose(2, 0, 1)))


def mask_model_kind(folder: Path) -> str:
    """Tell which network a folder holds, as provenance calls it, without reading its weights.

    Raises:
        UsageError: If it holds no mask model, or no weights that are read.
    """
    return _ARCHITECTURES[_described(folder)[0]][0]


def _described(folder: Path) -> tuple[str, list[Path]]:
    """Read what a folder says of itself: kind of network and files of weights."""
    try:
        config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
        kind = str(config["model_type"])
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(
            f"{folder}: is no folder of a mask model, which has a config.json with a model_type. "
            f"{_REMEDY}"
        ) from None
    if kind not in _ARCHITECTURES:
        names = " and ".join(_ARCHITECTURES)
        raise UsageError(f"{folder}: holds a '{kind}'; {names} are understood. {_REMEDY}")
    weights = sorted(folder.glob("*.safetensors"))
    if not weights:
        raise UsageError(
            f"{folder}: has no model.safetensors; weights in other formats are not read. {_REMEDY}"
        )
    return kind, weights


def content_hash(files: Many[Path]) -> str:
    """Compute the SHA-256 of files by their names and contents, wherever they lie."""
    digest = hashlib.sha256()
    for path in sorted(files, key=lambda path: path.name):
        with path.open("rb") as stream:
            digest.update(path.name.encode() + b"\0")
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()
