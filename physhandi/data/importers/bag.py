"""Unpacks recordings in one file to folders: bags of ROS 1, ROS 2 and RealSense, and Record3D's."""

import json
import logging
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.child import Channel, Child, ChildEndedError, run_child
from physhandi.data.importers.phystwin_files import fail
from physhandi.data.importers.record3d import RECORD3D_SUFFIX, unpack_record3d
from physhandi.data.importers.recorded_view import (
    CALIBRATION,
    camera_folders,
    has_streams,
)
from physhandi.data.sequence_meta import LONGEST_NAME, safe_name
from physhandi.data.untrusted.image_header import MOST_PIXELS
from physhandi.data.untrusted.pickles import limit_data
from physhandi.errors import UsageError
from physhandi.progress import Progress

logger = logging.getLogger(__name__)

_STAGE = "unpack"
BAG_SUFFIXES = frozenset({".bag", ".db3", ".mcap", RECORD3D_SUFFIX})
"""Endings of recordings that are one file, and are unpacked."""
_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO, _TRANSFORM = "sensor_msgs/msg/CameraInfo", "geometry_msgs/msg/Transform"
_DEPTH_UNITS = "/option/Depth Units/value"
_CODED = {
    "rgb8": (np.uint8, 3, cv2.COLOR_RGB2BGR),
    "bgr8": (np.uint8, 3, None),
    "rgba8": (np.uint8, 4, cv2.COLOR_RGBA2BGR),
    "bgra8": (np.uint8, 4, cv2.COLOR_BGRA2BGR),
    "mono8": (np.uint8, 1, cv2.COLOR_GRAY2BGR),
    "8uc1": (np.uint8, 1, cv2.COLOR_GRAY2BGR),
    "8uc3": (np.uint8, 3, None),
}
_DEPTHS = {"16uc1": np.uint16, "mono16": np.uint16, "32fc1": np.float32}
_LEFT_OUT = re.compile(r"infra|confidence|(^|[/_])ir([/_]|$)", re.IGNORECASE)
_COMPRESSED_DEPTH_HEADER = 12
_WORKER = "physhandi.data.importers.bag"
_MEMORY = 4 << 30
"""Most memory that reading a bag may take [byte]."""
_PNG_EFFORT = 1
_LONGEST_NAME = 40
"""Letters of the name of a bag, or of a camera in it, that count."""


@dataclass(eq=False)
class _Topic:
    """A topic of images, and what goes with it."""

    name: str
    is_depth: bool
    connections: list[Any]
    count: int
    info: Any = None
    frame: str = ""
    stamps: list[int] = field(default_factory=list[int])


def find_bags(source: Path) -> list[Path]:
    """List the bags of a source: itself, those in a folder, or those in one folder for each camera.

    Those in folders count if nothing there is a camera's images: there, bags are what these were
    made of.

    Raises:
        ImportFailedError: See `has_streams`.
    """
    if source.is_file():
        return [source] if source.suffix.lower() in BAG_SUFFIXES else []
    if not source.is_dir():
        return []
    if (source / "metadata.yaml").is_file():
        return [source]
    own = _bags_in(source)
    if own:
        return own
    folders = camera_folders(source)
    inner = [bag for folder in folders for bag in _bags_in(folder)]
    return inner if inner and not any(map(has_streams, [source, *folders])) else []


def left_out_bags(source: Path) -> list[str]:
    """Say which bags are not read, though they alone are in a folder that may be a camera's."""
    if not source.is_dir():
        return []
    read = find_bags(source)
    what = "bags beside that folder" if read else "images of other cameras"
    return [
        f"{bag.relative_to(source)} is not read, because there are {what}."
        for folder in camera_folders(source)
        if folder not in read
        for bag in _bags_in(folder)
        if bag not in read and not has_streams(folder)
    ]


def _bags_in(folder: Path) -> list[Path]:
    return sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in BAG_SUFFIXES or (path / "metadata.yaml").is_file()
    )


