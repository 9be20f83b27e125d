"""Methods of a suite: every baseline and every profile as a run of the pipeline.

A method is written ``BASE[@SETTING=VALUE,…][+CORRECTION]``: `METHODS` has the bases, `CORRECTIONS`
what can be done to their predicted frames, and the settings are those of a profile.
"""

import re
import shutil
from collections.abc import Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from operator import getitem
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from safetensors.numpy import load_file
from scipy.spatial.transform import Rotation

from physhandi import pipeline
from physhandi.appearance.config import AppearanceConfig
from physhandi.appearance.splats import Splats
from physhandi.data.attempt import Attempt
from physhandi.data.environment import ENVIRONMENT, describe_environment
from physhandi.data.layout import METRICS_FILE, SequenceFiles
from physhandi.data.run import RunFolder
from physhandi.data.run_folder import artefacts
from physhandi.data.sequence import Sequence
from physhandi.devices import describe_device
from physhandi.errors import MissingInputError, UsageError
from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.metrics.baselines import (
    last_residual_baseline,
    rigid_follow_baseline,
    static_baseline,
)
from physhandi.metrics.report import measure_run
from physhandi.metrics.truth_metrics import TrueSurface, true_motion
from physhandi.progress import Progress

HAND_NOISE = 0.010
"""Mean joint error of the paper's disturbed hands [m]."""
_PLACE, _TURN, _POSE = 0.01, 0.1, 0.1
_HALVINGS = 30
_MOST = 8.0
Given = Literal["recording", "true_hand", "all_frames", "truth"]
LOOK = "appearance."
"""Beginning of settings that say what the object looks like, which is the same for all methods."""
SEARCH_SEED = "object_.search.seed"
"""Setting that decides the candidates of a search."""
CORRECTIONS: dict[str, str] = {
    "last_residual": "The last residual is added.",
    "restart": "Prediction starts from the observed state.",
}
"""Corrections of the predicted frames of a method; ends its name."""
_NAME = re.compile(
    r"(?P<base>[^@+]*)(@(?P<settings>.*?))?(\+(?P<correction>[A-Za-z]\w*))?", re.DOTALL
)
_OPENING, _CLOSING = "[{(", "]})"
_EFFORT = ("iterations", "generations")
"""Ends of settings that say how much work is done."""


@dataclass(frozen=True, kw_only=True)
class Method:
    """A way to predict the object's motion."""

    name: str
    """Name in tables."""
    about: str
    """Description in one sentence."""
    profile: str = "default"
    """Settings of the hands and, if there is no rule, of the object."""
    rule: Literal["static", "rigid_follow", "true_motion"] | None = None
    """Rule that moves the object; None for a fit."""
    gets: Given = "recording"
    """Input: an oracle gets data that no real method can have."""
    overrides: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Settings that differ from the profile's."""
    correction: str | None = None
    """Correction of the predicted frames, one of `CORRECTIONS`; None leaves them."""
    seed_of: str = ""
    """The method that this is one of several seeds of; empty if there are not several."""

    @property
    def base(self) -> "Method":
        """The same without the correction."""
        name = self.name.removesuffix(f"+{self.correction}")
        return replace(self, name=name, correction=None)


METHODS = {
    method.name: method
    for method in (
        Method(name="static", rule="static", about="The object of frame 0, unmoved."),
        Method(
            name="rigid_follow",
            rule="rigid_follow",
            about="The object of frame 0, moved rigidly with the hands.",
        ),
        Method(
            name="phystwin",
            profile="phystwin",
            about="PhysTwin's choices: 30 visible hand points, far from each other, at rest "
            "velocity; one global dashpot.",
        ),
        Method(name="paper", profile="paper", about="The paper's method as it states it."),
        Method(name="ours", about="The default profile."),
        Method(name="quick", profile="quick", about="The default profile, cut down."),
        Method(
            name="oracle_hand",
            gets="true_hand",
            about="The default profile, given the true hands: what remains is the object's error.",
        ),
        Method(
            name="oracle_parameters",
            gets="all_frames",
            about="The default profile, fitted to the future frames too: one optimisation in "
            "hindsight; other parameters might do better still.",
        ),
        Method(
            name="true_motion",
            rule="true_motion",
            gets="truth",
            about="The object of frame 0, carried by the true motion: the floor of every error at "
            "this node spacing.",
        ),
    )
}
"""Bases that a method can start from."""


