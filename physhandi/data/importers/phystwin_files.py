"""Reads the files of a PhysTwin case and checks types, shapes and plausible values."""

import json
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, cast

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16
from numpy import ndarray

from physhandi.data.arrays import read_array
from physhandi.data.camera import PinholeCamera
from physhandi.data.length_unit import FARTHEST_POSITION as FARTHEST
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.data.untrusted.image_header import announced_size, video_size
from physhandi.data.untrusted.media import media_decoder
from physhandi.data.untrusted.pickles import read_untrusted
from physhandi.errors import ImportFailedError

_UNIT = "That looks like millimetres. Convert it to metres"
_LARGEST_JSON = 64_000_000
PHYSTWIN_FRAME_RATE = 30.0
"""PhysTwin's frame rate, for cases whose ``metadata.json`` does not say another one [Hz]."""
_RECONSTRUCTED = 0.7
_LARGEST_ARCHIVE = 2 << 30
CONTROLLER = "hand"
"""Label of the masks that move the object; there may be several."""
OBJECT_MASK, FIRST_HAND_MASK, OTHER_HAND_MASK = 1, 2, 3


@dataclass(frozen=True, eq=False, kw_only=True)
class CaseMotion:
    """Content of ``final_data.pkl``."""

    point: Float[ndarray, "frame point 3"]
    """Tracked object points [m]; NaN where not visible."""
    is_motion_valid: Bool[ndarray, "frame point"]
    """Whether the motion *from the frame before* can be trusted; PhysTwin stores it one earlier."""
    node: Float[ndarray, "node 3"]
    """Object nodes at frame 0: tracked points, then surface points, then interior points [m]."""
    surface_node_count: int
    """Number of leading nodes that are tracked points or surface points."""
    control: Float[ndarray, "frame control 3"]
    """Controller points [m]."""


@dataclass(frozen=True, kw_only=True)
class CaseMetadata:
    """Content of ``metadata.json``."""

    intrinsics: tuple[Float[ndarray, "3 3"], ...]
    """Intrinsic matrix of each camera [px]."""
    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    frame_rate: float
    """Frames per second [Hz]."""
    frame_count: int | None
    """Number of synchronised frames; None if the file does not say."""
    is_raw: bool
    """Whether this is the recorder's own file, of streams that nobody has synchronised."""
    serial_numbers: tuple[str, ...]
    """Serial number of each camera."""


@dataclass(frozen=True)
class CaseImages:
    """Paths of the images of one camera; None for what is missing."""

    case: Path
    camera: int
    frame_count: int
    width: int
    height: int

    @property
    def color(self) -> Path | None:
        """Folder of color images, else a video."""
        return self._existing(f"color/{self.camera}") or self._existing(f"color/{self.camera}.mp4")

    @property
    def depth(self) -> Path | None:
        """Folder of depth images."""
        return self._existing(f"depth/{self.camera}")

    @property
    def mask(self) -> Path | None:
        """Folder of masks, one folder an object."""
        return self._existing(f"mask/{self.camera}")

    @property
    def tracks(self) -> Path | None:
        """File of pixel tracks."""
        return self._existing(f"cotracker/{self.camera}.npz")

    def frame(self, folder: Path, frame: int, suffix: str) -> Path:
        """Return the file of a frame.

        Raises:
            ImportFailedError: If it is not there.
        """
        path = folder / f"{frame}{suffix}"
        if not path.is_file():
            last = self.frame_count - 1
            fail(path, f"is missing; the case has frames 0 to {last} ('{frame}{suffix}', no zeros)")
        return path

    def check_frame_count(self, folder: Path, suffix: str) -> None:
        """Refuse a folder with frames beyond the last one, which is not synchronised."""
        extra = sorted(
            int(path.stem)
            for path in folder.glob(f"*{suffix}")
            if path.stem.isdecimal() and int(path.stem) >= self.frame_count
        )
        if extra:
            fail(
                folder / f"{extra[0]}{suffix}",
                f"is frame {extra[0]}, but the case has {self.frame_count} frames (from 0 on). "
                "Synchronise the cameras and number their frames alike",
            )

    def check_size(self, path: Path, image: ndarray) -> None:
        """Refuse an image of another size than ``metadata.json`` says."""
        height, width = image.shape[:2]
        if (width, height) != (self.width, self.height):
            fail(
                path,
                f"is {width}x{height} px, but WH in metadata.json is {self.width}x{self.height}",
            )

    def _existing(self, rel: str) -> Path | None:
        path = self.case / rel
        return path if path.exists() else None


