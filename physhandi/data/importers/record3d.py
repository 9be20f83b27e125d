"""Unpacks recordings of the app Record3D on iPhones and iPads (``.r3d``) into folders.

They are ZIP archives: ``metadata`` (JSON), and in ``rgbd/`` for every frame a JPEG, depth as
float32 in metres and, from LiDAR, how sure it is, both compressed by Apple's LZFSE.
"""

import json
import re
import zipfile
import zlib
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.files import named_fields
from physhandi.data.importers.phystwin_files import fail
from physhandi.data.untrusted.image_header import MOST_PIXELS
from physhandi.errors import UsageError
from physhandi.progress import Progress

RECORD3D_SUFFIX = ".r3d"
"""Ending of such a recording."""
_STAGE = "unpack"
_LARGEST_MEMBER = 64 << 20
_FRAME = re.compile(r"rgbd/(\d+)\.(jpg|depth|conf)")
_FARTHEST, _WIDEST = 0.02, np.deg2rad(2.0)
"""How far the phone may move [m] and turn [rad]; cameras of a sequence stay where they are."""


def unpack_record3d(path: Path, view: Path, progress: Progress) -> None:
    """Write a recording as a camera's folder with color, depth, intrinsics and times.

    Depth that is not sure (confidence 0) is left out.

    Args:
        path: The recording.
        view: Folder to write; it must not be there yet.
        progress: Told after every frame; may cancel.

    Raises:
        ImportFailedError: If it is broken, or the phone was moved; names the recording and frame.
        UsageError: If the package that reads its depth is not installed.
    """
    if find_spec("lzfse") is None:
        raise UsageError(
            f"Reading {path.name} needs the package lzfse, which is not installed: pip install "
            "'physhandi[capture]'."
        )
    try:
        with zipfile.ZipFile(path) as archive:
            table = _metadata(path, archive)
            frames = _frames(path, archive)
            _check_still(path, table, len(frames))
            (view / "color").mkdir(parents=True)
            (view / "depth").mkdir()
            for place, number in enumerate(frames):
                progress.check_cancelled()
                _unpack_frame(path, archive, number, view, (table["dh"], table["dw"]))
                progress.report(_STAGE, place + 1, len(frames), None, f"frame {number}")
    # zipfile's RuntimeError: a member is encrypted or, as NotImplementedError, packed in a way that
    # it cannot unpack. What was packed damaged is zlib's error.
    except (zipfile.BadZipFile, EOFError, RuntimeError, zlib.error) as error:
        fail(path, f"is no whole .r3d recording ({error}); export it from Record3D again")
    _write_tables(path, view, table, frames)


def _read(path: Path, archive: zipfile.ZipFile, name: str) -> bytes:
    try:
        size = archive.getinfo(name).file_size
    except KeyError:
        fail(path, f"has no {name}; export it from Record3D again, as .r3d")
    if size > _LARGEST_MEMBER:
        fail(path, f"{name} announces {size} bytes, which no frame has")
    return archive.read(name)


def _metadata(path: Path, archive: zipfile.ZipFile) -> dict[str, Any]:
    try:
        table = named_fields(json.loads(_read(path, archive, "metadata")))
    except ValueError:
        table = None
    if table is None:
        fail(path, "metadata is no JSON object; export it from Record3D again")
    for name in ("w", "h", "dw", "dh"):
        value = table.get(name)
        if not isinstance(value, int) or not 0 < value < 65_536:
            fail(path, f"metadata: {name} is {value!r}; expected the size of images [px]")
    if max(table["w"] * table["h"], table["dw"] * table["dh"]) > MOST_PIXELS:
        fail(path, f"metadata announces images of {table['w']}x{table['h']} px")
    return table


def _frames(path: Path, archive: zipfile.ZipFile) -> list[int]:
    numbers: dict[str, set[int]] = {"jpg": set(), "depth": set(), "conf": set()}
    for name in archive.namelist():
        match = _FRAME.fullmatch(name)
        if match is not None:
            numbers[match[2]].add(int(match[1]))
    lacking = numbers["jpg"] ^ numbers["depth"]
    if lacking or not numbers["jpg"]:
        what = f"frame {min(lacking)} has only one of both" if lacking else "there is none"
        fail(path, f"needs color and depth of every frame in rgbd/, but {what}")
    return sorted(numbers["jpg"])


