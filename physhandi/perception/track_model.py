"""Follows points by CoTracker3 or TAPNext, if the user has their code and weights.

Their code (Karaev et al. 2024; Zholus et al. 2025) is foreign Python, so the user has to agree, and
it runs in a child process of its own (this module, started as a program), which is told a
recording, a frame and pixels, and writes plain arrays. Weights are read as plain tensors. Nothing
is downloaded.
"""

import importlib
import logging
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from physhandi.child import Channel, Child, ChildEndedError, run_child
from physhandi.data.arrays import read_array
from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.errors import PhysHandiError, RunError, UsageError
from physhandi.perception.mask_model import content_hash
from physhandi.progress import Progress

logger = logging.getLogger(__name__)

_COTRACKER, _TAPNEXT = "cotracker3", "tapnext"
_ENTRY = "cotracker3_offline"
"""What CoTracker's ``hubconf.py`` calls the model that sees a whole video."""
_TAPNEXT_CODE = Path("tapnet/tapnext/tapnext_torch.py")
_WEIGHTS = {
    _COTRACKER: ("scaled_offline.pth", {".pth", ".pt", ".safetensors"}),
    _TAPNEXT: ("bootstapnext_ckpt.npz", {".npz", ".pt", ".safetensors"}),
}
"""By tracker: the weights to look for first, and how others may end."""
_WORKER = "physhandi.perception.track_model"
_LONGEST_S = 6 * 3600.0
"""Time after which a tracker is not waited for any longer [s]."""
_LOOK_S = 0.5
"""Time after which the parent may stop the work [s]."""
_MOST_PIXELS = 384 * 512
"""Pixels of the images that CoTracker is given, which works at this size."""
_TAPNEXT_SIZE = 256
"""Side of the square images that TAPNext works at [px]."""
_REMEDY = (
    "Give a folder with the code of CoTracker (hubconf.py and cotracker/) or TAPNext (tapnet/) and "
    "the weights in it; docs/your-data.md says how to get them."
)

_Paths = tuple[Float[ndarray, "frame track 2"], Bool[ndarray, "frame track"]]


class TrackModel:
    """A tracker at work in a process of its own, which ends with the context."""

    def __init__(self, folder: Path, sequence: Sequence, *, is_trusted: bool) -> None:
        """Look at its folder; nothing of it is executed yet.

        Args:
            folder: Folder with its code and weights.
            sequence: Recording that it will be asked about.
            is_trusted: Whether the user agreed that its code is executed.

        Raises:
            UsageError: If the folder holds no tracker, or the user did not agree.
        """
        folder = folder.absolute()
        self.source = _kind(folder)
        self._checkpoint = _checkpoint(folder, self.source)
        if not is_trusted:
            raise UsageError(
                f"{folder}: a tracker is Python code of others, which can do what you can do. If "
                "you trust this folder, say so with --trust-model-code; it is then executed in a "
                "process of its own."
            )
        self._folder = folder
        self._sequence = sequence
        self._exchange = tempfile.TemporaryDirectory(prefix="physhandi-tracks-")
        self._child: Child | None = None

    def provenance(self) -> dict[str, str]:
        """Tell what a sequence keeps about the tracker: its kind and the hash of its files."""
        code = [self._folder / ("hubconf.py" if self.source == _COTRACKER else _TAPNEXT_CODE)]
        return {"source": self.source, "model_sha256": content_hash([*code, self._checkpoint])}

    def __enter__(self) -> "TrackModel":
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        if self._child is not None:
            self._child.close()
        self._exchange.cleanup()

    def follow(
        self, view: View, frame: int, start: Float[ndarray, "track 2"], progress: Progress
    ) -> _Paths:
        """Follow points of a frame through all others, forwards and backwards.

        Args:
            view: View with color.
            frame: Number of the frame.
            start: Where the points are in it [px].
            progress: Asked whether to go on; that stops the process.

        Returns:
            Positions [px], and where the tracker says that a point is visible.

        Raises:
            RunError: If the tracker fails; says what it told last.
            CancelledError: If the user asked to stop.
        """
        place = Path(self._exchange.name)
        np.save(place / "start.npy", start.astype(np.float32))
        if self._child is None:
            arguments = [self.source, str(self._folder), str(self._checkpoint)]
            self._child = Child(
                _WORKER,
                *arguments,
                str(self._sequence.folder.absolute()),
                self._exchange.name,
                time_limit_s=_LONGEST_S,
            )
            self._messages = self._child.messages()
        self._child.send({"view": view.name, "frame": frame})
        while not self._is_done(view, frame):
            progress.check_cancelled()
        return self._collected(view, len(start))

    def _is_done(self, view: View, frame: int) -> bool:
        """Wait for the next message."""
        try:
            return bool(next(self._messages).get("is_done"))
        except (ChildEndedError, StopIteration) as error:
            last = error.last_words if isinstance(error, ChildEndedError) else ""
            words = last.strip().splitlines()
            raise RunError(
                f"{self._folder.name}: the tracker's process ended while it followed view "
                f"'{view.name}' from frame {frame}. {words[-1] if words else ''}".rstrip()
            ) from None
        except PhysHandiError as error:
            raise type(error)(f"{self._folder.name}: {error}") from None

    def _collected(self, view: View, count: int) -> _Paths:
        place = Path(self._exchange.name)
        try:
            pixel, visible = (read_array(place / name) for name in ("pixel.npy", "visible.npy"))
        except (OSError, ValueError) as error:
            raise RunError(f"{self._folder.name}: wrote no tracks ({error}).") from None
        shape = (view.frame_count, count)
        if pixel.shape != (*shape, 2) or visible.shape != shape or visible.dtype != bool:
            raise RunError(
                f"{self._folder.name}: gave tracks {pixel.shape} and {visible.shape} in the place "
                f"of {(*shape, 2)} and {shape}."
            )
        is_placed = np.asarray(np.isfinite(pixel).all(axis=-1))
        return np.where(is_placed[..., None], np.clip(pixel, -1e6, 1e6), 0), visible & is_placed