class MaskSource:
    """Labels of one camera's pixels, from per-object masks or from PhysTwin's cleaned ones."""

    def __init__(self, images: CaseImages, cleaned: Any | None) -> None:
        """Read the labels of the masks.

        Args:
            images: The camera.
            cleaned: Content of ``processed_masks.pkl``, used where there are no masks per object.

        Raises:
            ImportFailedError: If the labels do not name exactly one object.
        """
        self._images = images
        self._cleaned = cleaned
        self._labels: list[tuple[Path, int]] = []
        if images.mask is not None:
            self._labels = _read_labels(images)

    def label(self, frame: int) -> UInt8[ndarray, "row column"]:
        """Compose the labels of a frame; a hand covers the object where both claim a pixel."""
        label = np.zeros((self._images.height, self._images.width), np.uint8)
        for folder, value in self._labels:
            label[self._read(folder, frame)] = value
        if self._cleaned is not None:
            for field, value in (("object", OBJECT_MASK), ("controller", FIRST_HAND_MASK)):
                label[self._read_cleaned(field, frame)] = value
        return label

    def _read(self, folder: Path, frame: int) -> Bool[ndarray, "row column"]:
        path = self._images.frame(folder, frame, ".png")
        image = read_image(path, cv2.IMREAD_UNCHANGED)
        if image.dtype != np.uint8 or image.ndim != 2:
            fail(path, f"is {image.dtype}{image.shape}; expected an 8-bit grey mask, 0 or 255")
        self._images.check_size(path, image)
        is_set = np.asarray(image == 255)
        if not (is_set | (image == 0)).all():
            fail(path, "has other values than 0 and 255. Threshold the mask")
        return is_set

    def _read_cleaned(self, field: str, frame: int) -> Bool[ndarray, "row column"]:
        path = self._images.case / "mask/processed_masks.pkl"
        where = f"frame {frame}, camera {self._images.camera}"
        masks = _entry(_entry(self._cleaned, frame), self._images.camera)
        if not isinstance(masks, dict):
            fail(path, f"{where} is missing; expected a mask for every frame and camera")
        shape = (self._images.height, self._images.width)
        table = {f"{where}, {key}": value for key, value in named(path, masks).items()}
        return flags(path, table, f"{where}, {field}", shape)


def _read_labels(images: CaseImages) -> list[tuple[Path, int]]:
    """List the mask folders with their labels, the object's first, then the hands' by number."""
    path = images.case / f"mask/mask_info_{images.camera}.json"
    names = read_foreign_json(path)
    wrong = [
        key for key, label in names.items() if not (key.isdecimal() and isinstance(label, str))
    ]
    if wrong:
        fail(path, f"field {wrong[0]!r} is {names[wrong[0]]!r}; expected labels by mask number")
    order = sorted(names, key=int)
    objects = [number for number in order if names[number] != CONTROLLER]
    if len(objects) != 1:
        listing = ", ".join(f"{number}: {names[number]!r}" for number in objects) or "none"
        fail(
            path,
            f"must label exactly one mask with the object's name beside '{CONTROLLER}', found "
            f"{listing}. Merge or remove masks",
        )
    hands = [number for number in order if number not in objects]
    labels = [OBJECT_MASK, FIRST_HAND_MASK, *[OTHER_HAND_MASK] * len(hands)]
    folder = images.case / f"mask/{images.camera}"
    return [
        (folder / number, label) for number, label in zip(objects + hands, labels, strict=False)
    ]


