"""Imports raw RGB-D recordings: synchronised, without distortion, with the table as the ground."""

import hashlib
import shutil
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

import physhandi
from physhandi.data import sequence as sequences
from physhandi.data.camera import PinholeCamera
from physhandi.data.depth_scale import KNOWN_SCALES, LARGEST_SCALE
from physhandi.data.files import temporary_name
from physhandi.data.importers.bag import find_bags, left_out_bags, name_bags, unpack_bags
from physhandi.data.importers.board_calibration import (
    AprilGrid,
    Board,
    BoardSighting,
    calibrate_by_board,
    find_board,
    parse_board,
)
from physhandi.data.importers.phystwin_files import fail, read_image
from physhandi.data.importers.recorded_camera import read_table
from physhandi.data.importers.recorded_stream import (
    COLOR_SUFFIXES,
    RecordedStream,
    check_picture,
    natural_key,
)
from physhandi.data.importers.recorded_view import CALIBRATION, RecordedView, find_views
from physhandi.data.importers.rectification import Rectifier
from physhandi.data.importers.stream_pairing import PairedFrames, cut, pair_streams
from physhandi.data.importers.table_calibration import (
    TablePattern,
    calibrate_by_pattern,
    see_pattern,
)
from physhandi.data.importers.view_agreement import (
    cloud,
    find_table,
    shared_surface,
    table_distance_ratio,
)
from physhandi.data.sequence_meta import FILE, SequenceMeta, Side, ViewMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.errors import ImportFailedError, SequenceError, UsageError, describe
from physhandi.progress import NullProgress, Progress

_STAGE = "import"
BOARD_FILE = "board.json"
"""File beside the board's pictures that says which board it is."""
_FINGERPRINT = "fingerprint"
"""What provenance calls the hash of all that a sequence was made of."""
BY_BOARD = "board"
"""How provenance begins to say that cameras were calibrated by a board."""
_SAMPLED = 5
_NEAREST, _FARTHEST = 0.15, 3.5
"""Distances that the median of a depth image may have, unless the scale is given [m]."""
_BOUNDS_GIVEN = (0.05, 12.0)
_NO_DISTANCE = 1e6
"""What renderers write where they see nothing is beyond this, whatever the unit."""
_JPEG_QUALITY = 95
_FIRST_FRAMES = 5
_UPRIGHT = np.cos(np.deg2rad(12))
_TABLE_SHARE = 0.25
_WALL = -0.25
"""A plane whose normal points up the picture less than this may be a wall."""
_RATIO = (0.95, 1.05)
_WRONG_SCALE, _WRONG_LENS = (0.8, 1.25), (0.6, 1.6)
_RATIO_SHARE = 0.2
_LEAST_SHARED, _LEAST_SHARED_ABOVE = 0.45, 0.3
_ABOVE = 0.02
_ON_TABLE, _TABLE_POINTS = 0.015, 200
_PNG_EFFORT = 2
_MOST_RATE = 1000.0
"""Most frames per second [Hz]."""


@dataclass(frozen=True, kw_only=True)
class CaptureOptions:
    """Options of an import: all that the recording does not say itself."""

    depth_scale: float | None = None
    """Metres per unit of depth images; a value above 1 is units per metre. None: as recorded."""
    intrinsics: Path | None = None
    """File with the intrinsics of all cameras, instead of those in the folder."""
    board: Board | None = None
    """Board from which the cameras' poses are found; None: ``calibration/board.json`` tells, or
    poses are given."""
    by_table: bool = False
    """Whether poses are found from the table's pattern, whatever else tells them."""
    start: int = 0
    """First frame that is imported."""
    stop: int | None = None
    """Frame before which the import ends; None: all."""
    every: int = 1
    """Only every n-th frame is imported."""
    frame_rate: float | None = None
    """Frame rate of recordings without times [Hz]."""
    hands: tuple[Side, ...] = ("right",)
    """Hands that the recording shows."""


@dataclass(eq=False)
class _Source:
    """One camera, ready to give its images."""

    view: RecordedView
    rectifier: Rectifier
    scale: float
    color: ndarray | None
    depth: ndarray | None
    holes: list[int] = field(default_factory=list[int])

    def color_image(self, frame: int) -> UInt8[ndarray, "row column 3"]:
        """Read and straighten a color image (BGR)."""
        assert self.view.color is not None  # noqa: S101 - asked by callers
        assert self.color is not None  # noqa: S101
        return self.rectifier.color(self.view.color.read(int(self.color[frame])))

    def depth_image(self, frame: int) -> Float[ndarray, "row column"]:
        """Read depth for the pixels of the straightened color image [m]."""
        if self.view.depth is None or self.depth is None or self.depth[frame] < 0:
            return np.zeros((self.view.size[1], self.view.size[0]), np.float32)
        raw = self.view.depth.read(int(self.depth[frame])).astype(np.float32)
        return self.rectifier.depth(raw * np.float32(self.scale))

    def camera(self, T_world_camera: ndarray) -> PinholeCamera:
        """Make the ideal camera of its images."""
        return PinholeCamera(self.rectifier.K, T_world_camera, *self.view.size)