def track_model_kind(folder: Path) -> str:
    """Tell which tracker a folder holds, as provenance calls it; nothing of it is executed.

    Raises:
        UsageError: If it holds no tracker, or no weights.
    """
    kind = _kind(folder)
    _checkpoint(folder, kind)
    return kind


def _kind(folder: Path) -> str:
    hub = folder / "hubconf.py"
    if hub.is_file() and _ENTRY in hub.read_text(encoding="utf-8", errors="replace"):
        return _COTRACKER
    if (folder / _TAPNEXT_CODE).is_file():
        return _TAPNEXT
    raise UsageError(
        f"{folder}: holds neither a hubconf.py with {_ENTRY} nor {_TAPNEXT_CODE}. {_REMEDY}"
    )


def _checkpoint(folder: Path, kind: str) -> Path:
    """Find the weights in a tracker's folder, or in ``checkpoints`` below it."""
    first, ends = _WEIGHTS[kind]
    places = [folder, folder / "checkpoints"]
    for place in places:
        if (place / first).is_file():
            return place / first
    files = sorted(path for place in places for path in place.glob("*") if path.suffix in ends)
    if len(files) != 1:
        names = ", ".join(path.name for path in files)
        there = f"several files of weights ({names})" if files else "no weights"
        raise UsageError(f"{folder}: has {there}; put {first} there, or one other file. {_REMEDY}")
    return files[0]


def _refuse_download(*_arguments: object, **_options: object) -> None:
    raise UsageError("its code wants to download something; nothing is downloaded here")


def read_weights(path: Path) -> dict[str, Any]:
    """Read tensors of safetensors or PyTorch by their names, without executing anything.

    Raises:
        UsageError: If the file holds something else, or is damaged.
    """
    import torch
    from safetensors.torch import load_file

    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        stored: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # noqa: BLE001 - a broken file can raise nearly anything
        reason = " ".join(str(error).split())[:200]
        raise UsageError(f"{path.name} cannot be read as plain tensors ({reason})") from None
    if not isinstance(stored, dict):
        raise UsageError(f"{path.name} holds no tensors by name")
    return stored.get("state_dict", stored.get("model", stored))


def _cotracker(folder: Path, checkpoint: Path) -> Callable[..., _Paths]:
    """Load CoTracker3 from its folder.

    Gives a function that follows pixels of the first of some images through all of them.
    """
    import torch

    predictor: Any = torch.hub.load(str(folder), _ENTRY, source="local", pretrained=False)
    predictor.model.load_state_dict(read_weights(checkpoint))
    device = "cuda" if torch.cuda.is_available() else "cpu"
    predictor = predictor.to(device).train(False)

    def follow(images: list[ndarray], start: ndarray) -> _Paths:
        height, width = images[0].shape[:2]
        share = min(1.0, (_MOST_PIXELS / (height * width)) ** 0.5)
        small = (max(8, round(share * width)), max(8, round(share * height)))
        shrunk = [cv2.resize(image, small, interpolation=cv2.INTER_AREA) for image in images]
        scale = np.array(small, dtype=np.float32) / (width, height)
        video = torch.from_numpy(np.stack(shrunk)).permute(0, 3, 1, 2)[None].float().to(device)
        # Both have the middle of a pixel at a whole number.
        pixel = (start + 0.5) * scale - 0.5
        query = np.concatenate([np.zeros((len(start), 1)), pixel], axis=1)
        with torch.no_grad():
            track, visible = predictor(
                video, queries=torch.tensor(query, dtype=torch.float32, device=device)[None]
            )
        return (track[0].cpu().numpy() + 0.5) / scale - 0.5, visible[0].cpu().numpy() > 0.5

    return follow