def parse_method(text: str) -> Method:
    """Read the name of a method.

    Raises:
        UsageError: If there is no such base, setting or correction, or nothing to be corrected;
            names it.
    """
    match = _NAME.fullmatch(text)
    base, settings, correction = (
        match.group("base", "settings", "correction") if match else (text,) * 3
    )
    if base not in METHODS:
        raise UsageError(f"There is no method '{base}'. Choose from: {', '.join(METHODS)}.")
    if correction is not None and correction not in CORRECTIONS:
        names = " and ".join(f"'+{name}'" for name in CORRECTIONS)
        raise UsageError(f"Method '{text}' ends in '+{correction}'; only {names} exist.")
    overrides: dict[str, Any] = {}
    for part in () if settings is None else _split(settings):
        path, equals, value = part.partition("=")
        if not equals:
            raise UsageError(f"Method '{text}': '{part}' is not SETTING=VALUE.")
        try:
            overrides[path] = yaml.safe_load(value)
        except yaml.YAMLError:
            raise UsageError(f"Method '{text}': '{value}' is not a value of YAML.") from None
    start = METHODS[base]
    about = start.about if correction is None else f"{start.about} {CORRECTIONS[correction]}"
    method = replace(start, name=text, about=about, overrides=overrides, correction=correction)
    settings_of_it = method_settings(method, {})
    if why := _why_not_corrected(method, base, settings_of_it):
        raise UsageError(f"Method '{text}' {why}: leave '+{correction}' out.")
    return method


def searched_from(method: Method, seeds: Many[int]) -> tuple[Method, ...]:
    """Repeat a fit with other seeds of its search; a rule, or a fit that names one, stays alone.

    Raises:
        UsageError: If a seed cannot be one.
    """
    if method.rule is not None or SEARCH_SEED in method.overrides or not seeds:
        return (method,)
    correction = "" if method.correction is None else f"+{method.correction}"
    base = method.base.name
    mark = "," if "@" in base else "@"
    names = [f"{base}{mark}{SEARCH_SEED}={seed}{correction}" for seed in dict.fromkeys(seeds)]
    return tuple(replace(parse_method(name), seed_of=method.name) for name in names)


def _why_not_corrected(method: Method, base: str, settings: Mapping[str, Any]) -> str:
    """Say why a method's correction makes no sense; empty if it does, or if there is none."""
    if method.correction is None:
        return ""
    if method.gets == "all_frames":
        return f"has no predicted frames, since '{base}' is fitted to all of them"
    if method.correction == "restart":
        if method.rule is not None:
            return f"has nothing to simulate again, since '{base}' is a rule"
        if settings["prediction"]["restarts"]:
            return "restarts by its own settings (prediction.restarts)"
    return ""


def _split(settings: str) -> list[str]:
    """Split at commas, but not inside of brackets."""
    parts, depth = [""], 0
    for letter in settings:
        depth += (letter in _OPENING) - (letter in _CLOSING)
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def method_settings(method: Method, common: Mapping[str, Any]) -> dict[str, Any]:
    """Return all settings of a method as plain data; hands are fitted as `default` fits them.

    Args:
        method: The method; its own settings win.
        common: Settings that all methods of a suite share; numbers of iterations and generations
            are bounds, so that none does more than by itself. What the object looks like is not a
            method's: it is fitted once for all of them.

    Raises:
        UsageError: If a setting is unknown or out of bounds.
    """
    own: Any = pipeline.settings_of(method.profile, {})
    # What is compared is what methods make of the same hands.
    hands = pipeline.settings_of("default", {})["hand"]
    same_hands = {f"hand.{name}": value for name, value in hands.items()}
    shared = {
        path: min(value, reduce(getitem, path.split("."), own)) if path.endswith(_EFFORT) else value
        for path, value in common.items()
        if not path.startswith(LOOK)
    }
    return pipeline.settings_of(method.profile, {**same_hands, **shared, **method.overrides})


