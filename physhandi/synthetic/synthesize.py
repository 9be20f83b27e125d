"""SynthHDI's generator: synthesizes sequences with another physics engine and hand model."""

import logging
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import cast, get_args

import numpy as np

from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SIDES, SequenceMeta, Side
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.errors import UsageError
from physhandi.progress import NullProgress, Progress
from physhandi.synthetic.bodies.bodies import BodyName, Resolution, make_body
from physhandi.synthetic.code_version import generator_version
from physhandi.synthetic.engines.mujoco_flex import simulate_truth
from physhandi.synthetic.engines.truth import FRAME_RATE, CapsuleHand, Hold, PhysicalTruth
from physhandi.synthetic.film.cameras import (
    MOST_CAMERAS,
    ImageSize,
    make_held_out_viewpoint,
    make_viewpoints,
    with_image_size,
)
from physhandi.synthetic.film.degradations import changed, find_preset
from physhandi.synthetic.film.filmed_scene import make_filmed_scene
from physhandi.synthetic.film.recording import Images, record
from physhandi.synthetic.hands.actions import ACTIONS, script_action
from physhandi.synthetic.hands.handling import SET_OUT
from physhandi.synthetic.hands.true_hand import TrueHand, load_true_hand

_LOG = logging.getLogger(__name__)

FRAMES = 90
"""Default number of frames: three seconds."""
LEAST_FRAMES, MOST_SYNTHETIC_FRAMES = 2, 1000
"""A sequence has at least and at most so many frames."""
LABEL = "SynthHDI"
"""Label of the sequences."""


def synthesize(
    object_: str,
    action: str,
    *,
    out: Path | str,
    seed: int = 0,
    preset: str = "default",
    cameras: int = 3,
    frames: int = FRAMES,
    set_out: float = SET_OUT,
    release: float | None = None,
    hold: Hold = "friction",
    images: Images = "all",
    image_size: ImageSize = "full",
    held_out_view: bool = False,
    exact_annotation: bool = False,
    resolution: Resolution = "fine",
    changes: Mapping[str, float] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    device: str = "cpu",
) -> Sequence:
    """Simulate hands that handle a soft body, film it, and write the sequence with its truth.

    The same arguments give the same sequence. Body, motion, cameras and errors are drawn apart
    from each other: the physics of a seed does not depend on preset or cameras. A seed makes the
    same body for every action; motion, hand, cameras and errors differ by object and action.

    Args:
        object_: What is handled: cloth, towel, rope, plush or pouch.
        action: What is done: lift, fold, stretch, squeeze, wipe or push.
        out: Folder of the sequence; it must not be there yet. Its name becomes the sequence's.
        seed: Decides size and material of the body, the motion, the cameras and all errors.
        preset: Levels of all degradations: clean, default, hard or paper.
        cameras: Number of cameras, 1 to 4.
        frames: Number of frames, 30 a second.
        set_out: When hands set out for the body, which takes them 1.5 s to hold [s]; by default
            they have it in frame 0.
        release: When hands begin to let go [s]; None: never.
        hold: Whether hands hold by friction, or what they have touched for 0.1 s sticks to them.
        images: ``none`` leaves color, depth and masks out; see `record`.
        image_size: ``half`` and ``quarter`` store smaller pictures of the same cameras. Levels in
            pixels stay those of the full picture, as if detectors had seen that.
        held_out_view: Whether one more camera, halfway between the first two, films without errors
            for scoring alone (`Sequence.held_out_views`). The others stay as they are.
        exact_annotation: Whether `truth/` gets the masks and tracks of all views without any error.
            It changes no other file.
        resolution: How many nodes the body gets; ``tiny`` is for tests.
        changes: Levels that differ from the preset's, by name.
        overwrite: Whether to replace a sequence that is there.
        progress: Told after every frame; may ask to stop.
        device: Warp device that draws pictures. Graphics cards see the same but for pixels in which
            two surfaces are equally near.

    Returns:
        The finished, validated sequence.

    Raises:
        UsageError: If an argument makes no sense, or MuJoCo is not installed.
        SequenceError: If the folder is there already and `overwrite` is false.
        SimulationDivergedError: If the body left the range of sane motion.
        CancelledError: If the user asked to stop.
        OSError: If the disk does not take it.
    """
    progress = progress or NullProgress()
    level = changed(find_preset(preset), changes or {})
    _check(action=action, seed=seed, cameras=cameras, frames=frames)
    _check_choice("hold", hold, get_args(Hold))
    _check_choice("images", images, get_args(Images))
    _check_choice("image_size", image_size, get_args(ImageSize))
    name = cast("BodyName", object_)  # An unknown one is refused by `make_body`.
    body = make_body(name, np.random.default_rng([seed, 0]), resolution=resolution)
    with SequenceWriter(out, overwrite=overwrite) as writer:
        script_random = np.random.default_rng([seed, 1, ACTIONS.index(action)])
        scripts = script_action(
            action,
            body,
            script_random,
            duration=(frames - 1) / FRAME_RATE,
            set_out=set_out,
            release=release,
        )
        hands: dict[Side, TrueHand] = {one.side: load_true_hand(one.side) for one in scripts}
        capsules = cast("Mapping[Side, CapsuleHand]", hands)
        with engine_warnings_logged():
            truth = simulate_truth(
                body, scripts, capsules, frame_count=frames, hold=hold, progress=progress
            )
        # Or all sequences of a seed would share the errors of one calibration.
        place = [seed, 2, get_args(BodyName).index(name), ACTIONS.index(action)]
        own = int(np.random.default_rng(place).integers(2**32))
        stage = replace(make_filmed_scene(truth, hands, level, own), device=device)
        extent = stage.extent()
        given = make_viewpoints(extent, cameras, level, own)
        views = tuple(with_image_size(view, image_size) for view in given)
        held_out = (make_held_out_viewpoint(extent, cameras, own),) if held_out_view else ()
        record(
            writer,
            stage,
            views,
            level,
            seed=own,
            images=images,
            held_out=[with_image_size(view, image_size) for view in held_out],
            exact_annotation=exact_annotation,
            progress=progress,
        )
        settings = {
            "object": object_,
            "action": action,
            "seed": seed,
            "preset": preset,
            "cameras": cameras,
            "frames": frames,
            "set_out": set_out,
            "release": release,
            "hold": hold,
            "images": images,
            "image_size": image_size,
            "held_out_view": held_out_view,
            "resolution": resolution,
            "changes": dict(changes or {}),
        }
        meta = SequenceMeta(
            name=writer.folder.name,
            description=_describe(truth, action, hands),
            label=LABEL,
            frame_rate=truth.frame_rate,
            frame_count=frames,
            ground_height=0.0,
            hands=tuple(hand.side for hand in stage.hands),
            views=tuple(ViewMeta(name=view.name, camera=view.calibrated) for view in views),
            reconstruction=round(0.7 * frames),
            provenance={
                "origin": "simulated by MuJoCo",
                "mujoco": version("mujoco"),
                "generator": generator_version(),
                "license": "CC0-1.0",
                "synthesize": settings,
                "degradations": asdict(level),
            },
        )
        return writer.finish(meta)