def name_bags(source: Path, bags: list[Path]) -> list[str]:
    """Say what each bag calls its camera; nothing if there is one bag, whose topics tell.

    Args:
        source: Where the bags were found.
        bags: The bags.

    Raises:
        ImportFailedError: If two bags name theirs alike.
    """
    named: dict[str, Path] = {}
    folders = [bag.parent for bag in bags]
    for bag in bags:
        if source in {bag, bag.parent}:
            name = bag.stem if len(bags) > 1 else ""
        else:
            is_alone = folders.count(bag.parent) == 1
            name = bag.parent.name if is_alone else f"{bag.parent.name}_{bag.stem}"
        safe = safe_name(name, _LONGEST_NAME)
        other = named.setdefault(safe, bag)
        if other is not bag:
            fail(
                bag,
                f"names its camera '{safe}', as {other} does. Name each after its camera "
                f"(the first {_LONGEST_NAME} letters, digits, - and _ count), and keep one if both "
                "are one recording",
            )
    return list(named)


def unpack_bags(source: Path, bags: list[Path], folder: Path, progress: Progress) -> None:
    """Write the cameras of bags as folders with color, depth, intrinsics and times.

    Calibration pictures, poses and intrinsics that lie beside the bags go with them.

    Args:
        source: Where the bags were found.
        bags: The bags, of one clock; each may hold several cameras.
        folder: Folder to write; it must not be there yet.
        progress: Told after every image; may cancel.

    Raises:
        ImportFailedError: If a bag is broken or holds no images, or two name their cameras alike;
            names the bag and the topic.
        UsageError: If the package that reads bags is not installed.
    """
    ros = [bag for bag in bags if bag.suffix.lower() != RECORD3D_SUFFIX]
    if ros and find_spec("rosbags") is None:
        raise UsageError(
            f"Reading {ros[0].name} needs the package rosbags, which is not installed: pip "
            "install 'physhandi[capture]'."
        )
    names = name_bags(source, bags)
    folder.mkdir()
    for bag, prefix in zip(bags, names, strict=True):
        _unpack_apart(bag, folder, prefix, progress)
    if source in bags:
        return  # What lies beside a single bag may belong to anything.
    for path in source.iterdir():
        if path.suffix in {".json", ".yaml", ".yml", ".pkl"} and path.name != "metadata.yaml":
            shutil.copy(path, folder / path.name)
    if (source / CALIBRATION).is_dir():
        (folder / CALIBRATION).symlink_to((source / CALIBRATION).resolve())


def _unpack_apart(bag: Path, folder: Path, prefix: str, progress: Progress) -> None:
    """Unpack a bag in a child process with limits: what is in it may do harm to what reads it."""
    paths = [str(bag.absolute()), str(folder.absolute())]
    with Child(_WORKER, *paths, prefix, threads=1) as child:
        try:
            for message in child.messages():
                progress.check_cancelled()
                progress.report(_STAGE, message["done"], message["total"], None, message["topic"])
        except ChildEndedError as error:
            logger.debug("the reader of %s said: %s", bag, error.last_words)
            fail(bag, "crashed what reads it. It is damaged or made to do harm; record it again")


