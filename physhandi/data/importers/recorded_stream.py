"""One stream of a raw recording: numbered images or a video, and when each image was taken."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any, Literal, NoReturn, cast

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.arrays import read_array
from physhandi.data.importers.phystwin_files import fail, probe_video
from physhandi.data.importers.recorded_camera import read_table
from physhandi.data.untrusted.exr import (
    depth_channels,
    depth_of_picture,
    read_exr_header,
    require_exr,
)
from physhandi.data.untrusted.image_header import (
    MOST_PIXELS,
    AnnouncedImage,
    announced_image,
    is_whole,
    is_whole_video,
)
from physhandi.data.untrusted.media import media_decoder
from physhandi.errors import ImportFailedError

StreamKind = Literal["color", "depth"]
COLOR_SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
"""Endings of color images."""
DEPTH_SUFFIXES = frozenset({".png", ".npy", ".exr"})
"""Endings of depth images."""
VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mkv", ".mov", ".m4v"})
"""Endings of color videos."""
_WORDS: dict[StreamKind, str] = {
    "color": "color|colour|rgb|image|images|img",
    "depth": "depth|depths|depth_image|depth_images|depth_raw|aligned_depth|depth_aligned",
}
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_READING = re.compile(r"\d+(?:\.\d*)?(?:[eE][+-]?\d{1,2})?")
_UNITS = (1.0, 1e-3, 1e-6, 1e-9)
_SHORTEST_STEP, _LONGEST_STEP = 2e-3, 2.0
_LARGEST_TABLE = 64_000_000
_PICTURE = (
    "has {} channels, so it is a picture of depth and holds no distances. Export raw 16-bit depth"
)


@dataclass(eq=False, kw_only=True)
class RecordedStream:
    """Images of one kind that one camera took, in their order."""

    kind: StreamKind
    """Kind of the images."""
    path: Path
    """Folder of the images, or the video."""
    files: tuple[Path, ...] = ()
    """The images; none if it is a video."""
    width: int
    """Width of every image [px]."""
    height: int
    """Height of every image [px]."""
    count: int
    """Number of images; of a video, as many as its header announces."""
    number: tuple[int, ...] | None = None
    """Frame numbers in the names of the images; None if the names do not tell."""
    time: Float[ndarray, " image"] | None = None
    """When each image was taken [s]; None if that is not known."""
    time_source: str = ""
    """Source of `time`, for messages."""
    frame_rate: float | None = None
    """Frames per second that a video states [Hz]."""

    def name(self, index: int) -> str:
        """Name an image for messages."""
        return str(self.files[index]) if self.files else f"{self.path}, frame {index}"

    def check_files(self, indices: Iterable[int]) -> None:
        """Read what images announce, and whether they end where they should; nothing is decoded.

        A video that is shorter than it announces is gone through, to tell which frame is missing.

        Args:
            indices: Numbers of the images.

        Raises:
            ImportFailedError: If one of them cannot be decoded, or has another size or kind of
                numbers than it must; names the first one.
            UsageError: If a package is missing that decodes them.
        """
        for index in indices if self.files else ():
            self._check_file(self.files[index])
        if not self.files and not is_whole_video(self.path):
            self._frame(max(indices, default=0))

    def read(self, index: int) -> ndarray:
        """Decode an image: BGR color, or raw depth values. A video is best read forwards.

        Raises:
            ImportFailedError: If that is not possible, or it has another size than the first one.
            UsageError: See `check_files`.
        """
        image = self._frame(index) if not self.files else self._image(self.files[index])
        if (image.shape[1], image.shape[0]) != (self.width, self.height):
            self._refuse(
                index,
                f"is {image.shape[1]}x{image.shape[0]} px, but the images before it are "
                f"{self.width}x{self.height}. All images of a stream need one size",
            )
        return image.reshape(image.shape[:2]) if self.kind == "depth" else image

    def close(self) -> None:
        """Release the video decoder."""
        if not self.files:
            media_decoder().release(self.path)

    def _image(self, path: Path) -> ndarray:
        # Checked again: it may be another file than it was when the import began.
        announced = self._check_file(path)
        if announced.form == "NPY":
            return read_array(path)
        if announced.form == "EXR":
            image = _exr_depth(path)
        else:
            flags = cv2.IMREAD_COLOR if self.kind == "color" else cv2.IMREAD_UNCHANGED
            image = media_decoder().image(path, flags)
        if image is None:
            fail(path, "cannot be decoded; it is damaged or was cut off. Record or export it again")
        return image

    def _check_file(self, path: Path) -> AnnouncedImage:
        announced = _announced(path)
        if announced.size != (self.width, self.height):
            fail(
                path,
                f"is {announced.width}x{announced.height} px, but {self.files[0].name} is "
                f"{self.width}x{self.height}. All images of a stream need one size",
            )
        if self.kind == "depth":
            _check_depth(path, announced)
        else:
            _check_color(path, announced)
        if not is_whole(path, announced.form):
            fail(path, "was cut off: its end is missing. Record or export it again")
        return announced

    def _frame(self, index: int) -> ndarray:
        image, at = media_decoder().frame(self.path, index)
        if image is None:
            self._refuse(
                at,
                f"cannot be decoded, though the video announces {self.count} frames: it was cut "
                f"off. Export it again, or give --stop {at}",
            )
        return image

    def _refuse(self, index: int, reason: str) -> NoReturn:
        raise ImportFailedError(f"{self.name(index)}: {reason}.")


def _check_color(path: Path, announced: AnnouncedImage) -> None:
    """Refuse what a file called ``.png`` or ``.jpg`` must not hold: it would be copied as it is."""
    if announced.form not in {"PNG", "JPEG"}:
        form = "OpenEXR" if announced.form == "EXR" else ".npy"
        fail(path, f"holds {form} in spite of its name; color is PNG or JPEG. Export it again")


def _check_depth(path: Path, announced: AnnouncedImage) -> None:
    """Refuse images that hold no distances."""
    if announced.form == "EXR":
        require_exr(path)
    elif announced.channel_count != 1:
        fail(path, _PICTURE.format(announced.channel_count))
    if announced.number == np.uint8:
        fail(path, "has 8 bits a pixel, which is too coarse for distances. Export raw 16-bit depth")
    if announced.number.kind not in "uif":
        fail(path, f"holds {announced.number}; expected numbers")


def _exr_depth(path: Path) -> ndarray | None:
    """Decode depth; red, green and blue count as depth if they say the same."""
    with path.open("rb") as stream:
        names = depth_channels([*read_exr_header(stream).channels])
    image = media_decoder().exr(path, names)
    if image is None or len(names) == 1:
        return image
    depth = depth_of_picture(image)
    if depth is None:
        fail(path, _PICTURE.format(len(names)))
    return depth


def _announced(path: Path) -> AnnouncedImage:
    try:
        return announced_image(path)
    except (ValueError, OSError) as error:
        fail(path, str(error))


def image_size(path: Path) -> tuple[int, int]:
    """Read the size that an image announces [px].

    Raises:
        ImportFailedError: If it is none, is empty, or announces a size that cannot be.
    """
    return _announced(path).size


def check_picture(path: Path, size: tuple[int, int]) -> None:
    """Refuse a picture that lacks its end, or has another size than a view's images.

    Raises:
        ImportFailedError: If it does; names it.
    """
    announced = _announced(path)
    _check_color(path, announced)
    if announced.size != size:
        fail(
            path,
            f"is {announced.width}x{announced.height} px, but the view's images are {size[0]}x"
            f"{size[1]} px. Take the pictures with the same settings",
        )
    if not is_whole(path, announced.form):
        fail(path, "was cut off: its end is missing. Take or export it again")


def find_stream(folder: Path, kind: StreamKind) -> RecordedStream | None:
    """Find the images of a kind in a camera's folder: a subfolder, a video, or files side by side.

    Raises:
        ImportFailedError: If there are two candidates, or what is there cannot be read.
    """
    word = re.compile(f"(?:{_WORDS[kind]})", re.IGNORECASE)
    items = [item for item in sorted(folder.iterdir()) if word.fullmatch(item.stem)]
    folders = [item for item in items if item.is_dir()]
    is_video = [item for item in items if item.is_file() and item.suffix.lower() in VIDEO_SUFFIXES]
    if kind == "color" and not folders and not is_video:
        is_video = [
            item for item in sorted(folder.iterdir()) if item.suffix.lower() in VIDEO_SUFFIXES
        ]
    candidates = [*folders, *(is_video if kind == "color" else [])]
    if len(candidates) > 1:
        names = " and ".join(item.name for item in candidates)
        fail(folder, f"has its {kind} twice, as {names}. Keep one of them")
    if candidates and candidates[0].is_file():
        return video_stream(candidates[0])
    suffixes = COLOR_SUFFIXES if kind == "color" else DEPTH_SUFFIXES
    if candidates:
        files = _images(candidates[0], suffixes)
        if not files:
            fail(candidates[0], f"has no images ({', '.join(sorted(suffixes))})")
        return image_stream(kind, candidates[0], files)
    tag = re.compile(rf"(?:^|[._-])(?:{_WORDS[kind]})(?:$|[._-]|\d)", re.IGNORECASE)
    files = [path for path in _images(folder, suffixes) if tag.search(path.stem)]
    return image_stream(kind, folder, files) if files else None


def _images(folder: Path, suffixes: frozenset[str]) -> list[Path]:
    return [
        path
        for path in folder.iterdir()
        if path.is_file()
        and path.suffix.lower() in suffixes
        and not path.name.startswith(".")
        and not re.fullmatch(r"timestamps|.*_timestamps|timestamps_.*", path.stem.lower())
    ]


def natural_key(path: Path) -> tuple[tuple[int, int | str], ...]:
    """Key by which ``frame_10`` comes after ``frame_9``."""
    parts = re.split(r"(\d+)", path.stem.lower())
    return tuple((0, int(part)) if part.isdecimal() else (1, part) for part in parts)


def image_stream(kind: StreamKind, path: Path, files: list[Path]) -> RecordedStream:
    """Order images naturally, and read frame numbers or times from their names.

    Raises:
        ImportFailedError: If two images have the same number, or the first one cannot be read.
    """
    files = sorted(files, key=natural_key)
    width, height = image_size(files[0])
    stream = RecordedStream(
        kind=kind, path=path, files=tuple(files), width=width, height=height, count=len(files)
    )
    number_texts = [_NUMBER.findall(file.stem) for file in files]
    if not all(number_texts):
        return stream
    texts = [numbers[-1] for numbers in number_texts]
    _refuse_twice(files, texts)
    values = np.array([float(text) for text in texts])
    if _are_times(texts, values):
        order = np.argsort(values, kind="stable")
        stream.files = tuple(files[int(index)] for index in order)
        exact = [texts[int(index)] for index in order]
        stream.time = _seconds(path, exact)
        stream.time_source = f"the names of {path.name}/"
    else:
        stream.number = tuple(int(float(text)) for text in texts)
    return stream


def _refuse_twice(files: list[Path], texts: list[str]) -> None:
    seen: dict[float, Path] = {}
    for file, text in zip(files, texts, strict=True):
        other = seen.setdefault(float(text), file)
        if other is not file:
            fail(file, f"has the same frame number as {other.name}. Keep one of them")


def _are_times(texts: list[str], values: ndarray) -> bool:
    """Tell whether numbers in names are times: fractions, clock times, or long uneven steps."""
    if any("." in text for text in texts) or values.max() >= 1e8:
        return True
    step = np.diff(np.sort(values))
    return len(step) > 2 and float(np.median(step)) >= 10 and np.ptp(step) > 0


def _seconds(path: Path, texts: list[str]) -> Float[ndarray, " image"]:
    """Turn clock readings into seconds; the median step tells their unit."""
    # Nanoseconds since 1970 do not fit into a float: the first reading is taken off.
    reading = [Decimal(text) for text in texts]
    first = reading[0]
    value = np.array([float(one - first) for one in reading])
    unit = 1.0
    if len(value) > 1:
        step = float(np.median(np.abs(np.diff(value))))
        units = [one for one in _UNITS if _SHORTEST_STEP <= step * one < _LONGEST_STEP]
        if not units:
            fail(
                path,
                f"holds times that are {step:g} apart, which are neither seconds, ms, µs nor ns "
                "between the images of a video. Give seconds",
            )
        unit = units[0]
    # Clocks of different streams are compared, so what was taken off comes back.
    return float(first) * unit + value * unit


def video_stream(path: Path) -> RecordedStream:
    """Open a color video.

    Raises:
        ImportFailedError: If it cannot be decoded.
    """
    count, width, height, rate = probe_video(path)
    if count < 1 or min(width, height) < 1 or width * height > MOST_PIXELS:
        fail(
            path,
            f"cannot be decoded as a video ({count} frames of {width}x{height} px); it is damaged "
            "or was cut off. Export it again as H.264 in MP4",
        )
    return RecordedStream(
        kind="color",
        path=path,
        width=width,
        height=height,
        count=count,
        frame_rate=rate if 1.0 <= rate <= 1000.0 else None,
    )


def read_times(folder: Path, stream: RecordedStream) -> None:
    """Give a stream the times that a file beside its images states, if there is one.

    Raises:
        ImportFailedError: If it is broken, has more or fewer lines than there are images, or its
            times do not grow; names file and line.
    """
    path = _time_file(folder, stream)
    if path is None:
        return
    texts, names = _time_table(path)
    if names and stream.files:
        texts = _by_name(path, stream, dict(zip(names, texts, strict=True)))
    if len(texts) != stream.count:
        fail(
            path,
            f"has {len(texts)} times, but {stream.path.name} has {stream.count} images. There must "
            "be one for each; remove the file to pair images by number",
        )
    stream.time = _seconds(path, texts)
    stream.time_source = path.name
    back = np.flatnonzero(np.diff(stream.time) <= 0)
    if len(back):
        at = int(back[0]) + 1
        fail(
            path,
            f"goes backwards: entry {at} ({texts[at]}) is not later than entry {at - 1} "
            f"({texts[at - 1]}). Sort the images by time, or cut the recording there",
        )


def _time_file(folder: Path, stream: RecordedStream) -> Path | None:
    kind, own = stream.kind, stream.path.stem
    stems = [f"{kind}_timestamps", f"timestamps_{kind}", f"{own}_timestamps", f"timestamps_{own}"]
    if kind == "color":
        stems += ["rgb_timestamps", "timestamps_rgb"]
    inside = [stream.path / "timestamps"] if stream.path.is_dir() else []
    places = [folder / stem for stem in stems]
    if stream.path != folder:
        places.append(folder / own)  # The lists of the TUM data set: depth.txt beside depth/.
    places.append(folder / "timestamps")
    for place in [*inside, *places]:
        for suffix in (".txt", ".csv", ".json", ".npy"):
            path = place.with_name(place.name + suffix)
            if path.is_file():
                return path
    return None


def _time_table(path: Path) -> tuple[list[str], list[str]]:
    """Read times as text, and the file names that stand beside them, if any do."""
    if path.stat().st_size > _LARGEST_TABLE:
        fail(path, f"is larger than {_LARGEST_TABLE} bytes")
    if path.suffix == ".npy":
        return _time_array(path), []
    if path.suffix == ".json":
        return _time_json(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        fail(path, f"is no text: {error}")
    rows: list[list[str]] = []
    names: list[str] = []
    for number, line in enumerate(lines, 1):
        fields = [part for part in re.split(r"[\s,;]+", line.partition("#")[0].strip()) if part]
        readings = [part for part in fields if _READING.fullmatch(part)]
        if fields and not readings and rows:
            fail(path, f"line {number} holds no time: {line[:60]!r}")
        if readings:  # Or it is the heading of a table.
            rows.append(readings)
            names.extend(part for part in fields if not _READING.fullmatch(part))
    columns = list(zip(*rows, strict=False))
    counted = [tuple(map(str, range(start, start + len(rows)))) for start in (0, 1)]
    clocks = [list(column) for column in columns if len(columns) == 1 or column not in counted]
    return clocks[-1] if clocks else [], names if len(names) == len(rows) else []


def _time_array(path: Path) -> list[str]:
    try:
        value = read_array(path).ravel()
    except (ValueError, OSError) as error:
        fail(path, f"is not a readable .npy file: {error}")
    if value.dtype.kind not in "uif" or not np.isfinite(value).all() or (value < 0).any():
        fail(path, "holds something else than finite times from 0 on")
    return [str(item) if value.dtype.kind != "f" else f"{item:.9f}" for item in value.tolist()]


def _time_json(path: Path) -> tuple[list[str], list[str]]:
    table = read_table(path)
    if isinstance(table, list):
        return [_time_text(path, value) for value in cast("list[Any]", table)], []
    if not isinstance(table, dict):
        fail(path, "holds no times; expected a list, or a time for each image's name")
    fields = cast("dict[Any, Any]", table)
    return [_time_text(path, value) for value in fields.values()], [str(name) for name in fields]


def _time_text(path: Path, value: Any) -> str:
    if type(value) not in (int, float) or not np.isfinite(value) or value < 0:
        fail(path, f"holds {value!r}; expected finite times from 0 on")
    return str(value) if type(value) is int else f"{value:.9f}"


def _by_name(path: Path, stream: RecordedStream, table: Mapping[str, str]) -> list[str]:
    """Order times as the images that they name."""
    times = {Path(name).stem: text for name, text in table.items()}
    for file in stream.files:
        if file.stem not in times:
            fail(path, f"has no time for {file.name}. Add it, or remove the image")
    return [times[file.stem] for file in stream.files]
