"""Records a scene: images, keypoints and tracks of all views with their errors, and the truth.

`record` writes a sequence's files; a `Shot` is one camera with its detector and tracker.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from numpy.random import Generator

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.data.truth import ANNOTATION_FOLDER, HELD_OUT_CAMERA, HELD_OUT_FOLDER
from physhandi.perception.tracks import motion_validity
from physhandi.progress import Progress
from physhandi.synthetic.film.cameras import SIZE, Viewpoint, window_around
from physhandi.synthetic.film.degradations import Degradations, depth_sensor
from physhandi.synthetic.film.filmed_scene import FilmedScene, spread_points, surface_area
from physhandi.synthetic.film.filming import (
    SurfacePoints,
    is_covered,
    is_shown,
    sample_image,
    save_video,
)
from physhandi.synthetic.film.rendering import (
    Picture,
    Scene,
    compose,
    paint,
    photograph,
    resized,
    shadow_points,
)
from physhandi.synthetic.film.sensors import detect_keypoints, shift_outlines, track

_BODY = 1
_BIAS_PERIOD = 25.0
_KEYPOINTS_LOST = 0.01
_POOL = 3
Images = Literal["all", "none"]
"""Whether a recording has images, or only keypoints and markers."""
FILMING = "filming"
"""Name under which filming reports its progress."""
KEPT_AROUND = 8
"""Margin around body and hands outside of which depth is dropped, for small files [px]."""
TRACK_COUNT = 300
"""Most tracks of each view."""
MARKER_SPACING = 0.011
"""Distance between a view's tracked points if there are no images [m]."""
MARKER_COUNTS = 150, 800
"""Fewest and most points of a view in that case."""
VALIDATION_COUNT = 200
"""Most points whose true path is stored for scoring."""
_CROP_MARGIN = 48
_SHADOW_MARGIN = 16
_COARSE = 0.5
_EMPTY = np.zeros((0, 3))


def record(
    writer: SequenceWriter,
    stage: FilmedScene,
    views: Sequence[Viewpoint],
    level: Degradations,
    *,
    seed: int,
    images: Images,
    held_out: Sequence[Viewpoint] = (),
    exact_annotation: bool = False,
    progress: Progress,
) -> None:
    """Write all files of a recording but ``sequence.yaml``.

    Args:
        writer: Sequence that is being written.
        stage: The scene.
        views: Cameras.
        level: Levels of all errors.
        seed: Seed of all errors; those of one kind do not depend on the levels of others.
        images: ``all`` writes color, depth, masks and pixel tracks; ``none`` leaves the images out
            and writes the tracks lifted into the world as markers.
        held_out: Cameras whose color, depth and masks, without any error, are for scoring alone.
        exact_annotation: Whether to write the masks and tracks of `views` without any error, too,
            for scoring alone.
        progress: Receives a report after every frame of every view; may cancel.

    Raises:
        CancelledError: If the user asked to stop.
        OSError: If a file cannot be written.
    """
    lifted: list[ndarray] = []
    for number, view in enumerate(views):
        shot = Shot(stage, view, level, np.random.default_rng([seed, 30, number]))
        folder = f"views/{view.name}"
        counter = _Counter(progress, stage.frame_count, number, len(views) + len(held_out))
        if images == "all":
            exact = f"{ANNOTATION_FOLDER}/{view.name}" if exact_annotation else None
            colors = _film(writer, folder, shot, counter, exact)
            save_video(writer, f"{folder}/color.mp4", colors, stage.frame_rate)
            if exact is not None:
                pixel, is_seen = shot.exact_tracks()
                writer.save_array(f"{exact}/track.npy", pixel)
                writer.save_array(f"{exact}/track_visible.npy", is_seen)
            reported, visible = shot.tracks()
            writer.save_array(f"{folder}/track.npy", reported)
            writer.save_array(f"{folder}/track_visible.npy", visible)
        else:
            lifted.append(_follow(shot, counter))
        if stage.hands:
            writer.save_array(f"{folder}/keypoint.npy", shot.keypoints())
        else:
            writer.make_folder(folder)
    if lifted:
        marker = np.concatenate(lifted, axis=1)
        is_visible = np.asarray(np.isfinite(marker).all(axis=-1))
        writer.save_array("marker.npy", marker.astype(np.float32))
        writer.save_array("marker_motion_valid.npy", motion_validity(marker, is_visible))
    in_place = replace(stage, hands=tuple(hand.in_place() for hand in stage.hands))
    for number, view in enumerate(held_out, len(views)):
        folder = f"{HELD_OUT_FOLDER}/{view.name}"
        shot = Shot(in_place, view, Degradations(), np.random.default_rng([seed, 30, number]))
        counter = _Counter(progress, stage.frame_count, number, len(views) + len(held_out))
        colors = _film(writer, folder, shot, counter)
        save_video(writer, f"{folder}/color.mp4", colors, stage.frame_rate)
        writer.save_yaml(f"{folder}/{HELD_OUT_CAMERA}", view.camera.to_dict())
    _write_truth(writer, stage)
    _write_validation(writer, stage, views, seed)