def look_settings(common: Mapping[str, Any]) -> AppearanceConfig:
    """Give the settings of what objects look like, which is fitted unless the order leaves it out.

    Args:
        common: Settings that all methods of a suite share.
    """
    asked = {path: value for path, value in common.items() if path.startswith(LOOK)}
    settings = pipeline.settings_of("default", {f"{LOOK}enabled": True} | asked)
    return AppearanceConfig.from_dict(settings[LOOK.removesuffix(".")])


def shows_look(reference: RunFolder, recording: Sequence) -> bool:
    """Tell whether a recording shows what an object looks like, and a run has its nodes."""
    has_nodes = reference.has(SequenceFiles(recording.name).object_node)
    return has_nodes and bool(pipeline.colored_views(recording))


def fit_look(
    reference: RunFolder,
    recording: Sequence,
    config: AppearanceConfig,
    *,
    device: str,
    progress: Progress,
) -> Splats:
    """Fit what an object looks like in frame 0, where a run has its nodes.

    Raises:
        PhysHandiError: If no view shows it, or the run is damaged.
    """
    return pipeline.fit_appearance(reference.out, recording, config, progress, device=device).splats


@dataclass(frozen=True, kw_only=True)
class HandNoise:
    """Noise added to fitted hands."""

    error: float
    """Mean displacement of the joints [m]."""
    seed: int
    """Seed of the noise, different for every recording."""


def execute(
    method: Method,
    recording: Sequence,
    folder: Path,
    *,
    title: str,
    common: Mapping[str, Any],
    hands: RunFolder | None = None,
    noise: HandNoise | None = None,
    truth: TrueSurface | None = None,
    device: str = "cpu",
    progress: Progress,
) -> RunFolder:
    """Run a method in a run folder; a finished run is reused, an unfinished one is resumed.

    Args:
        method: The method, not corrected.
        recording: What it is given.
        folder: The run folder.
        title: What the run is called.
        common: Settings that all methods of a suite share.
        hands: A finished run on the same recording, whose stages are taken over as far as the
            settings that they depend on are the same.
        noise: Makes the hands that are taken over wrong, and nothing but hands is taken over.
        truth: The true surface, for a rule that follows it.
        device: Warp device.
        progress: Told about every iteration.

    Raises:
        PhysHandiError: If the method has no result; the run folder then says why.
    """
    settings = method_settings(method, common)
    run = open_suite_run(folder, title, recording, {"profile": settings, "method": method.name})
    if run.is_published:
        return run
    with run.begin_attempt() as attempt:
        watched = attempt.progress(progress)
        save_environment(attempt, device)
        if hands is not None and noise is not None:
            take_disturbed_hands(hands, attempt, recording.name, noise)
        elif hands is not None:
            take_stages(
                hands, attempt, shared_stages(hands.asked("profile", dict[str, Any]), settings)
            )
        config = pipeline.PipelineConfig.from_dict(settings)
        if method.rule is None:
            pipeline.run_reconstruction([recording], config, attempt, watched, device=device)
        else:
            rule = partial(_moved, rule=method.rule, truth=truth)
            pipeline.predict(recording, config, rule, attempt, watched)
        attempt.publish()
    return RunFolder.open(folder)