@dataclass(frozen=True, eq=False)
class _Placement:
    """Where the cameras are, and how that was found."""

    poses: tuple[Float[ndarray, "4 4"], ...]
    ground: float | None
    report: dict[str, Any]
    notes: list[str]


def import_capture(
    source_folder: Path | str,
    out_folder: Path | str,
    progress: Progress | None = None,
    *,
    options: CaptureOptions | None = None,
    overwrite: bool = False,
    keeps_same: bool = False,
    check: Callable[[Sequence[RecordedView], int], None] | None = None,
) -> sequences.Sequence:
    """Convert a raw recording of one or several RGB-D or color cameras into a sequence.

    `Sequence.provenance` tells how streams were paired and calibrated, and all that was repaired or
    assumed (``notes``).

    Args:
        source_folder: One folder for each camera with ``color/``, ``depth/`` and intrinsics; or
            such a folder; or what PhysTwin's recorder writes; or ROS or RealSense bags, or
            Record3D's ``.r3d`` (docs/your-data.md).
        out_folder: Folder of the new sequence; its last part names the sequence.
        progress: Receives a report after every image; may cancel. The same call then goes on where
            it was stopped, or killed, unless the recording, its calibration or an option was
            changed.
        options: What the recording does not say itself.
        overwrite: Whether to replace a sequence that is there.
        keeps_same: Whether one that is there is taken as it is if it was made of the same recording
            with the same options; else it is refused like any other.
        check: Is given the cameras and the number of frames before any image is imported, and may
            refuse them by an error.

    Raises:
        ImportFailedError: If a file is missing, broken or contradicts another one; names it.
        UsageError: If an option does not fit the recording.
        CancelledError: If the user asked to stop.
    """
    options, progress = options or CaptureOptions(), progress or NullProgress()
    if not options.hands or len(set(options.hands)) != len(options.hands):
        raise UsageError(
            f"Name each hand that the recording shows once, not {list(options.hands)}."
        )
    if options.by_table and options.board is not None:
        raise UsageError("--by-table needs no board; give it, or --charuco or --april-grid.")
    given = Path(source_folder)
    with (
        _unpacked(given, Path(out_folder).resolve(), progress) as source,
        _closing(find_views(source, options.intrinsics)) as views,
    ):
        _refuse_same_names(views)
        paired = _paired(views, options)
        _check_images(views, paired)
        _check_board_pictures(source, views, _board(source, views, options))
        sources, notes = _sources(views, paired, options)
        if check is not None:
            check(views, paired.count)
        origin = _origin(source, given, sources, paired, options)
        if keeps_same and not overwrite and _is_made_of(Path(out_folder), origin):
            return sequences.Sequence.load(out_folder)
        placement = _place(source, sources, options, paired.count)
        cameras = [one.camera(pose) for one, pose in zip(sources, placement.poses, strict=True)]
        report = dict(placement.report)
        report["agreement"] = _check_agreement(sources, cameras, placement, paired.count)
        notes += [*paired.notes, *placement.notes, *left_out_bags(given)]
        with SequenceWriter(out_folder, overwrite=overwrite, origin=origin) as writer:
            notes += _write(writer, sources, paired, progress)
            meta = SequenceMeta(
                name=writer.folder.name,
                description=f"Recorded by {len(views)} camera{'s' * (len(views) > 1)}.",
                frame_rate=round(paired.frame_rate, 4),
                frame_count=paired.count,
                ground_height=placement.ground,
                hands=options.hands,
                views=tuple(
                    ViewMeta(name=view.name, camera=camera)
                    for view, camera in zip(views, cameras, strict=True)
                ),
                provenance={
                    "importer": "capture",
                    "folder": given.resolve().name,
                    _FINGERPRINT: origin,
                    "frames": {"start": options.start, "every": options.every},
                    "depth_scale": {
                        one.view.name: one.scale for one in sources if one.view.depth is not None
                    },
                    "pairing": _pairing_report(views, paired),
                    "calibration": {k: v for k, v in report.items() if v},
                    "notes": notes,
                },
            )
            sequence = writer.finish(meta)
    return sequence


def _is_made_of(folder: Path, origin: str) -> bool:
    """Tell whether a folder is a sequence that was imported from the same, in the same way."""
    if not (folder / FILE).is_file():
        return False
    try:
        return sequences.Sequence.load(folder).provenance.get(_FINGERPRINT) == origin
    except SequenceError:
        return False


