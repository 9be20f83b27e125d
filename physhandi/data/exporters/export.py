"""Exports runs and simulated motion to all formats, atomically."""

import shutil
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from physhandi.data.exporters.gltf import scene_to_gltf
from physhandi.data.exporters.mesh import frame_files
from physhandi.data.exporters.mjcf import mjcf_files
from physhandi.data.exporters.newton import newton_files
from physhandi.data.exporters.rrd import scene_to_rrd
from physhandi.data.exporters.scene_data import LaySurface, SceneData, read_scene
from physhandi.data.exporters.splat_ply import CarrySplats, read_splats, splats_to_ply
from physhandi.data.exporters.table import (
    write_npz,
    write_summary,
    write_tables,
    write_trajectories,
)
from physhandi.data.exporters.usd import scene_to_usd
from physhandi.data.files import temporary_name, write_bytes, zip_bytes
from physhandi.data.run import RunFolder
from physhandi.errors import UsageError

FORMATS = ("ply", "npz", "csv", "yaml", "gltf", "usd", "splat-ply")
PLY = ("ply", "splat-ply")
"""Formats of which one frame alone can be written."""
SCENE_FORMATS = ("ply", "npz", "csv", "gltf", "usd", "mjcf", "newton", "rrd")


def export_run(
    run: RunFolder,
    format: str,  # noqa: A002 - the command line's name for it
    out_path: Path | str,
    *,
    sequence: str | None = None,
    frame: int | None = None,
    overwrite: bool = False,
    surface: LaySurface | None = None,
    carry: CarrySplats | None = None,
) -> Path:
    """Write a run, or one sequence of it, in another format.

    Args:
        run: The run to export.
        format: ``ply`` (nodes, hand meshes and virtual springs), ``npz`` (motion and springs),
            ``csv`` (a file: trajectories; a folder: also parameters and metrics) or ``yaml``
            (settings, parameters, losses and metrics of the whole run), ``gltf`` (one ``.glb``
            file: skinned hands, object nodes, springs and surface, moving), ``usd`` (the same
            without springs, for which usd-core must be installed), or ``splat-ply`` (what the
            object looks like, as viewers of 3D Gaussian splatting read it).
        out_path: File to write; all frames as PLY go to a ``.zip``. Without the format's suffix,
            PLY and CSV make a folder.
        sequence: Which sequence; None takes the first.
        frame: Only this frame (PLY); None takes all, which needs a folder, and leaves splats where
            they were fitted.
        overwrite: Whether to replace an export that is there.
        surface: Lays the smooth surface of the object (PLY, glTF, USD), which a run does not hold;
            see `load_surface`.
        carry: Moves splats to a frame; see `carried_splats`.

    Returns:
        The file or folder written.

    Raises:
        UsageError: If format, sequence or frame do not exist, or the path is in use.
        RunError: If the run does not contain the requested data.
    """
    out = Path(out_path)
    if format not in FORMATS:
        raise UsageError(f"'{format}' is not a format; choose one of {', '.join(FORMATS)}.")
    if frame is not None and format not in PLY:
        raise UsageError(
            f"A single frame can be exported as ply only (or splat-ply), not as {format}."
        )
    if format == "splat-ply":
        _check_target(out, format, is_folder=False, overwrite=overwrite)
        return _publish(out, partial(_write_splats, run, (sequence, frame), carry), is_folder=False)
    is_folder = (format == "csv" and out.suffix != ".csv") or _is_folder_of_frames(format, out)
    _check_target(out, format, is_folder=is_folder, overwrite=overwrite)
    if format == "yaml":
        return _publish(out, lambda path: write_summary(path, run), is_folder=False)
    scene = replace(read_scene(run, sequence), lay_surface=surface)
    if format == "csv" and is_folder:
        return _publish(out, lambda path: write_tables(path, run, scene), is_folder=True)
    return _write_scene(scene, format, out, frame, is_folder=is_folder)