def _entry(container: Any, index: int) -> Any:
    """Look up a frame or camera in a list or in a dict, whose keys may be numbers or text."""
    if isinstance(container, list | tuple):
        items = cast("list[Any]", container)
        return items[index] if index < len(items) else None
    if isinstance(container, dict):
        table = cast("dict[Any, Any]", container)
        return table.get(index, table.get(str(index)))
    return None


def read_cleaned_masks(case: Path) -> Any | None:
    """Read ``processed_masks.pkl``, or None if there is none."""
    path = case / "mask/processed_masks.pkl"
    return read_untrusted(path) if path.is_file() else None


def read_motion(path: Path) -> CaseMotion:
    """Read ``final_data.pkl``.

    Invisible samples are stored as the literal point (0, 0, 0) and become NaN. The flag of motion
    t → t+1 at entry t becomes that of t-1 → t.

    Raises:
        ImportFailedError: If a field is missing, has a wrong shape or holds impossible values.
    """
    table = named(path, read_untrusted(path))
    point = numbers(path, table, "object_points", ("frame", "point", 3))
    frame_count, point_count, _ = point.shape
    is_visible = flags(path, table, "object_visibilities", (frame_count, point_count))
    is_valid_next = flags(path, table, "object_motions_valid", (frame_count, point_count))
    control = numbers(path, table, "controller_points", (frame_count, "controller", 3))
    surface = optional_points(path, table, "surface_points")
    interior = optional_points(path, table, "interior_points")
    if 0 in (point.size, control.size):
        fail(path, f"object_points {point.shape} or controller_points {control.shape} is empty")
    is_valid = _shifted(path, is_valid_next, is_visible)
    # The points of frame 0 are the object's nodes, whether they are called visible or not.
    check_points(path, "object_points", point[:1])
    check_points(path, "object_points", point, is_visible)
    check_points(path, "controller_points", control)
    check_points(path, "surface_points", surface[None])
    check_points(path, "interior_points", interior[None])
    return CaseMotion(
        point=np.where(is_visible[..., None], point, np.nan),
        is_motion_valid=is_valid,
        node=np.concatenate([point[0], surface, interior]),
        surface_node_count=point_count + len(surface),
        control=control,
    )


def _shifted(path: Path, is_valid_next: ndarray, is_visible: ndarray) -> Bool[ndarray, "frame _"]:
    """Shift the flag of a motion from the frame where it starts to the one where it ends."""
    is_seen = np.zeros_like(is_visible)
    is_seen[:-1] = is_visible[1:] & is_visible[:-1]
    wrong = np.argwhere(is_valid_next & ~is_seen)
    if wrong.size:
        frame, point = wrong[0]
        fail(
            path,
            f"object_motions_valid: frame {frame}, point {point} trusts the motion to frame "
            f"{frame + 1}, but object_visibilities does not show the point in both",
        )
    is_valid = np.zeros_like(is_valid_next)
    is_valid[1:] = is_valid_next[:-1]
    return is_valid


def read_validation(path: Path, frame_count: int) -> Float[ndarray, "frame validation 3"]:
    """Read ``gt_track_3d.pkl``: hand-annotated points [m], NaN where there is no annotation."""
    table = {"content": read_untrusted(path)}
    point = numbers(path, table, "content", (frame_count, "track", 3))
    check_points(path, "content", point, np.asarray(~np.isnan(point).any(axis=-1)))
    return point