def _origin(
    source: Path,
    given: Path,
    sources: list[_Source],
    paired: PairedFrames,
    options: CaptureOptions,
) -> str:
    """Name all that a sequence is made from: files, lenses, poses, scales, times and frames."""
    views = [one.view for one in sources]
    target = _board(source, views, options)
    digest = hashlib.sha256(
        repr((physhandi.__version__, options, target, paired.frame_rate)).encode()
    )
    for one in sources:
        view = one.view
        lenses = [view.camera, *([view.depth_camera] if view.depth_camera is not None else [])]
        arrays = [
            *(lens.K for lens in lenses),
            *(lens.distortion for lens in lenses),
            *(view.T_color_depth, view.T_world_camera, one.color, one.depth),
        ]
        shapes = [None if array is None else array.shape for array in arrays]
        models = [lens.model for lens in lenses]
        digest.update(repr((view.name, view.size, one.scale, models, shapes)).encode())
        for array in arrays:
            if array is not None:
                digest.update(np.ascontiguousarray(array).tobytes())
    # Bags are unpacked anew each time, so they stand for their images.
    files = find_bags(given) or [
        file for view in views for stream in view.streams for file in stream.files or (stream.path,)
    ]
    for view in views if target is not None else ():
        pictures = _board_pictures(source, view, is_alone=len(views) == 1) or ()
        files += [path.resolve() for path in pictures]
    for file in files:
        for path in [file] if file.is_file() else sorted(file.rglob("*")):
            status = path.stat()
            digest.update(f"{path} {status.st_size} {status.st_mtime_ns}\n".encode())
    return digest.hexdigest()


@dataclass(frozen=True, kw_only=True)
class SurveyedView:
    """Contents of one view of a recording."""

    name: str
    """Name."""
    color: str
    """Its color images in words; empty if there are none."""
    depth: str
    """Its depth images in words; empty if there are none."""
    focal_length: float
    """Geometric mean of both focal lengths [px]."""
    depth_scale: float | None
    """Metres per unit of depth, as told or found; None if it is not known."""
    has_pose: bool
    """Whether the recording states where the camera is."""


@dataclass(frozen=True, kw_only=True)
class CaptureSurvey:
    """Contents of a recording, by its headers and a few depth images."""

    bags: tuple[str, ...] = ()
    """Bags, of which everything else is only known when they are unpacked."""
    views: tuple[SurveyedView, ...] = ()
    """Its cameras."""
    frame_count: int | None = None
    """Frames that all cameras have."""
    frame_rate: float | None = None
    """Frames a second [Hz]."""
    calibration: str = ""
    """How the cameras' poses will be found, in words; empty if that is not known."""
    board: str = ""
    """Board that the recording names."""
    notes: tuple[str, ...] = ()
    """Repairs and assumptions, as sentences."""
    problems: tuple[str, ...] = ()
    """Problems with which an import would fail, each with its remedy."""

    def to_dict(self) -> dict[str, Any]:
        """Give it as plain data."""
        return asdict(self)


def survey_capture(source: Path | str, options: CaptureOptions | None = None) -> CaptureSurvey:
    """Tell what a recording holds before it is imported.

    Args:
        source: See `import_capture`.
        options: What the recording does not say itself.
    """
    source, options = Path(source), options or CaptureOptions()
    try:
        bags = find_bags(source)
        if bags:
            name_bags(source, bags)
            places = [bag.relative_to(source) for bag in bags if bag != source]
            return CaptureSurvey(bags=tuple(map(str, places)) or (source.name,))
        with _closing(find_views(source, options.intrinsics)) as views:
            _refuse_same_names(views)
            return _surveyed(source, views, options)
    except (ImportFailedError, UsageError, OSError) as error:
        return CaptureSurvey(problems=(describe(error),))


def _surveyed(source: Path, views: list[RecordedView], options: CaptureOptions) -> CaptureSurvey:
    problems: list[str] = []
    notes: list[str] = []
    paired: PairedFrames | None = None
    scales: dict[str, float] = {}
    board: Board | None = None
    try:
        paired = _paired(views, options)
        _check_images(views, paired)
        sources, remarks = _sources(views, paired, options)
        scales = {one.view.name: one.scale for one in sources if one.view.depth is not None}
        notes += [*remarks, *paired.notes, *left_out_bags(source)]
    except (ImportFailedError, UsageError) as error:
        problems.append(str(error))
    try:
        board = options.board or _recorded_board(source)
        _check_board_pictures(source, views, _board(source, views, options))
    except ImportFailedError as error:
        problems.append(str(error))
    way = "the pattern of the table" if options.by_table else _calibrated_by(source, views, board)
    if not way:
        problems.append(_no_pose(source, views))
    return CaptureSurvey(
        views=tuple(
            SurveyedView(
                name=view.name,
                color=_in_words(view.color),
                depth=_in_words(view.depth),
                focal_length=float(np.sqrt(view.camera.K[0, 0] * view.camera.K[1, 1])),
                depth_scale=scales.get(view.name),
                has_pose=view.T_world_camera is not None,
            )
            for view in views
        ),
        frame_count=None if paired is None else paired.count,
        frame_rate=None if paired is None else round(paired.frame_rate, 4),
        calibration=way,
        board="" if board is None else _described(board),
        notes=tuple(dict.fromkeys(notes)),
        problems=tuple(problems),
    )