class Shot:
    """One camera's view of a scene: `look` at every frame in order, then read the detections."""

    def __init__(
        self, stage: FilmedScene, view: Viewpoint, level: Degradations, random: Generator
    ) -> None:
        self.stage = stage
        self.view = view
        self.level = level
        self.random = random
        self.sensor = depth_sensor(level)
        self.scale = view.camera.width / SIZE[0]
        """Pixels of this picture in one of the width that levels in pixels are about."""
        self.surface = SurfacePoints(np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3)))
        """Points of the body that are tracked."""
        self._bias = random.uniform(-0.7, 0.7), random.uniform(0, 2 * np.pi)
        self._is_covered: list[ndarray] = []
        self._is_seen: list[ndarray] = []

    def time(self, frame: int) -> float:
        """Return the time at which the camera takes a picture, in frames."""
        return frame + self.view.delay * self.stage.frame_rate

    def offset(self, frame: int) -> float:
        """Return the slow offset of depth, from -1 to 1 of its largest value."""
        mean, phase = self._bias
        return mean + 0.3 * float(np.sin(phase + frame / _BIAS_PERIOD))

    def choose_tracks(self, camera: PinholeCamera, picture: Picture, count: int) -> None:
        """Choose points to track, spread over the surface that the first picture shows.

        Args:
            camera: What the picture was taken with.
            picture: A perfect picture of frame 0.
            count: Most points to follow.
        """
        skin = self.stage.skin_at(self.time(0))
        pool = spread_points(skin, self.stage.faces, _POOL * count, self.random)
        point = pool.at(skin)
        shown = is_shown(camera, picture, point) & pool.face_camera(skin, camera)
        shown &= sample_image(picture.label, camera.project(point)) == _BODY
        self.surface = pool.pick(np.flatnonzero(shown)[:count])

    def look(self, frame: int, camera: PinholeCamera, picture: Picture) -> None:
        """Record which keypoints and points a picture shows.

        Args:
            frame: Number of the frame.
            camera: What the picture was taken with; may see a part of what the view's does.
            picture: A perfect picture.
        """
        skin = self.stage.skin_at(self.time(frame))
        keypoint = self.stage.keypoints_at(self.time(frame))
        covered = np.zeros(keypoint.shape[:2], dtype=bool)
        for hand, joints in enumerate(keypoint):
            covered[hand] = is_covered(camera, picture, joints)
        self._is_covered.append(covered)
        is_seen = is_shown(camera, picture, self.surface.at(skin))
        self._is_seen.append(is_seen & self.surface.face_camera(skin, camera))

    def keypoints(self) -> Float[ndarray, "frame hand 21 3"]:
        """Simulate the keypoint detector: pixel x, pixel y and confidence [px]."""
        camera, noise = self.view.camera, self.scale * self.level.keypoint_noise
        joint = np.stack([self.stage.keypoints_at(time) for time in self._times()])
        pixel, is_hidden = camera.project(joint), np.stack(self._is_covered)
        keypoints = [
            detect_keypoints(
                pixel[:, hand],
                is_hidden[:, hand],
                (camera.width, camera.height),
                self.random,
                error=noise,
                loss_rate=_KEYPOINTS_LOST if noise > 0 else 0.0,
            )
            for hand in range(joint.shape[1])
        ]
        return np.stack(keypoints, axis=1)

    def tracks(self) -> tuple[Float[ndarray, "frame point 2"], Bool[ndarray, "frame point"]]:
        """Simulate the tracker: pixels and visibility of the tracked points."""
        point = self._path()
        return track(
            self.view.camera.project(point),
            np.stack(self._is_seen),
            self.random,
            error=self.scale * self.level.track_noise,
            wander=self.scale * self.level.track_drift,
            dropout_rate=self.level.track_loss,
        )

    def exact_tracks(self) -> tuple[Float[ndarray, "frame point 2"], Bool[ndarray, "frame point"]]:
        """Tell where the tracked points are in the picture, and whether they are seen."""
        pixel = self.view.camera.project(self._path())
        return pixel.astype(np.float32), np.stack(self._is_seen)

    def lifted_tracks(self) -> Float[ndarray, "frame point 3"]:
        """Lift the tracks by the depth that the camera measures [m]; NaN where not seen.

        The pose is what calibration says, so its error is in the points.
        """
        reported, visible = self.tracks()
        true_depth = self.view.camera.camera_depth(self._path())
        depth = np.stack(
            [
                self.sensor.measure_points(row, self.random, offset=self.offset(frame))
                for frame, row in enumerate(true_depth)
            ]
        )
        lifted = self.view.calibrated.unproject(reported.astype(np.float64), depth)
        lifted[~visible] = np.nan
        return lifted

    def _path(self) -> Float[ndarray, "frame point 3"]:
        return np.stack([self.surface.at(self.stage.skin_at(time)) for time in self._times()])

    def _times(self) -> list[float]:
        return [self.time(frame) for frame in range(self.stage.frame_count)]