def read_metadata(path: Path) -> CaseMetadata:
    """Read ``metadata.json``.

    Raises:
        ImportFailedError: If it is no JSON, or a field is missing or wrong.
    """
    table = read_foreign_json(path)
    for field in ("intrinsics", "WH"):
        if field not in table:
            fail(path, f"field '{field}' is missing. It is needed to place images; add it")
    K = numbers(path, table, "intrinsics", ("camera", 3, 3))
    size = numbers(path, table, "WH", (2,))
    if not (size > 0).all() or (size != np.floor(size)).any():
        fail(path, f"WH is {table['WH']!r}; expected image width and height in pixels")
    rate, count = table.get("fps", PHYSTWIN_FRAME_RATE), table.get("frame_num")
    if type(rate) not in (int, float) or not 1.0 <= rate <= 1000.0:
        fail(path, f"fps is {rate!r}; expected frames per second from 1 to 1000")
    if count is not None and (type(count) is not int or count < 1):
        fail(path, f"frame_num is {count!r}; expected the number of synchronised frames")
    serials: Any = table.get("serial_numbers", [])
    if not isinstance(serials, list) or len(cast("list[Any]", serials)) not in (0, len(K)):
        fail(path, f"serial_numbers is {serials!r}; expected {len(K)}, as there are intrinsics")
    return CaseMetadata(
        intrinsics=tuple(K),
        width=int(size[0]),
        height=int(size[1]),
        frame_rate=float(rate),
        frame_count=count,
        is_raw="recording" in table and count is None,
        serial_numbers=tuple(str(serial) for serial in cast("list[Any]", serials)),
    )


def read_poses(path: Path) -> Float[ndarray, "camera 4 4"]:
    """Read ``calibrate.pkl``, a list of matrices from camera to world coordinates [m].

    Raises:
        ImportFailedError: If it is missing or holds something else.
    """
    pose = numbers(path, {"content": read_untrusted(path)}, "content", ("camera", 4, 4))
    far = np.argwhere(~(np.abs(pose).max(axis=(1, 2)) <= FARTHEST))
    if far.size:
        fail(path, f"camera {far[0, 0]} is not finite or farther than {FARTHEST:g} m. Use metres")
    return pose


def join_cameras(
    path: Path, pose: Float[ndarray, "camera 4 4"], metadata: CaseMetadata
) -> tuple[PinholeCamera, ...]:
    """Join the poses that were read from `path` with the intrinsics of ``metadata.json``.

    Raises:
        ImportFailedError: If a pose is not rigid, or there are more or fewer poses than intrinsics.
    """
    if len(pose) != len(metadata.intrinsics):
        fail(
            path,
            f"has {len(pose)} cameras, but metadata.json has {len(metadata.intrinsics)} "
            "intrinsics; both must list every camera, in the same order",
        )
    cameras: list[PinholeCamera] = []
    for number, (T_world_camera, K) in enumerate(zip(pose, metadata.intrinsics, strict=True)):
        try:
            cameras.append(PinholeCamera(K, T_world_camera, metadata.width, metadata.height))
        except ValueError as error:
            fail(path, f"camera {number} (with the intrinsics of metadata.json): {error}")
    return tuple(cameras)


def read_phystwin_split(path: Path, frame_count: int) -> int:
    """Read how many leading frames are fitted; without the file, PhysTwin's 70 per cent.

    Raises:
        ImportFailedError: If the parts are not [0, k] and [k, frame_count].
    """
    if not path.is_file():
        return max(1, math.floor(_RECONSTRUCTED * frame_count))
    table = read_foreign_json(path)
    if table.get("frame_len") != frame_count:
        fail(path, f"frame_len is {table.get('frame_len')!r}, but there are {frame_count} frames")
    train, test = _interval(table.get("train")), _interval(table.get("test", table.get("train")))
    end = train[1]
    is_whole = train[0] == 0 and 1 <= end <= frame_count
    if not is_whole or ("test" in table and test != (end, frame_count)):
        fail(
            path,
            f"train is {table.get('train')!r} and test is {table.get('test')!r}; expected [0, k] "
            f"and [k, {frame_count}]",
        )
    return end


def _interval(value: Any) -> tuple[int, int]:
    """Take two whole numbers; anything else is the impossible interval (-1, -1)."""
    pair = cast("list[Any]", value) if isinstance(value, list) else []
    is_interval = len(pair) == 2 and all(type(end) is int for end in pair)
    return (pair[0], pair[1]) if is_interval else (-1, -1)