def _in_words(stream: RecordedStream | None) -> str:
    if stream is None:
        return ""
    kind = "images" if stream.files else "frames of a video"
    timed = ", with times" if stream.time is not None else ""
    return f"{stream.count} {kind}, {stream.width} x {stream.height} px{timed}"


def _calibrated_by(source: Path, views: list[RecordedView], board: Board | None) -> str:
    """Say how cameras will be placed; empty if that is not known."""
    if board is not None:
        where = "its pictures" if (source / CALIBRATION).is_dir() else "its first frames"
        return f"the board in {where} ({_described(board)})"
    if all(view.T_world_camera is not None for view in views):
        return "the poses that the recording states"
    return "the largest plane that the camera sees" if len(views) == 1 else ""


@contextmanager
def _unpacked(source: Path, out: Path, progress: Progress) -> Generator[Path, None, None]:
    """Give the recording as folders; bags are unpacked beside the sequence for as long."""
    bags = find_bags(source)
    if not bags:
        yield source
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    folder = out.with_name(temporary_name(out.name))
    try:
        unpack_bags(source, bags, folder, progress)
        yield folder
    except ImportFailedError as error:  # Who has the bags knows nothing of that folder.
        raise ImportFailedError(str(error).replace(str(folder), str(source))) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _closing(views: list[RecordedView]) -> Generator[list[RecordedView], None, None]:
    try:
        yield views
    finally:
        for view in views:
            for stream in view.streams:
                stream.close()


def _refuse_same_names(views: Sequence[RecordedView]) -> None:
    names = [view.name for view in views]
    for view in views:
        if names.count(view.name) > 1:
            fail(view.folder, "gives a view a name that another one has. Rename the folder")


def _paired(views: Sequence[RecordedView], options: CaptureOptions) -> PairedFrames:
    if options.frame_rate is not None and not 0.0 < options.frame_rate <= _MOST_RATE:
        raise UsageError(
            f"--frame-rate {options.frame_rate:g}: give frames per second, above 0 and up to "
            f"{_MOST_RATE:g}."
        )
    names = [f"{view.name}/{stream.kind}" for view in views for stream in view.streams]
    streams = [stream for view in views for stream in view.streams]
    paired = pair_streams(names, streams, options.frame_rate)
    return cut(paired, options.start, options.stop, options.every)


def _check_images(views: Sequence[RecordedView], paired: PairedFrames) -> None:
    """Refuse images that cannot be decoded, before any is: the broken one may be the last."""
    streams = [stream for view in views for stream in view.streams]
    for stream, index in zip(streams, paired.index, strict=True):
        stream.check_files(np.unique(index[index >= 0]).tolist())


def _pairing_report(views: Sequence[RecordedView], paired: PairedFrames) -> dict[str, Any]:
    """Tell how far the images of each stream are from their frames' moments [s]."""
    names = [f"{view.name}/{stream.kind}" for view in views for stream in view.streams]
    return {
        name: {
            "median_error": round(float(np.nanmedian(np.abs(error))), 6),
            "largest_error": round(float(np.nanmax(np.abs(error))), 6),
        }
        for name, error in zip(names, paired.error, strict=True)
        if error is not None
    } or {"by": "number or order of the images"}


def _sources(
    views: Sequence[RecordedView], paired: PairedFrames, options: CaptureOptions
) -> tuple[list[_Source], list[str]]:
    sources: list[_Source] = []
    notes: list[str] = []
    position = 0
    for view in views:
        index: dict[str, ndarray] = {}
        for stream in view.streams:
            index[stream.kind] = paired.index[position]
            position += 1
        depth_size = None if view.depth is None else (view.depth.width, view.depth.height)
        rectifier = Rectifier(
            view.camera, view.size, view.depth_camera, depth_size, view.T_color_depth
        )
        source = _Source(view, rectifier, 1.0, index.get("color"), index.get("depth"))
        notes += view.notes
        if view.color is None:
            notes.append(f"View '{view.name}' has no color, so neither keypoints nor masks.")
        if view.depth is None:
            notes.append(f"View '{view.name}' has no depth; it serves for hands alone.")
        else:
            source.scale = _depth_scale(source, view.depth, options.depth_scale, notes)
        sources.append(source)
    return sources, list(dict.fromkeys(notes))


