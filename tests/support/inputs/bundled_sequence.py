"""The sequence that ships with the project: a hand pinches a towel's edge, lifts and folds it.

Everything in it is simulated. What made it (springs, noise and seed) is nowhere in its folder.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.progress import NullProgress, Progress
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.synthetic.bodies.sheets import Sheet, fold_motion, make_sheet, simulate_sheet
from physhandi.synthetic.film.filming import (
    SurfacePoints,
    is_covered,
    is_shown,
    sample_image,
    save_video,
)
from physhandi.synthetic.film.rendering import Picture, Scene, compose, look_at, paint, photograph
from physhandi.synthetic.film.sensors import DepthSensor, detect_keypoints, shift_outlines, track

FRAME_RATE = 30.0
"""Frames per second [Hz]."""
_EYES = {
    "front": np.array([0.47, 0.10, 0.40]),
    "left": np.array([0.03, 0.50, 0.38]),
    "right": np.array([-0.06, -0.52, 0.36]),
}
_TARGET = np.array([-0.030, 0.0, 0.080])
_KEPT_AROUND = 4
_BODY, _HAND = 1, 2


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How large and how fine a sequence is made."""

    frame_count: int = 60
    """Frames that the motion is stretched over."""
    size: tuple[int, int] = (320, 240)
    """Width and height of the images [px]."""
    focal_length: float = 350.0
    """Focal length of all cameras [px]."""
    spacing: float = 0.008
    """Distance between the nodes of the simulated sheet [m]."""
    substeps_per_frame: int = 1334
    """Integration steps in one frame."""
    track_count: int = 100
    """Tracks in each view."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Truth:
    """What really happens in the sequence."""

    motion: HandMotion
    """The hand."""
    control: Float[ndarray, "frame control 3"]
    """Vertices of the hand [m]."""
    sheet: Sheet
    """The sheet in frame 0, and its triangles."""
    model: SpringMassModel
    """Its springs."""
    position: Float[ndarray, "frame node 3"]
    """Nodes of the sheet [m]."""


def make_truth(seed: int = 2, recipe: Recipe | None = None) -> Truth:
    """Script the hand and simulate the sheet, finer and more uneven than a fit would.

    Args:
        seed: Decides nodes, stiffness and tremor.
        recipe: Size of the sequence; the bundled one by default.
    """
    recipe = recipe or Recipe()
    random = np.random.default_rng([seed, 1])
    hand = load_hand_model("right")
    motion = fold_motion(hand, recipe.frame_count, FRAME_RATE, random)
    sheet = make_sheet(0.20, 0.14, recipe.spacing, random)
    parameters = SimulationParameters(
        connection_radius=2.4 * recipe.spacing,
        max_neighbors=24,
        virtual_connection_radius=0.009,
        virtual_max_neighbors=4,
        stiffness=float(np.exp(random.uniform(np.log(5e3), np.log(8e3)))),
        virtual_stiffness=float(np.exp(random.uniform(np.log(0.9e4), np.log(1.6e4)))),
        damping=random.uniform(55.0, 90.0),
        drag=random.uniform(1.5, 3.0),
        restitution=random.uniform(0.1, 0.3),
        friction=random.uniform(0.4, 0.6),
        frame_rate=FRAME_RATE,
        substeps_per_frame=recipe.substeps_per_frame,
        virtual_rest_length_floor=2e-3,
    )
    control = motion.vertices(hand)
    model, position = simulate_sheet(sheet, control, parameters, random)
    return Truth(motion=motion, control=control, sheet=sheet, model=model, position=position)


def generate_bundled(
    folder: Path | str,
    *,
    seed: int = 2,
    progress: Progress | None = None,
    recipe: Recipe | None = None,
    overwrite: bool = False,
    tells_truth: bool = False,
) -> Sequence:
    """Simulate, film and write the bundled sequence; the same seed gives the same content.

    Args:
        folder: Where the sequence shall appear; the folder's name becomes its name.
        seed: Decides everything that is random.
        progress: Told after every frame of every view; may ask to stop.
        recipe: Size of the sequence; the bundled one by default.
        overwrite: Whether to replace a sequence that is there.
        tells_truth: Whether to write the true hand and contact beside it, for scoring.

    Returns:
        The finished, validated sequence.

    Raises:
        SequenceError: If the folder exists and `overwrite` is false.
        CancelledError: If the user asked to stop.
    """
    recipe, progress = recipe or Recipe(), progress or NullProgress()
    cameras = {
        name: look_at(eye, _TARGET, focal_length=recipe.focal_length, size=recipe.size)
        for name, eye in _EYES.items()
    }
    with SequenceWriter(folder, overwrite=overwrite) as writer:
        truth = make_truth(seed, recipe)
        scenes = _scenes(truth)
        for number, (name, camera) in enumerate(cameras.items()):
            random = np.random.default_rng([seed, 2, number])
            shot = _Shot(writer, f"views/{name}", camera, random)
            pictures = _film(shot, scenes, progress)
            _annotate(shot, truth, pictures, recipe.track_count)
        if tells_truth:
            _save_truth(writer, truth)
        return writer.finish(
            SequenceMeta(
                name=writer.folder.name,
                description=(
                    "A right hand pinches the edge of a 20 x 14 cm towel on a table, lifts it by "
                    "8 cm and lays it over. Simulated by this project."
                ),
                label="simulated by this project",
                frame_rate=FRAME_RATE,
                frame_count=recipe.frame_count,
                ground_height=0.0,
                hands=("right",),
                views=tuple(ViewMeta(name=n, camera=c) for n, c in cameras.items()),
                reconstruction=round(0.7 * recipe.frame_count),
                provenance={
                    "origin": "simulated by this project",
                    "license": "Apache-2.0",
                    "note": "Depth is kept around hand and object only, to keep the files small.",
                },
            )
        )


def _save_truth(writer: SequenceWriter, truth: Truth) -> None:
    """Write the hand, and where its vertices hold the sheet by virtual springs all the time."""
    model, frame_count = truth.model, truth.motion.frame_count
    held = np.zeros(model.node_count, dtype=bool)
    held[model.spring_nodes[model.object_spring_count :, 0]] = True
    keypoint = truth.motion.keypoints(load_hand_model("right"))
    writer.save_array("truth/hand_right_keypoint.npy", keypoint.astype(np.float32))
    writer.save_array("truth/hand_right_vertex.npy", truth.control.astype(np.float32))
    writer.save_array("truth/contact_point.npy", truth.sheet.node.astype(np.float32))
    writer.save_array("truth/contact.npy", np.tile(held, (frame_count, 1)))


@dataclass(frozen=True)
class _Shot:
    """Where one view is filmed from and written to."""

    writer: SequenceWriter
    folder: str
    camera: PinholeCamera
    random: Generator


def _scenes(truth: Truth) -> list[Scene]:
    faces = load_hand_model("right").faces
    pattern = truth.sheet.node[:, :2]
    return [
        compose(position, truth.sheet.faces, pattern, [(_HAND, hand.astype(np.float64), faces)])
        for position, hand in zip(truth.position, truth.control, strict=True)
    ]


def _film(shot: _Shot, scenes: list[Scene], progress: Progress) -> list[Picture]:
    """Write color, depth and masks of a view; return what a perfect camera would have seen."""
    random = shot.random
    sensor = DepthSensor()
    level, phase = random.uniform(-0.7, 0.7), random.uniform(0, 2 * np.pi)
    pictures: list[Picture] = []
    colors: list[ndarray] = []
    around = np.ones((2 * _KEPT_AROUND + 1,) * 2, dtype=np.uint8)
    for frame, scene in enumerate(scenes):
        progress.check_cancelled()
        picture = photograph(shot.camera, scene)
        offset = level + 0.3 * np.sin(phase + frame / 25.0)
        depth = sensor.measure(picture.depth, picture.cosine, random, offset=offset)
        mask = shift_outlines(picture.label, random)
        depth[cv2.dilate((mask > 0).astype(np.uint8), around) == 0] = 0
        for kind, image in (("depth", depth), ("mask", mask)):
            rel = f"{shot.folder}/{kind}/{frame:05d}.png"
            shot.writer.save_image(rel, image, compression=9)
        colors.append(paint(shot.camera, scene))
        pictures.append(picture)
        progress.report("synthesize", frame + 1, len(scenes), message=shot.folder)
    save_video(shot.writer, f"{shot.folder}/color.mp4", colors, FRAME_RATE)
    return pictures


def _annotate(shot: _Shot, truth: Truth, pictures: list[Picture], track_count: int) -> None:
    """Write what detectors and trackers would find in a view."""
    camera, random = shot.camera, shot.random
    size = (camera.width, camera.height)
    joint = truth.motion.keypoints(load_hand_model("right")).astype(np.float64)
    is_hidden = np.stack([is_covered(camera, *p) for p in zip(pictures, joint, strict=True)])
    keypoint = detect_keypoints(camera.project(joint), is_hidden, size, random)
    shot.writer.save_array(f"{shot.folder}/keypoint.npy", keypoint[:, None])

    surface = _surface_points(truth, camera, pictures[0], track_count, random)
    point = surface.at(truth.position)
    is_seen = np.stack([is_shown(camera, *p) for p in zip(pictures, point, strict=True)])
    is_seen &= surface.face_camera(truth.position, camera)
    reported, visible = track(camera.project(point), is_seen, random)
    shot.writer.save_array(f"{shot.folder}/track.npy", reported)
    shot.writer.save_array(f"{shot.folder}/track_visible.npy", visible)


def _surface_points(
    truth: Truth, camera: PinholeCamera, first: Picture, count: int, random: Generator
) -> SurfacePoints:
    """Choose sheet points that frame 0 shows."""
    faces = truth.sheet.faces
    drawn = 8 * count
    face = faces[random.integers(len(faces), size=drawn)]
    surface = SurfacePoints(face, random.dirichlet(np.ones(3), size=drawn))
    point = surface.at(truth.position[0])
    is_body = sample_image(first.label, camera.project(point)) == _BODY
    return surface.pick(np.flatnonzero(is_body & is_shown(camera, first, point))[:count])