def export_scene(
    scene: SceneData,
    format: str,  # noqa: A002
    out_path: Path | str,
    *,
    frame: int | None = None,
    overwrite: bool = False,
) -> Path:
    """Write motion that is not stored in a run, such as a simulation in memory.

    Args:
        scene: The motion.
        format: ``ply``, ``npz``, ``csv`` (trajectories), ``gltf`` or ``usd``; see `export_run`.
            ``mjcf`` and ``newton`` are ZIPs of the object as a scene of MuJoCo or a model of Newton
            with the hand's motion; ``rrd`` is a recording for Rerun's viewer, for which rerun-sdk
            must be installed.
        out_path: File to write; all frames as PLY go to a ``.zip`` or a folder.
        frame: Only this frame (PLY).
        overwrite: Whether to replace an export that is there.

    Returns:
        The file or folder written.

    Raises:
        UsageError: If format or frame do not exist, or the path is in use.
    """
    out = Path(out_path)
    if format not in SCENE_FORMATS:
        formats = ", ".join(SCENE_FORMATS)
        raise UsageError(f"'{format}' is not a format of motion; choose one of {formats}.")
    is_folder = _is_folder_of_frames(format, out)
    _check_target(out, format, is_folder=is_folder, overwrite=overwrite)
    return _write_scene(scene, format, out, frame, is_folder=is_folder)


def _write_splats(
    run: RunFolder, place: tuple[str | None, int | None], carry: CarrySplats | None, path: Path
) -> None:
    splats, (sequence, frame) = read_splats(run), place
    center = None
    if frame is not None:
        scene = read_scene(run, sequence)
        _check_frame(scene, frame)
        if carry is None:
            raise UsageError("Splats can be written where they were fitted only, in frame 0.")
        center = carry(splats, np.asarray(scene.rollout[frame], np.float64))
    write_bytes(path, splats_to_ply(splats, center))


def _write_scene(
    scene: SceneData,
    format: str,  # noqa: A002
    out: Path,
    frame: int | None,
    *,
    is_folder: bool,
) -> Path:
    whole: dict[str, Callable[[Path], None]] = {
        "npz": lambda path: write_npz(path, scene),
        "gltf": lambda path: write_bytes(path, scene_to_gltf(scene)),
        "csv": lambda path: write_trajectories(path, scene),
        "usd": lambda path: write_bytes(path, scene_to_usd(scene)),
        "mjcf": lambda path: write_bytes(path, zip_bytes(mjcf_files(scene))),
        "rrd": lambda path: write_bytes(path, scene_to_rrd(scene)),
        "newton": lambda path: write_bytes(path, zip_bytes(newton_files(scene))),
    }
    if format in whole:
        return _publish(out, whole[format], is_folder=False)
    if frame is not None:
        _check_frame(scene, frame)
    if out.suffix == ".ply" and frame is None:
        raise UsageError(
            f"{out} is one file; name a folder or a .zip for all frames, or choose one frame."
        )
    files = frame_files(scene, None if frame is None else [frame])
    if is_folder:
        return _publish(out, lambda path: _write_files(path, files), is_folder=True)
    if out.suffix == ".zip":
        return _publish(out, lambda path: write_bytes(path, zip_bytes(files)), is_folder=False)
    ((_, content),) = files
    return _publish(out, lambda path: write_bytes(path, content), is_folder=False)


def _check_frame(scene: SceneData, frame: int) -> None:
    if not 0 <= frame < scene.frame_count:
        raise UsageError(
            f"Sequence '{scene.sequence}' has frames 0 to {scene.frame_count - 1}, not {frame}."
        )


def _write_files(folder: Path, files: Iterable[tuple[str, bytes]]) -> None:
    for name, content in files:
        write_bytes(folder / name, content)


def _is_folder_of_frames(format: str, out: Path) -> bool:  # noqa: A002
    return format == "ply" and out.suffix not in {".ply", ".zip"}


def _check_target(out: Path, suffix: str, *, is_folder: bool, overwrite: bool) -> None:
    if not out.exists() or (is_folder and out.is_dir() and not any(out.iterdir())):
        return
    if not overwrite:
        raise UsageError(f"{out} exists already. Choose another path, or give --overwrite.")
    if out.is_dir() != is_folder:
        kind = "folder" if out.is_dir() else "file"
        raise UsageError(f"{out} is a {kind}, which this export cannot replace. Choose another.")
    if is_folder and any(path.suffix != f".{suffix}" or path.is_dir() for path in out.iterdir()):
        raise UsageError(f"{out} holds other things than an export, so it is not replaced.")


def _publish(out: Path, write: Callable[[Path], None], *, is_folder: bool) -> Path:
    """Write to a temporary path and move it to the target in one step; a failure leaves nothing."""
    out.parent.mkdir(parents=True, exist_ok=True)
    if not is_folder:
        write(out)
        return out
    temporary = out.with_name(temporary_name(out.name))
    temporary.mkdir()
    try:
        write(temporary)
        if out.exists():
            shutil.rmtree(out)
        temporary.replace(out)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    return out