def _depth_scale(
    source: _Source, stream: RecordedStream, given: float | None, notes: list[str]
) -> float:
    """Decide how many metres a unit of depth is, and refuse distances that cannot be."""
    assert source.depth is not None  # noqa: S101 - a view with a stream of depth
    there = source.depth[source.depth >= 0]
    chosen = np.unique(np.linspace(0, len(there) - 1, min(_SAMPLED, len(there))).astype(int))
    medians: list[float] = []
    is_float = False
    for place in chosen:
        raw = stream.read(int(there[place]))
        is_float = raw.dtype.kind == "f"
        measured = raw[(raw > 0) & (raw < _NO_DISTANCE)] if is_float else raw[raw > 0]
        if measured.size:
            medians.append(float(np.median(measured)))
    if not medians:
        fail(
            stream.path,
            f"holds no distance at all in frames {', '.join(map(str, chosen.tolist()))}: all "
            "values are 0, negative, not finite or too large. Record depth again (or change "
            "its sign, if it is along OpenGL's -z), or remove it to use color alone",
        )
    median = float(np.median(medians))
    scale = given if given is not None else source.view.depth_scale
    if scale is not None and not (np.isfinite(scale) and scale > 0):
        raise UsageError(f"--depth-scale is {scale:g}; expected metres per unit, such as 0.001.")
    low, high = (_NEAREST, _FARTHEST) if given is None else _BOUNDS_GIVEN
    if scale is None:
        scale = 0.001 if not is_float or median > 20 else 1.0
        unit = "millimetres" if scale == 0.001 else "metres"
        notes.append(f"Nothing tells the unit of depth, so it is taken for {unit}.")
    elif scale > LARGEST_SCALE:
        scale = 1.0 / scale
    if not low <= scale * median <= high:
        fits = [f"{s:g}" for s in KNOWN_SCALES if _NEAREST <= s * median <= _FARTHEST]
        hint = (
            f"; {' or '.join(fits)} would make it {_NEAREST:g} to {_FARTHEST:g} m" if fits else ""
        )
        fail(
            stream.path,
            f"would show things {scale * median:.3g} m away (median) with {scale:g} metres per "
            f"unit, which is no distance for hands{hint}. Give --depth-scale (TUM: 0.0002)",
        )
    return scale


def _recorded_board(source: Path) -> Board | None:
    """Read which board the calibration pictures show, if the recording tells it."""
    path = source / CALIBRATION / BOARD_FILE
    if not path.is_file():
        return None
    table = read_table(path)
    fields = cast("dict[Any, Any]", table) if isinstance(table, dict) else {}
    texts = [fields.get(name, "") for name in ("charuco", "april_grid")]
    if not all(isinstance(text, str) for text in texts) or not any(texts):
        fail(path, 'names no board; expected {"charuco": "7x5,0.04"} or {"april_grid": "…"}')
    try:
        return parse_board(*texts)
    except UsageError as error:
        fail(path, str(error).rstrip("."))


def _board(source: Path, views: Sequence[RecordedView], options: CaptureOptions) -> Board | None:
    """Tell by which board cameras are calibrated; None if by none."""
    if options.by_table and len(views) > 1:
        return None
    return options.board or _recorded_board(source)


def _check_board_pictures(
    source: Path, views: Sequence[RecordedView], target: Board | None
) -> None:
    """Refuse pictures of the board that cannot be decoded, before any is."""
    for view in views if target is not None else ():
        for path in _board_pictures(source, view, is_alone=len(views) == 1) or ():
            check_picture(path, view.size)


def _board_pictures(source: Path, view: RecordedView, *, is_alone: bool) -> list[Path] | None:
    """Find a view's pictures of the board; None if it has no folder for them."""
    folder = source / CALIBRATION / view.folder.name
    if is_alone and not folder.is_dir():
        folder = source / CALIBRATION
    if not folder.is_dir():
        return None
    files = [path for path in folder.iterdir() if path.suffix.lower() in COLOR_SUFFIXES]
    if not files:
        fail(folder, f"has no pictures of the board ({', '.join(sorted(COLOR_SUFFIXES))})")
    return sorted(files, key=natural_key)


