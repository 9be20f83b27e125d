"""What the bad input matrix shares: small good inputs to damage, and what a refusal must be."""

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from app import cli
from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.run import Run

FILMED_FRAMES, WIDTH, HEIGHT = 4, 48, 36


@dataclass(frozen=True)
class Bad:
    """One broken input: what is done to a good one, and what the refusal must say."""

    damage: Callable[[Path], Any]
    """Changes the good input at a path."""
    words: tuple[str, ...]
    """What the message must name: file, frame, field, remedy."""
    code: int = 1
    """Exit code: 1 for wrong data, 2 for a wrong order."""


def bad(damage: Callable[[Path], Any], *words: str, code: int = 1) -> Bad:
    return Bad(damage, words, code)


def table(cases: dict[str, Any]) -> Any:
    """Run a test once for each line of a table, under the line's name."""
    return pytest.mark.parametrize("case", list(cases.values()), ids=list(cases))


class Terminal:
    """Calls the command line in this process, and judges how it refuses."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder = folder
        self._capsys = capsys

    def __call__(self, *order: object) -> tuple[int, str, str]:
        """Call; returns exit code, standard output and standard error."""
        self._capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            cli.main([str(word) for word in order])
        return int(end.value.code or 0), *self._capsys.readouterr()

    def refused(self, code: int, words: tuple[str, ...], *order: object) -> str:
        """Call what must fail with one clear line and leave nothing but a failed run behind."""
        before = tree(self.folder)
        found, out, error = self(*order)
        assert "Traceback" not in out + error, error
        line = error.splitlines()[-1] if error else ""
        assert line.startswith("physhandi: "), error
        assert found == code, line
        assert out == ""
        missing = [word for word in words if word not in line]
        assert not missing, f"{missing} not in: {line}"
        after = tree(self.folder)
        left = {rel for rel, stamp in after.items() if before.get(rel) != stamp}
        gone = before.keys() - after.keys()
        assert not gone, gone
        for run in {folder for rel in left if (folder := self._run_of(rel)) is not None}:
            assert Run.open(run).state == "failed"
            assert Run.open(run).error == line.removeprefix("physhandi: ")
            left = {rel for rel in left if not (self.folder / rel).is_relative_to(run)}
        assert not left, left
        return line

    def _run_of(self, rel: str) -> Path | None:
        path = self.folder / rel
        return next((p for p in (path, *path.parents) if (p / "run.yaml").is_file()), None)


def tree(folder: Path) -> dict[str, str]:
    """All files and folders below a folder, hidden ones too, with what they hold."""
    found = dict[str, str]()
    # Paths as text: objects for each of them take longer than all the reading.
    for place, folders, files in os.walk(folder):
        rel = f"{place}/"[len(f"{folder}/") :]
        found |= {f"{rel}{name}": "folder" for name in folders}
        for name in files:
            with open(f"{place}/{name}", "rb") as stream:  # noqa: PTH123
                found[f"{rel}{name}"] = hashlib.sha256(stream.read()).hexdigest()
    return found


def write_filmed(folder: Path) -> Sequence:
    """Write a recording with everything that a view can have: video, depth, mask, keypoints."""
    camera = PinholeCamera(
        K=np.array([[40.0, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]]),
        T_world_camera=np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.6], [0, 0, 0, 1]]),
        width=WIDTH,
        height=HEIGHT,
    )
    meta = SequenceMeta(
        name=folder.name,
        frame_rate=30.0,
        frame_count=FILMED_FRAMES,
        hands=("right",),
        views=(ViewMeta(name="front", camera=camera),),
    )
    with SequenceWriter(folder) as writer:
        for frame in range(FILMED_FRAMES):
            mask = np.zeros((HEIGHT, WIDTH), np.uint8)
            mask[12:24, 10 + frame : 30 + frame] = 1
            mask[14:20, 32:40] = 2
            writer.save_image(f"views/front/mask/{frame:05d}.png", mask)
            depth = np.where(mask > 0, 550, 600).astype(np.uint16)
            writer.save_image(f"views/front/depth/{frame:05d}.png", depth)
        writer.make_folder("views/front")
        film(writer._path("views/front/color.mp4"), FILMED_FRAMES)
        keypoint = np.full((FILMED_FRAMES, 1, 21, 3), 0.9, np.float32)
        keypoint[..., 0] = 34 + np.arange(21) % 5
        keypoint[..., 1] = 15 + np.arange(21) // 5
        writer.save_array("views/front/keypoint.npy", keypoint)
        return writer.finish(meta)


def film(path: Path, frame_count: int) -> None:
    """Write a video of grey frames."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30, (WIDTH, HEIGHT))
    for frame in range(frame_count):
        writer.write(np.full((HEIGHT, WIDTH, 3), 40 * frame, np.uint8))
    writer.release()


def removed(rel: str) -> Callable[[Path], Any]:
    return lambda folder: (folder / rel).unlink()


def truncated(rel: str, size: int = 60) -> Callable[[Path], Any]:
    def cut(folder: Path) -> None:
        content = (folder / rel).read_bytes()
        assert len(content) > size
        (folder / rel).write_bytes(content[:size])

    return cut


def renamed(source: str, target: str) -> Callable[[Path], Any]:
    return lambda folder: (folder / source).rename(folder / target)


def array(rel: str, change: Callable[[np.ndarray], Any]) -> Callable[[Path], Any]:
    """Replace an array by what a function makes of it."""

    def rewrite(folder: Path) -> None:
        np.save(folder / rel, change(np.load(folder / rel)))

    return rewrite


def put(rel: str, index: Any, value: Any) -> Callable[[Path], Any]:
    """Set one place of an array."""

    def change(values: np.ndarray) -> np.ndarray:
        values[index] = value
        return values

    return array(rel, change)


def image(rel: str, change: Callable[[np.ndarray], Any]) -> Callable[[Path], Any]:
    def rewrite(folder: Path) -> None:
        path = str(folder / rel)
        cv2.imwrite(path, change(cv2.imread(path, cv2.IMREAD_UNCHANGED)))

    return rewrite


def fields(**changes: Any) -> Callable[[Path], Any]:
    """Replace fields of ``sequence.yaml``; None removes one."""

    def rewrite(folder: Path) -> None:
        path = folder / "sequence.yaml"
        content = yaml.safe_load(path.read_text()) | changes
        kept = {key: value for key, value in content.items() if value is not None}
        path.write_text(yaml.safe_dump(kept))

    return rewrite


def camera(**changes: Any) -> Callable[[Path], Any]:
    """Replace fields of the first view's camera."""

    def rewrite(folder: Path) -> None:
        path = folder / "sequence.yaml"
        content = yaml.safe_load(path.read_text())
        content["views"][0]["camera"] |= changes
        path.write_text(yaml.safe_dump(content))

    return rewrite


def text(rel: str, change: Callable[[str], str]) -> Callable[[Path], Any]:
    def rewrite(folder: Path) -> None:
        (folder / rel).write_text(change((folder / rel).read_text()))

    return rewrite


def both(*damages: Callable[[Path], Any]) -> Callable[[Path], Any]:
    def do(folder: Path) -> None:
        for damage in damages:
            damage(folder)

    return do