@contextmanager
def engine_warnings_logged() -> Generator[None, None, None]:
    """Redirect MuJoCo's warnings to the log; by default it writes a file in the working folder.

    What goes wrong for good is found by the engine's own checks.
    """
    mujoco = import_module("mujoco")
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: _LOG.info("MuJoCo: %s", text))
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _check(*, action: str, seed: int, cameras: int, frames: int) -> None:
    """Refuse invalid arguments before anything is computed or written."""
    if action not in ACTIONS:
        raise UsageError(f"There is no action {action!r}. Choose one of: {', '.join(ACTIONS)}.")
    if not 0 <= seed < 2**32:
        raise UsageError(f"seed is {seed}; expected a whole number from 0 to 4294967295.")
    if not 1 <= cameras <= MOST_CAMERAS:
        raise UsageError(f"cameras is {cameras}; expected 1 to {MOST_CAMERAS}.")
    if not LEAST_FRAMES <= frames <= MOST_SYNTHETIC_FRAMES:
        raise UsageError(f"frames is {frames}; expected {LEAST_FRAMES} to {MOST_SYNTHETIC_FRAMES}.")
    if find_spec("mujoco") is None:
        raise UsageError(
            "Making sequences needs MuJoCo, which is not installed: pip install 'physhandi[synth]'."
        )


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise UsageError(f"{name} is {value!r}; expected one of: {', '.join(choices)}.")


def _describe(truth: PhysicalTruth, action: str, hands: Mapping[Side, TrueHand]) -> str:
    """Describe the sequence in two sentences."""
    size = " x ".join(f"{100 * side:.0f}" for side in truth.body.size[:2])
    who = " and ".join(f"a {side} hand" for side in SIDES if side in hands)
    how = "friction" if truth.hold == "friction" else "attachment"
    return (
        f"{action.capitalize()}: {who}, and a {truth.body.name} of {size} cm held by {how}. "
        "Simulated by MuJoCo, filmed by made-up cameras."
    )