def _place(
    source: Path, sources: list[_Source], options: CaptureOptions, frame_count: int
) -> _Placement:
    """Find where the cameras are, with z up and the table, where it is known, at a height."""
    if options.by_table and len(sources) > 1:
        return _by_table(sources, sorted({0, frame_count // 2}))
    target = _board(source, [one.view for one in sources], options)
    if target is not None:
        return _by_board(source, sources, target)
    given = [one.view.T_world_camera for one in sources]
    if all(pose is not None for pose in given):
        return _as_given(sources, tuple(cast("list[ndarray]", given)))
    if len(sources) == 1:
        return _alone(sources[0])
    raise ImportFailedError(_no_pose(source, [one.view for one in sources]))


def _no_pose(source: Path, views: Sequence[RecordedView]) -> str:
    """Say which camera's place is not known, and what to do."""
    lacking = next(view for view in views if view.T_world_camera is None)
    has_pictures = (source / CALIBRATION).is_dir()
    remedy = (
        f"{CALIBRATION}/ is there: say which board it shows, like --charuco 7x5,0.04"
        if has_pictures
        else f"Put pictures of a ChArUco board into {CALIBRATION}/{lacking.name}/ (of all views) "
        "and give --charuco WxH,SQUARE, add extrinsics.json with T_world_camera of each view, or "
        "give --by-table if all see a table with a pattern such as wood"
    )
    return f"Nothing tells where the camera of view '{lacking.name}' is. {remedy}."


def _by_table(sources: list[_Source], frames: list[int]) -> _Placement:
    """Place cameras above the table that each of them measures, by the pattern that they share."""
    tables: list[ndarray] = []
    patterns: list[list[TablePattern]] = []
    for one in sources:
        if one.view.color is None or one.view.depth is None:
            lacks = "color" if one.view.color is None else "depth"
            raise ImportFailedError(
                f"View '{one.view.name}' has no {lacks}, so the table's pattern (--by-table) does "
                "not tell where its camera is. Use pictures of a board (--charuco)."
            )
        tables.append(_table_below(one, frames))
        camera = one.camera(tables[-1])
        patterns.append(
            [see_pattern(camera, one.color_image(f), one.depth_image(f)) for f in frames]
        )
    laid, shared = calibrate_by_pattern([one.view.name for one in sources], patterns)
    poses = tuple(T @ table for T, table in zip(laid, tables, strict=True))
    report = {"by": "the pattern of the table", "shared_pattern": shared}
    return _Placement(poses, 0.0, report, [])


def _table_below(one: _Source, frames: list[int]) -> Float[ndarray, "4 4"]:
    """Find the table that a camera looks down on: its pose above it."""
    camera = one.camera(np.eye(4))
    point = np.concatenate([cloud(camera, one.depth_image(frame)) for frame in frames])
    table = find_table(point, np.zeros((1, 3)), np.array([1.0, 0.0, 0.0]))
    if table is None or table.share < _TABLE_SHARE or table.T_table_world[2, 1] > _WALL:
        raise ImportFailedError(
            f"View '{one.view.name}' looks down on no table, so its pattern (--by-table) does not "
            "tell where the camera is. Use pictures of a board (--charuco)."
        )
    return table.T_table_world


def _by_board(source: Path, sources: list[_Source], target: Board) -> _Placement:
    sightings = [_sightings(source, one, target, is_alone=len(sources) == 1) for one in sources]
    names = [one.view.name for one in sources]
    lenses = [one.rectifier.K for one in sources]
    sizes = [one.view.size for one in sources]
    calibration = calibrate_by_board(names, lenses, sizes, sightings)
    tables = [
        _table_points(one, pose)
        for one, pose in zip(sources, calibration.T_world_camera, strict=True)
    ]
    if any(map(len, tables)):
        calibration = calibrate_by_board(names, lenses, sizes, sightings, tables)
    report = {
        "by": f"{BY_BOARD}, {_described(target)}",
        "reprojection_error_px": {
            name: round(error, 3) for name, error in zip(names, calibration.error, strict=True)
        },
        "corners": dict(zip(names, calibration.corner_count, strict=True)),
    }
    return _Placement(calibration.T_world_camera, 0.0, report, [])


def _described(target: Board) -> str:
    size = f"{target.columns}x{target.rows}"
    if isinstance(target, AprilGrid):
        return f"{size} AprilTags of {target.side:g} m"
    return f"ChArUco, {size} squares of {target.square:g} m"


def _table_points(source: _Source, pose: ndarray) -> Float[ndarray, "point 3"]:
    """Pick points that a view measured on the table, in its camera's coordinates [m]."""
    if source.view.depth is None:
        return np.zeros((0, 3))
    point = cloud(source.camera(pose), source.depth_image(0))
    near = point[np.abs(point[:, 2]) < _ON_TABLE]
    chosen = np.linspace(0, len(near) - 1, min(_TABLE_POINTS, len(near))).astype(np.int64)
    inverse = np.linalg.inv(pose)
    return near[chosen] @ inverse[:3, :3].T + inverse[:3, 3]


def _sightings(
    source: Path, one: _Source, target: Board, *, is_alone: bool
) -> list[BoardSighting | None]:
    """Look for the board in a view's calibration pictures, else in its first frames."""
    files = _board_pictures(source, one.view, is_alone=is_alone)
    if files is None:
        folder = source / CALIBRATION / one.view.folder.name
        if one.view.color is None:
            fail(folder, "is missing, and the view has no color in which the board could be seen")
        count = min(_FIRST_FRAMES, 0 if one.color is None else len(one.color))
        # The board lies still at the beginning, so the first frame in which it is seen is enough.
        for frame in range(count):
            sighting = find_board(one.color_image(frame), target)
            if sighting is not None:
                return [sighting]
        fail(
            folder,
            f"is missing, and the first {count} frames of the view do not show the board. Put its "
            "pictures there: folders of pictures are called as those of their cameras",
        )
    sightings: list[BoardSighting | None] = []
    for path in files:
        image = one.rectifier.color(read_image(path, cv2.IMREAD_COLOR))
        sightings.append(find_board(image, target))
    return sightings


def _as_given(sources: list[_Source], poses: tuple[ndarray, ...]) -> _Placement:
    """Take poses as they are; a world that is upside down, or not upright, is turned."""
    eye = np.stack([pose[:3, 3] for pose in poses])
    points = [
        cloud(one.camera(pose), one.depth_image(0))
        for one, pose in zip(sources, poses, strict=True)
        if one.view.depth is not None
    ]
    report: dict[str, Any] = {"by": "given"}
    table = find_table(np.concatenate(points), eye, poses[0][:3, 0]) if points else None
    if table is None or table.share < _TABLE_SHARE:
        if (eye[:, 2] < 0).all():
            turned = tuple(np.diag([1.0, -1.0, -1.0, 1.0]) @ pose for pose in poses)
            return _Placement(turned, None, report, ["The world was upside down and is turned."])
        return _Placement(poses, None, report, [])
    up = table.T_table_world[2, :3]
    if up[2] > _UPRIGHT:
        ground = float(np.linalg.inv(table.T_table_world)[2, 3])
        return _Placement(poses, round(ground, 4), report, [])
    if up[2] < -_UPRIGHT:
        turned = tuple(np.diag([1.0, -1.0, -1.0, 1.0]) @ pose for pose in poses)
        ground = -float(np.linalg.inv(table.T_table_world)[2, 3])
        notes = ["The world was upside down (cameras below the table) and is turned."]
        return _Placement(turned, round(ground, 4), report, notes)
    notes = ["The given world is not upright; the largest plane of the clouds becomes z = 0."]
    return _Placement(tuple(table.T_table_world @ pose for pose in poses), 0.0, report, notes)


def _alone(source: _Source) -> _Placement:
    """Place a single camera above the largest plane that it sees, else let it look straight on."""
    camera = source.camera(np.eye(4))
    if source.view.depth is not None:
        point = cloud(camera, source.depth_image(0))
        # The camera's x axis stays level; y points down in its picture.
        table = find_table(point, np.zeros((1, 3)), np.array([1.0, 0.0, 0.0]))
        is_wall = table is None or table.T_table_world[2, 1] > _WALL
        if table is not None and table.share >= _TABLE_SHARE and not is_wall:
            report = {"by": "the largest plane that the camera sees, taken for the table"}
            return _Placement((table.T_table_world,), 0.0, report, [])
    upright = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    note = (
        f"View '{source.view.name}': no table was found, so the top of the picture is taken for "
        "up, and there is no ground. Give --charuco, or T_world_camera in its intrinsics, if the "
        "camera looks down."
    )
    return _Placement((upright,), None, {"by": "the camera's own axes"}, [note])


def _check_agreement(
    sources: list[_Source],
    cameras: list[PinholeCamera],
    placement: _Placement,
    frame_count: int,
) -> dict[str, Any]:
    """Refuse a calibration, or a depth scale, that the measured surfaces contradict."""
    measured = [n for n, one in enumerate(sources) if one.view.depth is not None]
    depth = {n: sources[n].depth_image(0) for n in measured}
    report: dict[str, Any] = {}
    if placement.report["by"].startswith(BY_BOARD):
        for n in measured:
            report.update(_check_table(sources[n], cameras[n], depth[n], placement.notes))
    pairs = [(a, b) for a in measured for b in measured if a != b]
    if not pairs:
        return report
    later = {n: sources[n].depth_image(frame_count // 2) for n in measured}
    shared: dict[tuple[int, int], float] = {}
    for a, b in pairs:
        for image in (depth, later):
            whole = shared_surface(cameras[a], image[a], cameras[b], image[b])
            above = None
            # Later what stands above the table may move faster than cameras are synchronous.
            if placement.ground is not None and image is depth:
                height = placement.ground + _ABOVE
                above = shared_surface(cameras[a], image[a], cameras[b], image[b], height)
            if whole is None:
                continue
            shared[a, b] = min(whole, shared.get((a, b), 1.0))
            least = min(
                whole / _LEAST_SHARED, 1.0 if above is None else above / _LEAST_SHARED_ABOVE
            )
            if least < 1.0:
                first, second = sources[a].view.name, sources[b].view.name
                part = 100 * min(whole, 1.0 if above is None else above)
                raise ImportFailedError(
                    f"Views '{first}' and '{second}' contradict each other: only {part:.0f} % of "
                    f"what '{first}' measures lies on what '{second}' measures. The pose or the "
                    "intrinsics of one of them, or the depth scale, is wrong. Were cameras moved "
                    "after the calibration, or two intrinsics exchanged?"
                )
            report[f"{sources[a].view.name} on {sources[b].view.name}"] = round(shared[a, b], 3)
    if not shared:
        names = ", ".join(sources[n].view.name for n in measured)
        raise ImportFailedError(
            f"No two of the views {names} measure a common surface. Their poses or the depth scale "
            "are wrong, or they look at different things: check the calibration and --depth-scale."
        )
    return report


def _check_table(
    source: _Source, camera: PinholeCamera, depth: Float[ndarray, "row column"], notes: list[str]
) -> dict[str, float]:
    """Compare the table's distance by depth with its distance by the board."""
    name = source.view.name
    ratio, share = table_distance_ratio(camera, depth)
    if share < _RATIO_SHARE:
        return {}
    if not _WRONG_SCALE[0] <= ratio <= _WRONG_SCALE[1]:
        # No lens is off by more, but two may be exchanged.
        is_lens = _WRONG_LENS[0] < ratio < _WRONG_LENS[1]
        other = ", unless its intrinsics are those of another camera (were two exchanged?)"
        right = source.scale / ratio
        remedy = (
            f"give --depth-scale {right:.2g}"
            if right <= LARGEST_SCALE
            else f"multiply its images by {1 / ratio:.2g}"
        )
        fail(
            source.view.folder if source.view.depth is None else source.view.depth.path,
            f"puts the table {ratio:.3g} times as far from the camera as the board says. The depth "
            f"scale is not {source.scale:g} ({remedy}), or the board is {ratio:.3g} times as large "
            f"as was given (measure it){other if is_lens else ''}",
        )
    if not _RATIO[0] <= ratio <= _RATIO[1]:
        notes.append(
            f"View '{name}': by depth, most of what is seen is {ratio:.3g} times as far as the "
            "board's plane. Unless that is a large object, the board lay higher than the table, or "
            "its squares have another size."
        )
    return {f"table in {name}": round(ratio, 4)}


def _write(
    writer: SequenceWriter, sources: list[_Source], paired: PairedFrames, progress: Progress
) -> list[str]:
    """Write all images, frame by frame; those of an import that was stopped are kept."""
    total = len(sources) * paired.count
    done = 0
    for frame, holes in enumerate(cast("list[list[int]]", writer.checkpoints)):
        for place in holes:
            sources[place].holes.append(frame)
        done += len(sources)
        progress.report(_STAGE, done, total, None, "goes on")
    for frame in range(done // len(sources), paired.count):
        for source in sources:
            progress.check_cancelled()
            if source.view.color is not None:
                _write_color(writer, source, frame)
            if source.view.depth is not None:
                _write_depth(writer, source, frame)
            done += 1
            progress.report(_STAGE, done, total, None, source.view.name)
        holes = [place for place, one in enumerate(sources) if one.holes[-1:] == [frame]]
        writer.checkpoint(holes)
    notes: list[str] = []
    for source in sources:
        if source.holes:
            shown = ", ".join(map(str, source.holes[:5]))
            more = f" and {len(source.holes) - 5} more" if len(source.holes) > 5 else ""
            notes.append(
                f"View '{source.view.name}': depth of frame {shown}{more} holds no distance."
            )
    return notes


def _write_color(writer: SequenceWriter, source: _Source, frame: int) -> None:
    stream = source.view.color
    assert stream is not None  # noqa: S101 - asked by the caller
    assert source.color is not None  # noqa: S101
    image = source.color_image(frame)
    place = f"views/{source.view.name}/color/{frame:05d}"
    path = stream.files[int(source.color[frame])] if stream.files else None
    is_png = path is not None and path.suffix.lower() == ".png"
    if path is not None and not source.rectifier.is_changed:
        writer.copy(place + (".png" if is_png else ".jpg"), path)
    else:
        # What was lossy before stays as small as it was.
        writer.save_image(
            place + (".png" if is_png else ".jpg"),
            cv2.cvtColor(image, cv2.COLOR_BGR2RGB),
            compression=_PNG_EFFORT if is_png else None,
        )


def _write_depth(writer: SequenceWriter, source: _Source, frame: int) -> None:
    depth = source.depth_image(frame)
    if not depth.any():
        source.holes.append(frame)
    writer.save_image(
        f"views/{source.view.name}/depth/{frame:05d}.png",
        np.round(depth * 1000).astype(np.uint16),
        compression=_PNG_EFFORT,
    )
