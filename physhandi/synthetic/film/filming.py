"""Tools of synthetic recordings: points on surfaces, their visibility in a picture, videos."""

import errno
import shutil
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.data.files import temporary_name
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.errors import SequenceError
from physhandi.synthetic.film.rendering import Picture

COVERED = 0.018
"""A keypoint is hidden if the visible surface is nearer to the camera by more than this [m]; the
keypoint itself lies inside the hand, below its skin."""
_SAME_SURFACE = 0.004
_LEAST_COSINE = 0.15


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points fixed on a surface of triangles."""

    corner: Int[ndarray, "point 3"]
    """Vertices of the triangle that each point lies on."""
    weight: Float[ndarray, "point 3"]
    """Barycentric weights of these vertices."""

    def __len__(self) -> int:
        return len(self.corner)

    def pick(self, chosen: ndarray) -> "SurfacePoints":
        """Keep some of the points, by number or by flag."""
        return SurfacePoints(self.corner[chosen], self.weight[chosen])

    def at(self, vertex: Float[ndarray, "*frame vertex 3"]) -> Float[ndarray, "*frame point 3"]:
        """Compute the points on the surface with these vertices [m]."""
        return np.einsum("tk,...tkd->...td", self.weight, vertex[..., self.corner, :])

    def face_camera(
        self, vertex: Float[ndarray, "*frame vertex 3"], camera: PinholeCamera
    ) -> Bool[ndarray, "*frame point"]:
        """Mark points whose triangle faces the camera, and not at a grazing angle."""
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
    """Mark the points that a picture shows, which nothing nearer covers.

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
    """Mark the keypoints of hands that something other than their own skin covers.

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
    with _folder_beside(writer) as folder:
        path = folder / "color.mp4"
        video: cv2.VideoWriter | None = None
        count = 0
        try:
            for image in images:
                if video is None:
                    video = _opened(path, (image.shape[1], image.shape[0]), frame_rate)
                    if not video.isOpened():
                        path.write_bytes(bytes(4096))  # A full disk says so here.
                        raise SequenceError(
                            f"Sequence '{writer.folder.name}': {rel} cannot be written, because "
                            "this OpenCV has no MPEG-4 encoder. Install opencv-python-headless "
                            "from PyPI."
                        )
                video.write(np.ascontiguousarray(image[..., ::-1]))
                count += 1
        finally:
            if video is not None:
                video.release()
        if video is None:
            return
        readable = _frame_count(path)
        if readable != count:  # OpenCV does not tell what the disk refused.
            raise OSError(
                errno.EIO,
                f"The video holds {readable} of {count} frames; the disk may be full. Free some "
                "space on it, or choose another folder",
                str(writer.folder / rel),
            )
        writer.copy(rel, path)


@contextmanager
def _folder_beside(writer: SequenceWriter) -> Generator[Path, None, None]:
    """Make a folder on the sequence's disk; if this process dies, the next writer removes it."""
    folder = writer.folder.with_name(temporary_name(writer.folder.name))
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _opened(path: Path, size: tuple[int, int], frame_rate: float) -> cv2.VideoWriter:
    return cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), frame_rate, size)


def _frame_count(path: Path) -> int:
    """Count the readable frames; the header states only the intended number."""
    if not path.is_file():
        return 0
    video = cv2.VideoCapture(str(path))
    count = 0
    while video.grab():
        count += 1
    video.release()
    return count