class _Told(Progress):
    """Passes on how far a child is."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel

    def report(
        self,
        stage: str,  # noqa: ARG002  # there is only one
        iteration: int,
        total: int,
        loss: float | None = None,  # noqa: ARG002
        message: str = "",
    ) -> None:
        """Tell it."""
        self._channel.tell(done=iteration, total=total, topic=message)


def _work(channel: Channel) -> None:
    """Unpack the bag that the arguments name."""
    bag, folder, prefix = channel.arguments
    limit_data(_MEMORY)
    try:
        if Path(bag).suffix.lower() == RECORD3D_SUFFIX:
            unpack_record3d(Path(bag), Path(folder) / (prefix or "view0"), _Told(channel))
        else:
            _unpack(Path(bag), Path(folder), prefix, _Told(channel))
    except MemoryError:
        fail(Path(bag), f"needs more memory than is allowed ({_MEMORY >> 20} MiB)")


def _unpack(bag: Path, folder: Path, prefix: str, progress: Progress) -> None:
    anyreader: Any = import_module("rosbags.highlevel").AnyReader
    typesys: Any = import_module("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    try:
        with anyreader([bag], default_typestore=store) as reader:
            _unpack_open(bag, reader, folder, prefix, progress)
    except (import_module("rosbags.highlevel").AnyReaderError, OSError, ValueError) as error:
        fail(bag, f"cannot be read as a bag ({error}). Its recording may not have ended properly")


def _unpack_open(bag: Path, reader: Any, folder: Path, prefix: str, progress: Progress) -> None:
    cameras = _cameras(bag, reader)
    static = _Static.read(reader)
    total = sum(topic.count for topics in cameras.values() for topic in topics)
    done = 0
    for key, topics in cameras.items():
        parts = [part for part in (prefix, key if not prefix or len(cameras) > 1 else "") if part]
        view = folder / ("_".join(parts) or "view0")[:LONGEST_NAME]
        if view.exists():
            fail(bag, f"has a camera '{view.name}', as there is one already. Rename the bag")
        view.mkdir()
        for topic in topics:
            kind = "depth" if topic.is_depth else "color"
            (view / kind).mkdir()
            for number, (connection, raw, time) in enumerate(_messages(reader, topic)):
                progress.check_cancelled()
                message = reader.deserialize(raw, connection.msgtype)
                topic.stamps.append(_stamp(message) or time)
                topic.frame = topic.frame or message.header.frame_id
                place = f"{bag}, {topic.name}, image {number}"
                _store(view / kind, number, topic, message, place)
                done += 1
                progress.report(_STAGE, done, total, None, topic.name)
            _sort_by_time(view / kind, topic)
        _write_cameras(view, topics, static)


def _messages(reader: Any, topic: _Topic) -> Iterator[tuple[Any, Any, int]]:
    for connection, time, raw in reader.messages(connections=topic.connections):
        yield connection, raw, int(time)


def _cameras(bag: Path, reader: Any) -> dict[str, list[_Topic]]:
    """Find the topics of each camera: at most one of color and one of depth."""
    cameras: dict[str, list[_Topic]] = {}
    by_topic: dict[str, list[Any]] = {}
    for connection in reader.connections:
        if connection.msgtype in {_IMAGE, _COMPRESSED} and connection.msgcount > 0:
            by_topic.setdefault(connection.topic, []).append(connection)
    infos = {c.topic: c for c in reader.connections if c.msgtype == _INFO}
    for name, connections in sorted(by_topic.items()):
        if _LEFT_OUT.search(name):
            continue
        topic = _Topic(
            name, "depth" in name.lower(), connections, sum(c.msgcount for c in connections)
        )
        topic.info = _info(reader, infos, name)
        cameras.setdefault(_camera_name(name), []).append(topic)
    if not cameras:
        names = ", ".join(sorted({c.topic for c in reader.connections})[:8]) or "none"
        fail(bag, f"has no color or depth images (sensor_msgs/Image). Its topics are {names}")
    return {key: _chosen(bag, topics) for key, topics in cameras.items()}


def _chosen(bag: Path, topics: list[_Topic]) -> list[_Topic]:
    """Keep one topic of a kind: depth that is aligned to color first, raw images before coded."""
    chosen: list[_Topic] = []
    for is_depth in (False, True):
        own = [topic for topic in topics if topic.is_depth == is_depth]
        own.sort(key=lambda t: ("align" not in t.name, "ompressed" in t.name, len(t.name)))
        if own and own[0].info is None:
            fail(bag, f"has no CameraInfo for {own[0].name}. Record camera_info too")
        chosen.extend(own[:1])
    return chosen


def _camera_name(topic: str) -> str:
    """Name the camera by what stands before the part of the topic that names the stream."""
    parts = [part for part in topic.split("/") if part]
    kind = re.compile(r"color|colour|rgb|depth|image", re.IGNORECASE)
    before: list[str] = []
    for part in parts:
        if kind.search(part):
            break
        before.append(part)
    name = "_".join(part for part in before if not part.startswith("sensor_"))
    return safe_name(name, _LONGEST_NAME)


def _info(reader: Any, infos: Mapping[str, Any], topic: str) -> Any:
    """Read the intrinsics that belong to a topic of images."""
    base = topic.rsplit("/", 1)[0]
    above = base.rsplit("/", 1)[0]
    for name in (f"{base}/camera_info", f"{above}/camera_info", f"{above}/info/camera_info"):
        if name in infos:
            for connection, _, raw in reader.messages(connections=[infos[name]]):
                return reader.deserialize(raw, connection.msgtype)
    return None


@dataclass(frozen=True, eq=False)
class _Static:
    """What a bag says once: transforms between frames, and the unit of depth."""

    T_parent_child: Mapping[str, tuple[str, Float[ndarray, "4 4"]]]
    T_stream_reference: Mapping[str, Float[ndarray, "4 4"]]
    depth_scale: float | None

    @classmethod
    def read(cls, reader: Any) -> "_Static":
        parents: dict[str, tuple[str, ndarray]] = {}
        streams: dict[str, ndarray] = {}
        scale: float | None = None
        for connection in reader.connections:
            is_stream = connection.msgtype == _TRANSFORM and "/tf/" in connection.topic
            is_tree = connection.topic.endswith("tf_static")
            is_scale = connection.topic.endswith(_DEPTH_UNITS)
            if not (is_stream or is_tree or is_scale):
                continue
            for one, _, raw in reader.messages(connections=[connection]):
                message = reader.deserialize(raw, one.msgtype)
                if is_stream:
                    streams[connection.topic.rsplit("/tf/", 1)[0]] = _matrix(message)
                elif is_scale:
                    scale = float(message.data)
                else:
                    for item in message.transforms:
                        pose = _matrix(item.transform)
                        parents[item.child_frame_id.lstrip("/")] = (
                            item.header.frame_id.lstrip("/"),
                            pose,
                        )
        return cls(parents, streams, scale)

    def between(self, color: _Topic, depth: _Topic) -> Float[ndarray, "4 4"] | None:
        """Find the transform from the depth camera to the color camera [m]."""
        # RealSense writes for each stream the transform from a common reference to the stream.
        own = [self.T_stream_reference.get(t.name.rsplit("/image/", 1)[0]) for t in (color, depth)]
        if own[0] is not None and own[1] is not None:
            return own[0] @ np.linalg.inv(own[1])
        ends = [self._to_root(topic.frame) for topic in (color, depth)]
        if ends[0] is None or ends[1] is None or ends[0][0] != ends[1][0]:
            return None
        return np.linalg.inv(ends[0][1]) @ ends[1][1]

    def _to_root(self, frame: str) -> tuple[str, ndarray] | None:
        """Climb from a frame to the topmost one: its name, and the transform to it."""
        name, pose = frame.lstrip("/"), np.eye(4)
        if name not in self.T_parent_child:
            return None
        for _ in range(len(self.T_parent_child) + 1):
            if name not in self.T_parent_child:
                return name, pose
            name, step = self.T_parent_child[name]
            pose = step @ pose
        return None  # A circle.


def _matrix(transform: Any) -> Float[ndarray, "4 4"]:
    q, t = transform.rotation, transform.translation
    x, y, z, w = np.array([q.x, q.y, q.z, q.w]) / np.linalg.norm([q.x, q.y, q.z, q.w])
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = [t.x, t.y, t.z]
    return pose


def _stamp(message: Any) -> int:
    """Read when an image was taken [ns]; 0 if the driver did not say."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _store(folder: Path, number: int, topic: _Topic, message: Any, place: str) -> None:
    path = folder / f"{number:06d}"
    if hasattr(message, "format"):
        _store_compressed(path, topic, message, place)
        return
    code = message.encoding.lower()
    width, height = int(message.width), int(message.height)
    if width * height > MOST_PIXELS or width * height < 1:
        fail(Path(place), f"announces {width}x{height} px")
    if topic.is_depth:
        kind: Any = _DEPTHS.get(code)
        channels, conversion = 1, None
    else:
        kind, channels, conversion = _CODED.get(code, (None, 0, None))
    if kind is None:
        encodings = ", ".join(_DEPTHS if topic.is_depth else _CODED)
        fail(Path(place), f"is encoded as {message.encoding!r}; known are {encodings}")
    row = width * channels * np.dtype(kind).itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if message.step < row or len(data) < height * message.step:
        fail(Path(place), f"holds {len(data)} bytes, too few for {width}x{height} px")
    rows = data[: height * message.step].reshape(height, message.step)[:, :row]
    order = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    image = np.ascontiguousarray(rows).view(order).reshape(height, width, channels).astype(kind)
    if topic.is_depth and kind is np.float32:
        np.save(path.with_suffix(".npy"), image[..., 0])
        return
    if conversion is not None:
        image = cast("ndarray", cv2.cvtColor(image, conversion))
    _write_png(path, image[..., 0] if topic.is_depth else image)


