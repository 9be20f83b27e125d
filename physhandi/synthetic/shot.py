"""One camera of a made-up recording: what it sees when, and what is found in its pictures."""

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from numpy.random import Generator

from physhandi.data.camera import PinholeCamera
from physhandi.synthetic.cameras import Viewpoint
from physhandi.synthetic.degradations import Degradations, depth_sensor
from physhandi.synthetic.filming import SurfacePoints, is_covered, is_shown, sample_image
from physhandi.synthetic.rendering import Picture
from physhandi.synthetic.sensors import detect_keypoints, track
from physhandi.synthetic.stage import Stage, spread_points

_BODY = 1
_BIAS_PERIOD = 25.0
_KEYPOINTS_LOST = 0.01
_POOL = 3


class Shot:
    """A camera in front of a stage; `look` at every frame in turn, then ask for what was found."""

    def __init__(
        self, stage: Stage, view: Viewpoint, level: Degradations, random: Generator
    ) -> None:
        self.stage = stage
        self.view = view
        self.level = level
        self.random = random
        self.sensor = depth_sensor(level)
        self.surface = SurfacePoints(np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3)))
        """Points of the body that are followed."""
        self._bias = random.uniform(-0.7, 0.7), random.uniform(0, 2 * np.pi)
        self._is_covered: list[ndarray] = []
        self._is_seen: list[ndarray] = []

    def time(self, frame: int) -> float:
        """Give the frame, and the part of one, at which the camera takes a picture."""
        return frame + self.view.delay * self.stage.frame_rate

    def offset(self, frame: int) -> float:
        """Give the slow offset of depth as a part of its largest."""
        mean, phase = self._bias
        return mean + 0.3 * float(np.sin(phase + frame / _BIAS_PERIOD))

    def choose_tracks(self, camera: PinholeCamera, picture: Picture, count: int) -> None:
        """Follow points that the first picture shows, spread over what it shows.

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
        """Note what a picture shows.

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
        seen = is_shown(camera, picture, self.surface.at(skin))
        self._is_seen.append(seen & self.surface.face_camera(skin, camera))

    def keypoints(self) -> Float[ndarray, "frame hand 21 3"]:
        """Give what a detector finds of the hands: pixel x, pixel y and confidence."""
        camera, noise = self.view.camera, self.level.keypoint_noise
        joint = np.stack([self.stage.keypoints_at(time) for time in self._times()])
        pixel, is_hidden = camera.project(joint), np.stack(self._is_covered)
        found = [
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
        return np.stack(found, axis=1)

    def tracks(self) -> tuple[Float[ndarray, "frame point 2"], Bool[ndarray, "frame point"]]:
        """Give what a tracker finds of the points that are followed: pixels and visibility."""
        point = self._path()
        return track(
            self.view.camera.project(point),
            np.stack(self._is_seen),
            self.random,
            error=self.level.track_noise,
            wander=self.level.track_drift,
            dropout_rate=self.level.track_loss,
        )

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
        lifted = self.view.told.unproject(reported.astype(np.float64), depth)
        lifted[~visible] = np.nan
        return lifted

    def _path(self) -> Float[ndarray, "frame point 3"]:
        return np.stack([self.surface.at(self.stage.skin_at(time)) for time in self._times()])

    def _times(self) -> list[float]:
        return [self.time(frame) for frame in range(self.stage.frame_count)]