def _tapnext(folder: Path, checkpoint: Path) -> Callable[..., _Paths]:
    """Load TAPNext from its folder; see `_cotracker`."""
    import torch

    sys.path.insert(0, str(folder))
    side = _TAPNEXT_SIZE
    network = importlib.import_module("tapnet.tapnext.tapnext_torch")
    model: Any = network.TAPNext(image_size=(side, side))
    if checkpoint.suffix == ".npz":
        tools = importlib.import_module("tapnet.tapnext.tapnext_torch_utils")
        model = tools.restore_model_from_jax_checkpoint(model, str(checkpoint))
    else:
        stored = read_weights(checkpoint)
        model.load_state_dict({name.removeprefix("tapnext."): x for name, x in stored.items()})
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = model.to(device).train(False)

    def follow(images: list[ndarray], start: ndarray) -> _Paths:
        height, width = images[0].shape[:2]
        scale = np.array([side / width, side / height], dtype=np.float32)
        # Its pixels reach from 0 to 1, ours from -0.5 to 0.5; rows come before columns.
        place = ((start + 0.5) * scale)[:, ::-1]
        query = np.concatenate([np.zeros((len(start), 1)), place], axis=1)
        points = torch.tensor(query, dtype=torch.float32, device=device)[None]
        state, track, visible = None, [], []
        for image in images:
            square = cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA)
            video = torch.from_numpy(square).float().to(device)[None, None] / 127.5 - 1
            given = {"query_points": points} if state is None else {"state": state}
            with torch.no_grad():
                moved, _, logit, state = model(video=video, **given)
            track.append(moved[0, 0].float().cpu().numpy()[:, ::-1] / scale - 0.5)
            visible.append(logit[0, 0, :, 0].float().cpu().numpy() > 0)
        return np.stack(track), np.stack(visible)

    return follow


def _go_on_telling(channel: Channel) -> None:
    """Let the parent look now and then, while a tracker works, whether it is to go on."""

    def tell() -> None:
        while True:
            time.sleep(_LOOK_S)
            channel.tell(is_done=False)

    threading.Thread(target=tell, daemon=True).start()


_LOADERS = {_COTRACKER: _cotracker, _TAPNEXT: _tapnext}


def _work(channel: Channel) -> None:
    """Load the tracker that the arguments name, and follow what requests ask for."""
    kind, folder, checkpoint, recording, exchange = channel.arguments
    os.environ["HF_HUB_OFFLINE"] = "1"
    sys.dont_write_bytecode = True  # Their folder stays as it is.
    import torch

    for loading in ("load_state_dict_from_url", "download_url_to_file"):
        setattr(torch.hub, loading, _refuse_download)
    sequence = Sequence.load(Path(recording))
    views = {view.name: view for view in sequence.views}
    try:
        follow = _LOADERS[kind](Path(folder), Path(checkpoint))
    except ModuleNotFoundError as error:
        raise UsageError(
            f"its code needs the package '{error.name}', which is not installed. Install it beside "
            "physhandi: pip install " + str(error.name).partition(".")[0]
        ) from None
    _go_on_telling(channel)
    for request in channel.requests():
        view, frame = views[request["view"]], int(request["frame"])
        start = read_array(Path(exchange) / "start.npy")
        images = [view.color(at) for at in range(view.frame_count)]
        view.close()
        pixel = np.empty((len(images), len(start), 2), dtype=np.float32)
        visible = np.empty((len(images), len(start)), dtype=bool)
        ahead, back = images[frame:], images[frame::-1]
        if len(back) > 1:
            pixel[frame::-1], visible[frame::-1] = follow(back, start)
        if len(ahead) > 1:
            pixel[frame:], visible[frame:] = follow(ahead, start)
        # The tracker only has its own idea of where it was asked.
        pixel[frame], visible[frame] = start, True
        np.save(Path(exchange) / "pixel.npy", pixel)
        np.save(Path(exchange) / "visible.npy", visible)
        channel.tell(is_done=True)


if __name__ == "__main__":
    run_child(_work)