def _store_compressed(path: Path, topic: _Topic, message: Any, place: str) -> None:
    """Store a JPEG or PNG as it is; depth has a header of the plugin before its PNG."""
    data = bytes(message.data)
    if topic.is_depth and "compresseddepth" in message.format.lower():
        data = data[_COMPRESSED_DEPTH_HEADER:]
    if data.startswith(b"\x89PNG"):
        path.with_suffix(".png").write_bytes(data)
    elif data.startswith(b"\xff\xd8") and not topic.is_depth:
        path.with_suffix(".jpg").write_bytes(data)
    else:
        fail(Path(place), f"has the format {message.format!r}; JPEG and PNG are read")


def _write_png(path: Path, image: ndarray) -> None:
    options = [cv2.IMWRITE_PNG_COMPRESSION, _PNG_EFFORT]
    path.with_suffix(".png").write_bytes(
        cv2.imencode(".png", np.ascontiguousarray(image), options)[1].tobytes()
    )


def _sort_by_time(folder: Path, topic: _Topic) -> None:
    """Drop images that came twice, and write the times; bags may hold images out of order."""
    files = sorted(folder.iterdir())
    order = sorted(range(len(files)), key=lambda number: topic.stamps[number])
    numbers: list[int] = []
    for number in order:
        if numbers and topic.stamps[number] == topic.stamps[numbers[-1]]:
            files[number].unlink()
        else:
            numbers.append(number)
    for place, number in enumerate(numbers):
        files[number].rename(folder / f"t{place:06d}{files[number].suffix}")
    times = "\n".join(str(topic.stamps[number]) for number in numbers)
    (folder / "timestamps.txt").write_text(times + "\n")