def disturb_hands(attempt: Attempt, folder: str, noise: HandNoise) -> None:
    """Add noise to the stored hands of a sequence; must be called once only.

    Args:
        attempt: Attempt with the fitted hands.
        folder: Folder of the sequence in it.
        noise: Size and seed of the noise.

    Raises:
        MissingInputError: If there is no hand.
    """
    paths = sorted((attempt.out / folder).glob("hand_*.safetensors"))
    if not paths:
        raise MissingInputError(f"{attempt.out / folder} has no hand to disturb.")
    for number, path in enumerate(paths):
        motion = HandMotion.from_tensors(load_file(path))
        wrong = disturbed(motion, noise.error, seed=(noise.seed, number))
        attempt.save_tensors(f"{folder}/{path.name}", wrong.to_tensors())


def disturbed(motion: HandMotion, error: float, *, seed: tuple[int, ...]) -> HandMotion:
    """Add independent noise to position, rotation and pose of a hand in every frame.

    Each wrist coordinate gets normal noise of 10 mm, wrist and joints 0.1 rad about each axis;
    everything is then scaled by one factor, so that the mean joint error is `error`.

    Args:
        motion: The hand.
        error: Mean displacement of its 21 joints [m].
        seed: Seed of the noise.
    """
    random = np.random.default_rng([4, *seed])
    count = motion.frame_count
    place = _PLACE * random.standard_normal((count, 3))
    turn = _TURN * random.standard_normal((count, 3))
    pose = _POSE * random.standard_normal((count, 15, 3))
    model = load_hand_model(motion.side, motion.model)
    before = motion.keypoints(model)

    def moved(share: float) -> HandMotion:
        rotation = Rotation.from_rotvec(motion.wrist_rotation) * Rotation.from_rotvec(share * turn)
        return replace(
            motion,
            articulation=(motion.articulation + share * pose).astype(np.float32),
            wrist_rotation=rotation.as_rotvec().astype(np.float32),
            wrist_translation=(motion.wrist_translation + share * place).astype(np.float32),
        )

    low, high = 0.0, _MOST
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        gap = np.linalg.norm(moved(middle).keypoints(model) - before, axis=2).mean()
        low, high = (middle, high) if gap < error else (low, middle)
    return moved(high)


def correct(
    base: RunFolder,
    recording: Sequence,
    folder: Path,
    *,
    title: str,
    method: Method,
    device: str = "cpu",
    progress: Progress,
) -> RunFolder:
    """Copy a finished run and correct its predicted frames.

    With ``restart`` the run's own object is simulated again, from the observed state on. With
    ``last_residual`` the residual of the state from which the run predicted is added: of a run
    that restarts that is the observed state, with next to nothing to add.

    Args:
        base: The run.
        recording: What it was given.
        folder: Folder of the copy.
        title: What the copy is called.
        method: The corrected method.
        device: Warp device.
        progress: Told about every frame.

    Raises:
        MissingInputError: If no track is seen in the last frame that was fitted.
        SimulationDivergedError: If the motion runs away.
    """
    config = {**base.config, "method": method.name, "source": str(base.folder.resolve())}
    run = open_suite_run(folder, title, recording, config)
    if run.is_published:
        return run
    with run.begin_attempt() as attempt:
        for rel, path in artefacts(base.out):
            _copy(path, attempt.out / rel)
        if method.correction == "restart":
            pipeline.predict_again(attempt, recording, progress, device=device)
        else:
            _add_last_residual(attempt, base, recording)
        attempt.finish_stage(str(method.correction))
        attempt.publish()
    return RunFolder.open(folder)


