"""Pictures of a sequence: the true motion and what methods made of it, at the same moments."""

from collections.abc import Iterator, Mapping
from collections.abc import Sequence as Many
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.data.layout import SequenceFiles
from physhandi.data.run import RunFolder
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import Side
from physhandi.data.truth import read_truth
from physhandi.errors import MissingInputError
from physhandi.metrics.topology import resolution
from physhandi.metrics.truth_metrics import true_motion, true_surface
from physhandi.rendering.renderer import render
from physhandi.rendering.shapes import Balls, Shape, Surface
from physhandi.synthetic.suite.methods import METHODS

WIDTH, HEIGHT = 300, 240
"""Size of one picture of a row [px]."""
WORST = 0.03
"""Error of a node that has the color of the largest one [m]."""
_MARGIN = 0.06
_LABEL = 22
_BACKGROUND = (246, 246, 246)
_HAND = np.array([[214.0, 170.0, 146.0]])
_TRUTH = np.array([[120.0, 150.0, 190.0]])
_HAND_POINT = 0.003


def motion_picture(
    recording: Sequence, runs: Mapping[str, RunFolder], device: str = "cpu"
) -> UInt8[ndarray, "row column 3"]:
    """Draw the true motion in the first row, and below it the nodes of each run.

    The columns are frame 0, the last fitted frame, the middle of the predicted ones and the last.
    Nodes are colored by their distance from where the true motion would have carried them.

    Args:
        recording: The whole recording, with its truth and a view.
        runs: What was made of it, by the name that stands beside the row.
        device: Warp device that draws it.

    Returns:
        Red, green and blue.

    Raises:
        MissingInputError: If the recording has no true surface or no view.
    """
    stored_truth = read_truth(recording.folder)
    truth = true_surface(stored_truth)
    if truth is None or not recording.views:
        raise MissingInputError(
            f"Sequence '{recording.name}' tells no true surface or has no view: nothing to draw."
        )
    frames = moments(recording)
    camera = _camera(recording.views[0].camera, truth.point[frames].reshape(-1, 3))
    shapes: list[list[Shape]] = [
        [
            Surface(vertex=truth.point[f], faces=truth.face, color=_TRUTH, shading=0.5),
            *(
                Balls(center=vertex[f], radius=np.array([_HAND_POINT]), color=_HAND)
                for vertex in stored_truth.hand_vertex.values()
            ),
        ]
        for f in frames
    ]
    rows = [("true motion", shapes)]
    files = SequenceFiles(recording.name)
    for name, run in runs.items():
        rollout = run.array(files.rollout)
        carried = true_motion(rollout[0], truth)
        radius = 0.45 * resolution(rollout[0].astype(np.float64))
        sides = [side for side in recording.hands if run.has(files.hand_vertex(side))]
        vertex = {side: run.array(files.hand_vertex(side)) for side in sides}
        face = {side: run.array(files.hand_face(side)) for side in sides}
        shapes = []
        for frame in frames:
            error = np.linalg.norm(rollout[frame] - carried[frame], axis=1)
            nodes = Balls(
                center=rollout[frame], radius=np.array([radius]), color=_colors(error), shading=0.4
            )
            shapes.append([nodes, *_hands(vertex, face, frame)])
        rows.append((name, shapes))
    drawn = [_row(camera, name, shapes, device) for name, shapes in rows]
    return np.concatenate([_heading(recording, frames), *drawn, _scale(len(frames))])