class _Counter:
    """Reports the finished frames of all views."""

    def __init__(self, progress: Progress, frame_count: int, number: int, count: int) -> None:
        self._progress = progress
        self._before, self._total = number * frame_count, count * frame_count

    def check(self) -> None:
        self._progress.check_cancelled()

    def done(self, frame: int, name: str) -> None:
        self._progress.report(FILMING, self._before + frame + 1, self._total, message=name)


def _film(
    writer: SequenceWriter,
    folder: str,
    shot: Shot,
    counter: _Counter,
    exact: str | None = None,
) -> Iterator[UInt8[ndarray, "row column 3"]]:
    """Write depth and masks of a view frame by frame, and yield its color images.

    Masks without any error go into the folder `exact`, if it is given.
    """
    camera = shot.view.camera
    no_faces, device = _EMPTY.astype(np.int64), shot.stage.device
    background = paint(camera, compose(_EMPTY, no_faces, _EMPTY[:, :2], [], device=device))
    around = np.ones((2 * KEPT_AROUND + 1,) * 2, dtype=np.uint8)
    for frame in range(shot.stage.frame_count):
        counter.check()
        scene = shot.stage.scene_at(shot.time(frame))
        window = window_around(camera, scene.vertex, _CROP_MARGIN)
        picture = photograph(window.camera, scene)
        if frame == 0:
            shot.choose_tracks(window.camera, picture, TRACK_COUNT)
        shot.look(frame, window.camera, picture)
        depth = shot.sensor.measure(
            picture.depth, picture.cosine, shot.random, offset=shot.offset(frame), scale=shot.scale
        )
        limit = shot.scale * shot.level.mask_error
        mask = shift_outlines(picture.label, shot.random, error=limit / 2, largest=limit)
        depth[cv2.dilate((mask > 0).astype(np.uint8), around) == 0] = 0
        parts = [(f"{folder}/depth", depth), (f"{folder}/mask", mask)]
        parts += [] if exact is None else [(f"{exact}/mask", picture.label)]
        for place, part in parts:
            whole = np.zeros((camera.height, camera.width), dtype=part.dtype)
            whole[window.rows, window.columns] = part
            writer.save_image(f"{place}/{frame:05d}.png", whole)
        counter.done(frame, shot.view.name)
        yield _color(shot, scene, background)


def _color(
    shot: Shot, scene: Scene, background: UInt8[ndarray, "row column 3"]
) -> UInt8[ndarray, "row column 3"]:
    """Paint body, hands and their shadows over the empty table."""
    touched = np.concatenate([scene.vertex, shadow_points(scene.vertex)])
    window = window_around(shot.view.camera, touched, _SHADOW_MARGIN)
    image = background.copy()
    image[window.rows, window.columns] = paint(window.camera, scene)
    return image


def _follow(shot: Shot, counter: _Counter) -> Float[ndarray, "frame point 3"]:
    """Lift the tracks of a view into the world, as its images would allow [m]; NaN if not seen."""
    skin, faces = shot.stage.skin[0].astype(np.float64), shot.stage.faces
    count = int(np.clip(surface_area(skin, faces) / MARKER_SPACING**2, *MARKER_COUNTS))
    shot.surface = spread_points(skin, faces, count, shot.random)
    coarse = resized(shot.view.camera, _COARSE)
    for frame in range(shot.stage.frame_count):
        counter.check()
        scene = shot.stage.scene_at(shot.time(frame))
        window = window_around(coarse, scene.vertex, 2)
        shot.look(frame, window.camera, photograph(window.camera, scene))
        counter.done(frame, shot.view.name)
    return shot.lifted_tracks()


def _write_truth(writer: SequenceWriter, stage: FilmedScene) -> None:
    """Write the true motion of hands and body, and the true contacts."""
    for hand in stage.hands:
        writer.save_array(f"truth/hand_{hand.side}_keypoint.npy", hand.keypoint.astype(np.float32))
        writer.save_array(f"truth/hand_{hand.side}_vertex.npy", hand.vertex.astype(np.float32))
    writer.save_array("truth/contact_point.npy", stage.skin[0].astype(np.float32))
    writer.save_array("truth/contact.npy", stage.contact)
    writer.save_array("truth/object_point.npy", stage.skin.astype(np.float32))
    writer.save_array("truth/object_face.npy", stage.faces.astype(np.int32))


def _write_validation(
    writer: SequenceWriter, stage: FilmedScene, views: Sequence[Viewpoint], seed: int
) -> None:
    """Write the true paths of points that a camera sees in frame 0."""
    skin, scene = stage.skin_at(0.0), stage.scene_at(0.0)
    random = np.random.default_rng([seed, 31])
    surface = spread_points(skin, stage.faces, 2 * VALIDATION_COUNT, random)
    point, is_seen = surface.at(skin), np.zeros(len(surface), dtype=bool)
    for view in views:
        window = window_around(resized(view.camera, _COARSE), scene.vertex, 2)
        picture = photograph(window.camera, scene)
        is_seen |= is_shown(window.camera, picture, point)
    path = surface.pick(np.flatnonzero(is_seen)[:VALIDATION_COUNT]).at(
        stage.skin.astype(np.float64)
    )
    writer.save_array("validation_track.npy", path.astype(np.float32))
