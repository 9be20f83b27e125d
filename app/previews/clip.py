"""The moving picture of one sequence or run: what it shows, and its two files."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from app.previews.draw import HEIGHT, WIDTH, PreviewMotion, draw_motion
from app.previews.links import marker_links
from physhandi.data.files import replacing
from physhandi.data.layout import SequenceFiles
from physhandi.data.sequence import Sequence as Recording
from physhandi.data.view import View
from physhandi.object_rollout import load_fitted, load_surface
from physhandi.run import Run

_FRAMES = 28
_USUAL_RATE = 30.0
_SHORTEST_MS, _LONGEST_MS = 40, 180
_STILL_QUALITY, _MOVING_QUALITY = 82, 62
_SIDES = ("right", "left")
_LINK_COUNT = 3_000


@dataclass(frozen=True, eq=False)
class Clip:
    """Pictures in a row."""

    frames: list[UInt8[ndarray, "row column channel"]]
    """Red, green, blue and, where the background is clear, opacity."""
    frame_ms: int
    """Duration of each [ms]."""

    def write_moving(self, path: Path) -> None:
        """Write the pictures as an animated WebP.

        Raises:
            OSError: If the file cannot be written.
        """
        animation = cv2.Animation()
        animation.frames = [_blue_first(frame) for frame in self.frames]
        animation.durations = [self.frame_ms] * len(self.frames)
        quality = [cv2.IMWRITE_WEBP_QUALITY, _MOVING_QUALITY]
        _write(path, lambda name: cv2.imwriteanimation(name, animation, quality))

    def write_still(self, path: Path) -> None:
        """Write the picture in the middle as WebP.

        Raises:
            OSError: If the file cannot be written.
        """
        middle = _blue_first(self.frames[len(self.frames) // 2])
        quality = [cv2.IMWRITE_WEBP_QUALITY, _STILL_QUALITY]
        _write(path, lambda name: cv2.imwrite(name, middle, quality))


def clip_of_sequence(folder: Path, *, is_still: bool = False) -> Clip | None:
    """Show a sequence: its first colour video, else its depth or its points.

    Args:
        folder: The sequence.
        is_still: Whether a single picture is enough.

    Returns:
        The clip; None if the sequence has nothing to show.

    Raises:
        SequenceError: If the sequence is damaged.
    """
    sequence = Recording.load(folder)
    frames, frame_ms = _sampled(sequence.frame_count, sequence.frame_rate, is_still=is_still)
    for kind in ("color", "depth"):
        for view in sequence.views:
            if getattr(view, f"has_{kind}"):
                try:
                    return Clip([_cut(_image(view, kind, frame)) for frame in frames], frame_ms)
                finally:
                    view.close()
    motion = _recorded_motion(sequence)
    if motion.frame_count:
        return Clip(draw_motion(motion, frames), frame_ms)
    return None


def clip_of_run(folder: Path, *, is_still: bool = False) -> Clip | None:
    """Show what a run found: the hands and the simulated object of its first sequence.

    Args:
        folder: The run.
        is_still: Whether a single picture is enough.

    Returns:
        The clip; None if the run has no motion yet.

    Raises:
        RunError: If the run is damaged.
    """
    run = Run.open(folder)
    for name, recording in zip(run.sequence_names, run.sequences, strict=True):
        motion = _found_motion(run, name, Path(recording))
        if motion.frame_count:
            rate = _rate_of(run, name)
            frames, frame_ms = _sampled(motion.frame_count, rate, is_still=is_still)
            return Clip(draw_motion(motion, frames), frame_ms)
    return None


def _sampled(count: int, rate: float, *, is_still: bool) -> tuple[list[int], int]:
    """Choose frames over the whole time, and how long each is shown to keep its pace [ms]."""
    if is_still:
        return [count // 2], 0
    frames = np.unique(np.linspace(0, count - 1, min(count, _FRAMES)).round().astype(int)).tolist()
    pace = 1000.0 * count / max(rate, 1e-3) / len(frames)
    return frames, int(np.clip(pace, _SHORTEST_MS, _LONGEST_MS))


def _rate_of(run: Run, name: str) -> float:
    is_known = run.has(SequenceFiles(name).meta)
    return float(run.recording(name)["frame_rate"]) if is_known else _USUAL_RATE


def _found_motion(run: Run, name: str, recording: Path) -> PreviewMotion:
    files = SequenceFiles(name)
    hands: list[tuple[Float[ndarray, "frame vertex 3"], Int[ndarray, "face 3"] | None]] = []
    for side in _SIDES:
        stored, face = files.hand_vertex(side), files.hand_face(side)
        if run.has(stored):
            hands.append((run.array(stored), run.array(face) if run.has(face) else None))
    if not run.has(files.rollout):
        return PreviewMotion(hands=tuple(hands))
    node = run.array(files.rollout)
    fitted = load_fitted(run, name)
    return PreviewMotion(
        hands=tuple(hands),
        node=node,
        control=run.array(files.control) if not hands and run.has(files.control) else None,
        spring=_springs(run, files.model, node.shape[1]),
        surface=None if fitted is None else load_surface(run, fitted, recording),
    )


def _springs(run: Run, rel: str, node_count: int) -> Int[ndarray, "spring 2"]:
    """Give the object's shortest springs: enough to tell its shape."""
    if not run.has(rel):
        return np.empty((0, 2), dtype=int)
    model = run.tensors(rel)
    inner = (model["spring_nodes"] < node_count).all(axis=1)
    shortest = np.argsort(model["rest_length"][inner], kind="stable")
    return model["spring_nodes"][inner][shortest[: min(4 * node_count, _LINK_COUNT)]]


def _recorded_motion(sequence: Recording) -> PreviewMotion:
    marker, control = sequence.marker, sequence.control
    if marker is None and control is None and sequence.object_node is not None:
        return PreviewMotion(
            node=np.repeat(sequence.object_node[None], sequence.frame_count, axis=0)
        )
    links = np.empty((0, 2), dtype=int) if marker is None else marker_links(marker[0])
    return PreviewMotion(marker=marker, control=control, spring=links)


def _image(view: View, kind: str, frame: int) -> UInt8[ndarray, "row column 3"]:
    if kind == "color":
        return view.color(frame)
    depth = view.depth(frame)
    seen = depth > 0
    near, far = np.quantile(depth[seen], [0.02, 0.98]) if seen.any() else (0.0, 1.0)
    grey = np.clip(255 * (far - depth) / max(far - near, 1e-6), 0, 255).astype(np.uint8)
    colored = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return np.where(seen[..., None], colored, 0).astype(np.uint8)


def _cut(image: UInt8[ndarray, "row column 3"]) -> UInt8[ndarray, "row column 3"]:
    """Cut the middle out in the shape of a preview and make it small."""
    rows, columns = image.shape[:2]
    wide, high = min(columns, rows * WIDTH // HEIGHT), min(rows, columns * HEIGHT // WIDTH)
    top, left = (rows - high) // 2, (columns - wide) // 2
    part = image[top : top + high, left : left + wide]
    return cv2.resize(part, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def _blue_first(frame: UInt8[ndarray, "row column channel"]) -> UInt8[ndarray, "row column c"]:
    order = [2, 1, 0, 3][: frame.shape[2]]
    return np.ascontiguousarray(frame[..., order])


def _write(path: Path, write: Callable[[str], bool]) -> None:
    with replacing(path) as temporary:
        if not write(str(temporary)):
            raise OSError(f"{path} cannot be written as WebP.")