def moments(recording: Sequence) -> list[int]:
    """Choose the frames that are drawn: the first, the last fitted, and two predicted ones."""
    last = recording.reconstruction_frames[-1]
    end = recording.frame_count - 1
    return list(dict.fromkeys([0, last, (last + end + 1) // 2, end]))


def write_motion_pictures(
    folder: Path,
    recordings: Many[Sequence],
    cells: Many[Mapping[str, object]],
    seed_of: Mapping[str, str],
    device: str = "cpu",
) -> Iterator[str]:
    """Write a picture of every sequence of a suite, and give the name of each file.

    Args:
        folder: Where pictures go.
        recordings: The whole recordings; those without a true surface or a view are left out.
        cells: The suite's finished cells.
        seed_of: The method of which others are one seed; its first seed is drawn.
        device: Warp device that draws them.
    """
    for recording in recordings:
        runs: dict[str, RunFolder] = {}
        for cell in cells:
            method = seed_of.get(str(cell["method"]), str(cell["method"]))
            if (
                (cell["protocol"], cell["case"]) == ("main", recording.name)
                and cell["run"]
                and not cell["error"]
                and _is_drawn(method)
                and method not in runs
            ):
                runs[method] = RunFolder.open(folder.parent / "cells" / str(cell["run"]))
        try:
            picture = motion_picture(recording, runs, device)
        except MissingInputError:
            continue
        name = f"motion_{recording.name}.png"
        folder.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), picture[..., ::-1])
        yield name


def _is_drawn(name: str) -> bool:
    """Leave out rules and variants of methods, which would make the picture too tall to compare."""
    return "@" not in name and METHODS[name.partition("+")[0]].rule is None


def _camera(camera: PinholeCamera, point: Float[ndarray, "point 3"]) -> PinholeCamera:
    """Turn a view's camera into one whose image is filled by some points."""
    straight = replace(camera, distortion=np.zeros(5))
    pixel = straight.project(point)
    low, high = np.nanmin(pixel, axis=0), np.nanmax(pixel, axis=0)
    scale = (1.0 - 2 * _MARGIN) * float(np.min(np.array([WIDTH, HEIGHT]) / (high - low)))
    K = camera.K.copy()
    K[:2] *= scale
    K[:2, 2] += np.array([WIDTH, HEIGHT]) / 2 - scale * (low + high) / 2
    return PinholeCamera(K=K, T_world_camera=camera.T_world_camera, width=WIDTH, height=HEIGHT)


def _hands(vertex: Mapping[Side, ndarray], face: Mapping[Side, ndarray], frame: int) -> list[Shape]:
    return [
        Surface(vertex=vertex[side][frame], faces=face[side], color=_HAND, shading=0.6)
        for side in vertex
    ]


def _row(
    camera: PinholeCamera, name: str, shapes: list[list[Shape]], device: str
) -> UInt8[ndarray, "row column 3"]:
    images = [
        render(camera, of_frame, background=_BACKGROUND, device=device)[..., :3]
        for of_frame in shapes
    ]
    row = np.ascontiguousarray(np.concatenate(images, axis=1))
    _write(row, name, (6, 16))
    return row


def _heading(recording: Sequence, frames: list[int]) -> ndarray:
    row = np.full((_LABEL, WIDTH * len(frames), 3), 255, np.uint8)
    last = recording.reconstruction_frames[-1]
    for column, frame in enumerate(frames):
        kind = "start" if frame == 0 else "last fitted" if frame == last else "predicted"
        _write(row, f"frame {frame}, {kind}", (6 + column * WIDTH, 15))
    return row


def _scale(columns: int) -> ndarray:
    """Draw the legend of the nodes' colors."""
    row = np.full((_LABEL, WIDTH * columns, 3), 255, np.uint8)
    row[5:17, 130 : 130 + WIDTH] = _colors(np.linspace(0.0, WORST, WIDTH))
    _write(row, "distance: 0", (6, 15))
    _write(row, f"{1e3 * WORST:.0f} mm and more", (140 + WIDTH, 15))
    return row


def _colors(error: Float[ndarray, " node"]) -> Float[ndarray, "node 3"]:
    level = np.clip(np.rint(255.0 * error / WORST), 0, 255).astype(np.uint8)
    return cv2.applyColorMap(level[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1].astype(np.float64)


def _write(image: ndarray, text: str, place: tuple[int, int]) -> None:
    cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (40, 40, 40), 1, cv2.LINE_AA)