def _add_last_residual(attempt: Attempt, base: RunFolder, recording: Sequence) -> None:
    """Shift the predicted frames of a run, and measure it."""
    files = SequenceFiles(recording.name)
    observed = {n: base.array(files.observation(n)) for n in ("point", "is_visible")}
    name = files.observation("node_of_track")
    state = base.tensors(files.restart)["position"] if base.has(files.restart) else None
    try:
        rollout = last_residual_baseline(
            base.array(files.rollout),
            **observed,
            first_future=len(recording.reconstruction_frames),
            node_of_track=base.array(name) if base.has(name) else None,
            continued_from=state,
        )
    except ValueError as error:
        raise MissingInputError(f"Sequence '{recording.name}': {error}.") from error
    attempt.save_array(files.rollout, rollout.astype(np.float32))
    scores, frames = measure_run(attempt.out, recording)
    attempt.save_json(files.frame_errors, frames)
    attempt.save_json(METRICS_FILE, {recording.name: scores})


def simulate_in(
    source: RunFolder,
    target: Sequence,
    folder: Path,
    *,
    title: str,
    device: str,
    progress: Progress,
) -> RunFolder:
    """Simulate a fitted object in a sequence that it was not fitted in.

    Raises:
        PhysHandiError: If there is no result; the run folder then says why.
    """
    if (folder / "run.yaml").is_file():
        run = RunFolder.open(folder)
    else:
        run = RunFolder.create(
            folder,
            name=title,
            kind="simulation",
            sequences=[str(target.folder)],
            config={"source": str(source.folder.resolve()), "parameters": {}},
        )
    if not run.is_published:
        pipeline.run_job(run, progress, device=device)
    return RunFolder.open(folder)


def open_suite_run(
    folder: Path, title: str, recording: Sequence, config: Mapping[str, Any]
) -> RunFolder:
    """Open the run in a folder, or make it."""
    if (folder / "run.yaml").is_file():
        return RunFolder.open(folder)
    return RunFolder.create(
        folder,
        name=title,
        kind="reconstruction",
        sequences=[str(recording.folder)],
        config=config,
    )


def save_environment(attempt: Attempt, device: str) -> None:
    """Note what a run was computed with."""
    about = describe_environment(device, describe_device(device))
    attempt.save_json(ENVIRONMENT, about)


def shared_stages(one: Mapping[str, Any], other: Mapping[str, Any]) -> tuple[str, ...]:
    """Name the first stages whose result is the same under two settings of the pipeline."""
    if one["hand"] != other["hand"]:
        return ()
    nodes = ("node_spacing", "control_nodes", "control_count")
    if any(one[name] != other[name] for name in nodes):
        return (pipeline.HANDS,)
    return (pipeline.HANDS, pipeline.OBSERVATION)


def take_stages(source: RunFolder, attempt: Attempt, names: tuple[str, ...]) -> None:
    """Take over finished stages of another run on the same recording."""
    for stage in source.stages():
        if stage["name"] in names and not attempt.stage_done(stage["name"]):
            for rel in stage["files"]:
                _copy(source.out / rel, attempt.out / rel)
            attempt.finish_stage(stage["name"], stage["summary"])


def take_disturbed_hands(source: RunFolder, attempt: Attempt, name: str, noise: HandNoise) -> None:
    """Take over the hands of another run on the same recording, and make them wrong once.

    The stage counts as finished only when they are wrong: what a kill leaves before that is not
    taken over by the next attempt, and what is finished is left as it is.
    """
    if attempt.stage_done(pipeline.HANDS):
        return
    (stage,) = (stage for stage in source.stages() if stage["name"] == pipeline.HANDS)
    for rel in stage["files"]:
        _copy(source.out / rel, attempt.out / rel)
    disturb_hands(attempt, SequenceFiles(name).folder, noise)
    attempt.finish_stage(pipeline.HANDS, stage["summary"])


def _moved(
    node: np.ndarray, control: np.ndarray, *, rule: str, truth: TrueSurface | None
) -> np.ndarray:
    if rule == "true_motion":
        if truth is None:
            raise MissingInputError("There is no true surface that nodes could follow.")
        return true_motion(node, truth)
    if rule == "static":
        return static_baseline(node, len(control))
    return rigid_follow_baseline(node, control)


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