def copy_color(images: CaseImages, frame: int, writer: SequenceWriter, view: str) -> None:
    """Copy the color image of a frame, or with frame 0 the whole video.

    Raises:
        ImportFailedError: If it is missing, unreadable or of another size or length.
    """
    source = images.color
    if source is None:
        return
    if source.is_dir():
        path = images.frame(source, frame, ".png")
        images.check_size(path, read_image(path, cv2.IMREAD_COLOR))
        writer.copy(f"views/{view}/color/{frame:05d}.png", path)
    elif frame == 0:
        _check_video(source, images)
        writer.copy(f"views/{view}/color.mp4", source)


def probe_video(path: Path) -> tuple[int, int, int, float]:
    """Ask a video's decoder for its frame count, width, height [px] and frame rate [Hz].

    What cannot be decoded has a count of 0.

    Raises:
        ImportFailedError: If it is too large to be decoded, or cannot be read.
    """
    try:
        video_size(path)  # Refuses what is too large before a decoder sees it.
    except (ValueError, OSError) as error:
        fail(path, str(error))
    return media_decoder().probe(path)


def _check_video(path: Path, images: CaseImages) -> None:
    count, width, height, _ = probe_video(path)
    if count != images.frame_count:
        fail(path, f"has {count} frames, but the case has {images.frame_count}")
    images.check_size(path, np.empty((height, width)))


def copy_depth(images: CaseImages, frame: int, writer: SequenceWriter, view: str) -> None:
    """Convert the depth array of a frame to a 16-bit image; both are in millimetres.

    Raises:
        ImportFailedError: If it is missing or holds something else.
    """
    if images.depth is None:
        return
    path = images.frame(images.depth, frame, ".npy")
    try:
        depth: UInt16[ndarray, "row column"] = read_array(path)
    except (ValueError, OSError) as error:
        fail(path, f"is not a readable .npy file: {error}")
    if depth.dtype != np.uint16 or depth.ndim != 2:
        fail(path, f"holds {depth.dtype}{depth.shape}; expected uint16 millimetres (row, column)")
    images.check_size(path, depth)
    writer.save_image(f"views/{view}/depth/{frame:05d}.png", depth)


def copy_tracks(images: CaseImages, writer: SequenceWriter, view: str) -> None:
    """Copy CoTracker's tracks; PhysTwin stores them as (row, column), we as pixel x and y.

    Raises:
        ImportFailedError: If the file is broken, or a visible track is not finite.
    """
    path = images.tracks
    if path is None:
        return
    table = _archive(path)
    shape = (images.frame_count, "track", 2)
    track: Float[ndarray, "frame track 2"] = numbers(path, table, "tracks", shape)[..., ::-1]
    visible = flags(path, table, "visibility", track.shape[:2])
    lost = np.argwhere(visible & ~np.isfinite(track).all(axis=-1))
    if lost.size:
        frame, number = lost[0]
        fail(path, f"tracks: frame {frame}, track {number} is not finite, but called visible")
    # Invisible tracks may be anywhere, also at infinity.
    track = np.where(np.isfinite(track), track, np.nan)
    writer.save_array(f"views/{view}/track.npy", track.astype(np.float32))
    writer.save_array(f"views/{view}/track_visible.npy", visible)


def _archive(path: Path) -> Mapping[str, Any]:
    """Read an ``.npz`` of plain arrays."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > _LARGEST_ARCHIVE:
            fail(path, f"unpacks to {size} bytes; at most {_LARGEST_ARCHIVE} are read")
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        fail(path, f"is not a readable .npz of plain arrays: {error}")


def read_image(path: Path, mode: int) -> ndarray:
    """Decode an image.

    Raises:
        ImportFailedError: If that is not possible.
    """
    try:
        announced_size(path)  # Refuses what is too large before it is decoded.
    except (ValueError, OSError) as error:
        fail(path, f"cannot be decoded as an image: it {error}")
    image = media_decoder().image(path, mode)
    if image is None:
        fail(path, "cannot be decoded as an image")
    return image


def fail(path: Path, reason: str) -> NoReturn:
    """Refuse a file; the message is the file's name and `reason`."""
    raise ImportFailedError(f"{path}: {reason}.")


