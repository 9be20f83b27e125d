"""What all made-up recordings share: points on surfaces, what a picture shows of them, videos."""

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.errors import SequenceError
from physhandi.synthetic.rendering import Picture

COVERED = 0.018
"""A keypoint is hidden if something is nearer to the camera by more than this; it lies within the
hand, under skin that does not count [m]."""
_SAME_SURFACE = 0.004
_LEAST_COSINE = 0.15


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points that stick to a surface of triangles."""

    corner: Int[ndarray, "point 3"]
    """Vertices of the triangle that each point lies on."""
    weight: Float[ndarray, "point 3"]
    """How much each of these vertices counts."""

    def __len__(self) -> int:
        return len(self.corner)

    def pick(self, chosen: ndarray) -> "SurfacePoints":
        """Keep some of the points, by number or by flag."""
        return SurfacePoints(self.corner[chosen], self.weight[chosen])

    def at(self, vertex: Float[ndarray, "*frame vertex 3"]) -> Float[ndarray, "*frame point 3"]:
        """Find the points where the surface is now [m]."""
        return np.einsum("tk,...tkd->...td", self.weight, vertex[..., self.corner, :])

    def face_camera(
        self, vertex: Float[ndarray, "*frame vertex 3"], camera: PinholeCamera
    ) -> Bool[ndarray, "*frame point"]:
        """Tell whether a camera is on the outside of the triangle, and not at a grazing angle."""
        a, b, c = (vertex[..., self.corner[:, number], :] for number in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        sight = camera.T_world_camera[:3, 3] - self.at(vertex)
        sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
        return np.einsum("...d,...d->...", normal, sight) > _LEAST_COSINE


def sample_image(image: ndarray, pixel: Float[ndarray, "point 2"]) -> ndarray:
    """Read an image at the nearest pixels; 0 outside of it."""
    row_count, column_count = image.shape
    place = np.nan_to_num(pixel, nan=-10).round().astype(np.int64)
    inside = (place >= 0).all(axis=1)
    inside &= (place[:, 0] < column_count) & (place[:, 1] < row_count)
    place[~inside] = 0
    return np.where(inside, image[place[:, 1], place[:, 0]], 0)


def is_shown(
    camera: PinholeCamera, picture: Picture, point: Float[ndarray, "point 3"]
) -> Bool[ndarray, " point"]:
    """Tell which points are the nearest thing that a picture shows at their place.

    Args:
        camera: What the picture was taken with.
        picture: A perfect picture.
        point: Points of surfaces [m].
    """
    depth = sample_image(picture.depth, camera.project(point))
    return np.abs(depth - camera.camera_depth(point)) < _SAME_SURFACE


def is_covered(
    camera: PinholeCamera, picture: Picture, keypoint: Float[ndarray, "keypoint 3"]
) -> Bool[ndarray, " keypoint"]:
    """Tell which keypoints of hands are behind something else than their own skin.

    Args:
        camera: What the picture was taken with.
        picture: A perfect picture.
        keypoint: Keypoints [m].
    """
    depth = sample_image(picture.depth, camera.project(keypoint))
    return depth < camera.camera_depth(keypoint) - COVERED


def save_video(
    writer: SequenceWriter,
    rel: str,
    images: Iterable[UInt8[ndarray, "row column 3"]],
    frame_rate: float,
) -> None:
    """Store RGB images as an MP4 video.

    Args:
        writer: Sequence that is being written.
        rel: File inside of it.
        images: Frames, all of one size; taken one by one.
        frame_rate: Frames per second [Hz].

    Raises:
        SequenceError: If this OpenCV cannot write videos.
        OSError: If the disk does not take it.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "color.mp4"
        video: cv2.VideoWriter | None = None
        for image in images:
            if video is None:
                codec = cv2.VideoWriter.fourcc(*"mp4v")
                size = (image.shape[1], image.shape[0])
                video = cv2.VideoWriter(str(path), codec, frame_rate, size)
                if not video.isOpened():
                    raise SequenceError(
                        f"Sequence '{writer.folder.name}': {rel} cannot be written, because this "
                        "OpenCV has no MPEG-4 encoder. Install opencv-python-headless from PyPI."
                    )
            video.write(np.ascontiguousarray(image[..., ::-1]))
        if video is not None:
            video.release()
            writer.copy(rel, path)
