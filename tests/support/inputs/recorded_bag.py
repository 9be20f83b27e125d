"""Writes small ROS bags of the made-up scene, as drivers publish it."""

from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from physhandi.data.camera import PinholeCamera
from support.inputs.raw_capture import picture

TREE = "tf2_msgs/msg/TFMessage"
BEGIN = 1_700_000_000_000_000_000


@cache
def store_of(ros: int) -> Any:
    """The messages of a kind of ROS; rosbags is imported where a bag is written."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    if ros == 1:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TREE))
    return store


class Recorder:
    """Messages of one bag, of either kind of ROS."""

    def __init__(self, path: Path, *, ros: int = 1, storage: str = "sqlite3") -> None:
        from rosbags import rosbag1, rosbag2

        self.store = store_of(ros)
        self.ros = ros
        if ros == 1:
            self.writer: Any = rosbag1.Writer(path)
        else:
            plugin = getattr(rosbag2.StoragePlugin, storage.upper())
            self.writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        self.connections: dict[str, Any] = {}

    def __enter__(self) -> "Recorder":
        self.writer.open()
        return self

    def __exit__(self, *error: object) -> None:
        self.writer.close()

    def kind(self, name: str) -> Any:
        return self.store.types[name]

    def write(self, topic: str, kind: str, message: Any, time: int = BEGIN) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        if self.ros == 1:
            raw = self.store.serialize_ros1(message, kind)
        else:
            raw = self.store.serialize_cdr(message, kind)
        self.writer.write(self.connections[topic], time, raw)

    def header(self, time: int, frame: str) -> Any:
        stamp = self.kind("builtin_interfaces/msg/Time")(time // 10**9, time % 10**9)
        make = self.kind("std_msgs/msg/Header")
        return make(0, stamp, frame) if self.ros == 1 else make(stamp, frame)

    def image(self, topic: str, image: np.ndarray, code: str, time: int, frame: str = "c") -> None:
        height, width = image.shape[:2]
        data = np.ascontiguousarray(image).view(np.uint8).ravel()
        name = "sensor_msgs/msg/Image"
        message = self.kind(name)(
            self.header(time, frame), height, width, code, 0, len(data) // height, data
        )
        self.write(topic, name, message, time)

    def coded(self, topic: str, data: bytes, form: str, time: int, frame: str = "c") -> None:
        name = "sensor_msgs/msg/CompressedImage"
        message = self.kind(name)(self.header(time, frame), form, np.frombuffer(data, np.uint8))
        self.write(topic, name, message, time)

    def info(self, topic: str, camera: PinholeCamera, model: str = "plumb_bob") -> None:
        name = "sensor_msgs/msg/CameraInfo"
        roi = self.kind("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
        self.write(
            topic,
            name,
            self.kind(name)(
                self.header(BEGIN, "c"),
                camera.height,
                camera.width,
                model,
                np.zeros(5),
                camera.K.ravel(),
                np.eye(3).ravel(),
                np.zeros(12),
                0,
                0,
                roi,
            ),
        )

    def transform(self, matrix: np.ndarray) -> Any:
        x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
        return self.kind("geometry_msgs/msg/Transform")(
            self.kind("geometry_msgs/msg/Vector3")(*matrix[:3, 3].tolist()),
            self.kind("geometry_msgs/msg/Quaternion")(x, y, z, w),
        )


def shown(camera: PinholeCamera, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Color (RGB) and depth [mm]."""
    color, depth = picture(camera, frame)
    return color, np.round(1000 * depth).astype(np.uint16)


def time_of(frame: int, late: int = 0) -> int:
    return BEGIN + frame * 33_333_333 + late


def write_realsense_bag(
    path: Path,
    color: PinholeCamera,
    depth: PinholeCamera,
    reference: np.ndarray,
    frames: Iterable[int],
) -> None:
    """A bag with the topics of librealsense; `reference` maps to the world, as cameras do."""
    with Recorder(path, ros=1) as bag:
        topics = {"color": "/device_0/sensor_1/Color_0", "depth": "/device_0/sensor_0/Depth_0"}
        for kind, camera in (("color", color), ("depth", depth)):
            bag.info(f"{topics[kind]}/info/camera_info", camera, "Inverse Brown Conrady")
            to_stream = camera.T_camera_world @ reference
            name = "geometry_msgs/msg/Transform"
            bag.write(f"{topics[kind]}/tf/0", name, bag.transform(to_stream))
        units = bag.kind("std_msgs/msg/Float32")(0.0001)
        bag.write("/device_0/sensor_0/option/Depth Units/value", "std_msgs/msg/Float32", units)
        for frame in frames:
            time = time_of(frame)
            image = np.round(10_000 * picture(depth, frame)[1]).astype(np.uint16)
            bag.image(f"{topics['depth']}/image/data", image, "mono16", time)
            bag.image(f"{topics['color']}/image/data", shown(color, frame)[0], "rgb8", time)
            infrared = np.zeros((4, 4), np.uint8)
            bag.image("/device_0/sensor_0/Infrared_1/image/data", infrared, "mono8", time)


def jpeg(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]))[1].tobytes()


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()