def _check_still(path: Path, table: dict[str, Any], count: int) -> None:
    """Refuse a recording in which the phone was moved, as its own tracking tells."""
    poses = table.get("poses")
    if not isinstance(poses, list) or len(cast("list[Any]", poses)) != count:
        return
    try:
        pose = np.array(poses, dtype=np.float64).reshape(count, 7)
    except ValueError:
        fail(path, "metadata: poses are not seven numbers for each frame")
    turn = pose[:, :4] / np.linalg.norm(pose[:, :4], axis=1, keepdims=True)  # A quaternion.
    away = np.linalg.norm(pose[:, 4:] - pose[0, 4:], axis=1)
    angle = 2 * np.arccos(np.clip(np.abs(turn @ turn[0]), 0, 1))
    moved = np.flatnonzero((away > _FARTHEST) | (angle > _WIDEST))
    if len(moved):
        frame = int(moved[0])
        fail(
            path,
            f"the phone had moved by {100 * away[frame]:.1f} cm and turned by "
            f"{np.rad2deg(angle[frame]):.1f} degrees at frame {frame}. Cameras must not move: put "
            "the phone on a stand",
        )


def _unpack_frame(
    path: Path, archive: zipfile.ZipFile, number: int, view: Path, shape: tuple[int, int]
) -> None:
    (view / "color" / f"{number:06d}.jpg").write_bytes(_read(path, archive, f"rgbd/{number}.jpg"))
    depth = _decoded(path, archive, f"rgbd/{number}.depth", np.dtype("<f4"), shape)
    if f"rgbd/{number}.conf" in archive.NameToInfo:
        sure = _decoded(path, archive, f"rgbd/{number}.conf", np.dtype(np.uint8), shape)
        depth[sure == 0] = 0.0
    np.save(view / "depth" / f"{number:06d}.npy", depth)


def _decoded(
    path: Path, archive: zipfile.ZipFile, name: str, kind: Any, shape: tuple[int, int]
) -> ndarray:
    lzfse: Any = import_module("lzfse")
    try:
        content = bytes(lzfse.decompress(_read(path, archive, name)))
    except lzfse.error:
        fail(path, f"{name} cannot be decoded; it is damaged. Export the recording again")
    if len(content) != kind.itemsize * shape[0] * shape[1]:
        fail(path, f"{name} holds {len(content)} bytes, not {shape[1]}x{shape[0]} numbers")
    return np.frombuffer(content, kind).reshape(shape).copy()


def _intrinsics(path: Path, table: dict[str, Any]) -> Float[ndarray, " 4"]:
    """Read fx, fy, cx and cy: those of frames, which focus changes a little, else the matrix."""
    try:
        each = np.array(table.get("perFrameIntrinsicCoeffs") or [], dtype=np.float64)
        if each.ndim == 2 and each.shape[1] == 4:
            return np.median(each, axis=0)
        column = np.array(table["K"], dtype=np.float64).reshape(3, 3)
    except (KeyError, TypeError, ValueError):
        fail(path, "metadata has neither K (nine numbers) nor perFrameIntrinsicCoeffs")
    return np.array([column[0, 0], column[1, 1], column[2, 0], column[2, 1]])


def _write_tables(path: Path, view: Path, table: dict[str, Any], frames: list[int]) -> None:
    lens, size = _intrinsics(path, table), (table["w"], table["h"])
    scale = np.array([table["dw"] / size[0], table["dh"] / size[1]])
    center = (lens[2:] + 0.5) * scale - 0.5
    color = {"fx": lens[0], "fy": lens[1], "cx": lens[2], "cy": lens[3]}
    depth = {"fx": lens[0] * scale[0], "fy": lens[1] * scale[1], "cx": center[0], "cy": center[1]}
    content: dict[str, Any] = {
        **color, "width": size[0], "height": size[1], "depth_scale": 1.0,
        "depth": {**depth, "width": table["dw"], "height": table["dh"]},
        "depth_to_color": np.eye(4).tolist(),
    }  # fmt: skip
    rate = table.get("fps")
    if isinstance(rate, int | float) and 1 <= rate <= 1000:
        content["frame_rate"] = rate
    (view / "intrinsics.json").write_text(json.dumps(content))
    times = table.get("frameTimestamps")
    if isinstance(times, list) and len(cast("list[Any]", times)) == len(frames):
        text = "\n".join(str(time) for time in cast("list[Any]", times))
        (view / "timestamps.txt").write_text(text + "\n")