def read_foreign_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds named fields.

    Raises:
        ImportFailedError: If it does not.
    """
    try:
        if path.stat().st_size > _LARGEST_JSON:
            fail(path, f"is larger than {_LARGEST_JSON} bytes")
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        reason = "is missing" if isinstance(error, FileNotFoundError) else f"is no JSON: {error}"
        raise ImportFailedError(f"{path}: {reason}.") from error
    return named(path, content)


def named(path: Path, content: Any) -> dict[str, Any]:
    """Check that content is a dictionary of named fields.

    Raises:
        ImportFailedError: If it is something else.
    """
    if not isinstance(content, dict):
        fail(path, f"holds {type(content).__name__}; expected named fields")
    return cast("dict[str, Any]", content)


def numbers(
    path: Path, table: Mapping[str, Any], field: str, axes: tuple[str | int, ...]
) -> Float[ndarray, "*axis"]:
    """Read a field as float64 numbers.

    Args:
        path: File that the field is from, for messages.
        table: The file's fields.
        field: Name of the field.
        axes: Size of each axis, or a name for an arbitrary size.

    Raises:
        ImportFailedError: If it is missing or something else.
    """
    return _array(path, table, field, axes, "fiu").astype(np.float64)


def optional_points(path: Path, table: Mapping[str, Any], field: str) -> Float[ndarray, "point 3"]:
    """Read a field as points; none if it is missing or empty."""
    if np.size(table.get(field, ())) == 0:
        return np.zeros((0, 3))
    return numbers(path, table, field, ("point", 3))


def flags(
    path: Path, table: Mapping[str, Any], field: str, axes: tuple[str | int, ...]
) -> Bool[ndarray, "*axis"]:
    """Read a field as booleans; the numbers 0 and 1 are accepted.

    Raises:
        ImportFailedError: If it is missing or something else.
    """
    value = _array(path, table, field, axes, "bfiu")
    if not np.isin(value, (0, 1)).all():
        fail(path, f"{field} holds other values than true and false")
    return value.astype(np.bool_)


def check_points(
    path: Path,
    field: str,
    point: Float[ndarray, "frame point 3"],
    is_visible: Bool[ndarray, "frame point"] | None = None,
) -> None:
    """Check that visible points are finite, near, and not (0, 0, 0), PhysTwin's mark for invisible.

    Raises:
        ImportFailedError: At the first one that is not; names frame and point.
    """
    for is_wrong, remedy in (
        (~np.isfinite(point).all(axis=-1), "Repair it, or mark it as not visible"),
        (~point.any(axis=-1), "That stands for 'not visible', but it is not marked so"),
        (np.abs(np.nan_to_num(point)).max(axis=-1, initial=0.0) > FARTHEST, _UNIT),
    ):
        place = np.argwhere(is_wrong if is_visible is None else is_wrong & is_visible)
        if place.size:
            frame, number = place[0]
            value = point[frame, number].tolist()
            fail(path, f"{field}: frame {frame}, point {number} is {value}. {remedy}")


def _array(
    path: Path, table: Mapping[str, Any], field: str, axes: tuple[str | int, ...], kinds: str
) -> ndarray:
    text = "(" + ", ".join(map(str, axes)) + ")"
    if field not in table:
        names = ", ".join(map(str, table)) or "none"
        fail(path, f"field '{field}' {text} is missing; it has the fields {names}")
    try:
        value = np.asarray(table[field])
    except ValueError:
        fail(path, f"{field} is ragged; expected numbers {text}")
    if value.dtype.kind not in kinds:
        fail(path, f"{field} holds {value.dtype}; expected numbers {text}")
    fits = value.ndim == len(axes) and all(
        isinstance(axis, str) or size == axis for size, axis in zip(value.shape, axes, strict=True)
    )
    if not fits:
        fail(path, f"{field} has shape {value.shape}; expected {text}")
    return value