def _write_cameras(view: Path, topics: list[_Topic], static: _Static) -> None:
    color = next((topic for topic in topics if not topic.is_depth), None)
    depth = next((topic for topic in topics if topic.is_depth), None)
    main = color or depth
    assert main is not None  # noqa: S101 - a camera has a topic
    table = _camera_table(main.info)
    if depth is not None:
        if static.depth_scale is not None:
            table["depth_scale"] = static.depth_scale
        elif any(view.glob("depth/*.npy")):
            table["depth_scale"] = 1.0  # As ROS prescribes: metres in floats, else millimetres.
        else:
            table["depth_scale"] = 0.001
    if color is not None and depth is not None and "align" not in depth.name:
        table["depth"] = _camera_table(depth.info)
        between = static.between(color, depth)
        if between is not None:
            table["depth_to_color"] = between.tolist()
    (view / "intrinsics.json").write_text(json.dumps(table))


def _camera_table(info: Any) -> dict[str, Any]:
    K = np.asarray(info.k if hasattr(info, "k") else info.K, dtype=np.float64)
    distortion = np.asarray(info.d if hasattr(info, "d") else info.D, dtype=np.float64)
    return {
        "K": K.reshape(3, 3).tolist(),
        "distortion": distortion.tolist(),
        "distortion_model": str(info.distortion_model),
        "width": int(info.width),
        "height": int(info.height),
    }


if __name__ == "__main__":
    run_child(_work)
