"""The suites: scenes, seeds, settings and methods.

Difficulty is set here and in the scenes, once, before any method is tuned. Seeds from
`RESERVED_SEED` on are kept for verification; nothing may be tuned on them.
"""

import inspect
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from physhandi.data.files import named_fields
from physhandi.data.sequence import Sequence
from physhandi.errors import UsageError
from physhandi.progress import Progress
from physhandi.synthetic.hands.handling import SET_OUT

SuiteName = Literal["tiny", "dev", "dev_rgbd", "dev_contact", "full"]
Protocol = Literal["main", "single_view", "unseen", "robustness", "sensitivity"]
Making = Mapping[str, Any]
"""Arguments of `synthesize` for one sequence."""
RESERVED_SEED = 1000
"""Seeds from here on are reserved for verification."""
BASELINES = ("static", "rigid_follow", "phystwin")
"""Methods of every table."""
FLOOR = "true_motion"
"""The method whose errors are those of the nodes' places alone."""
ORACLES = ("oracle_hand", "oracle_parameters", FLOOR)
"""Methods with input that no real method can have."""


@dataclass(frozen=True, kw_only=True)
class SuiteScene:
    """One scene of a suite; with a seed it becomes a sequence."""

    object_: str
    """Object: cloth, towel, rope, plush or pouch."""
    action: str
    """Action: lift, fold, stretch, squeeze, wipe or push."""
    set_out: float = SET_OUT
    """When the hands set out for the object [s]; by default they hold it in frame 0."""
    release: float | None = None
    """When they begin to let go [s]; None: never."""

    @property
    def hold(self) -> Literal["friction", "attachment"]:
        """Hold of the hands: friction, or attachment where two of them pull."""
        return "attachment" if self.action == "stretch" else "friction"

    def name(self, seed: int) -> str:
        """Name the sequence of a seed."""
        parts = [self.object_, self.action]
        parts += ["late"] if self.set_out > SET_OUT else []
        parts += ["released"] if self.release is not None else []
        return "_".join([*parts, str(seed)])


@dataclass(frozen=True, kw_only=True)
class Suite:
    """A list of scenes, with the settings and methods of their evaluation."""

    name: SuiteName
    """Name on the command line."""
    about: str
    """Purpose, in one sentence."""
    scenes: tuple[SuiteScene, ...]
    """Scenes, in order."""
    seeds: tuple[int, ...]
    """Seeds of each scene."""
    methods: tuple[str, ...]
    """Methods that are compared if none are named."""
    protocols: tuple[Protocol, ...] = ("main",)
    """Protocols that are run if none are named."""
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Settings that all methods share: one node spacing, so that Chamfer distances compare."""
    recording: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Arguments of `synthesize` for every sequence: preset, frames, images, resolution."""


def _scenes(*pairs: str) -> tuple[SuiteScene, ...]:
    split = [pair.split() for pair in pairs]
    return tuple(SuiteScene(object_=object_, action=action) for object_, action in split)


_DEV_SCENES = _scenes(
    "cloth lift", "cloth fold", "rope lift", "rope push", "plush squeeze", "pouch lift"
)
_DEV_SETTINGS = {"node_spacing": 0.011, "object_.first_order.iterations": 80}

SUITES: dict[str, Suite] = {
    suite.name: suite
    for suite in (
        Suite(
            name="tiny",
            about="One small sequence and little effort: shows that everything works.",
            scenes=_scenes("cloth lift"),
            seeds=(0,),
            methods=("static", "rigid_follow", "phystwin", "quick", "quick+last_residual", FLOOR),
            settings={
                "node_spacing": 0.022,
                "simulation.connection_radius": 0.03,
                "hand.iterations": 60,
                "hand.depth_iterations": 0,
                "object_.search.generations": 2,
                "object_.search.population": 4,
                "object_.search.widening_generations": 0,
                "object_.first_order.iterations": 2,
                "refinement.iterations": 0,
            },
            recording={"preset": "clean", "resolution": "tiny", "images": "none", "frames": 20},
        ),
        Suite(
            name="dev",
            about="Six sequences without images, and at most 80 first-order steps a fit so that "
            "all methods take a quarter of an hour on a fast GPU: for daily work on methods.",
            scenes=_DEV_SCENES,
            seeds=(0,),
            methods=(
                *BASELINES,
                *("phystwin+last_residual", "phystwin+restart"),
                *("ours", "ours+last_residual"),
                *ORACLES,
            ),
            protocols=("main", "unseen"),
            settings=_DEV_SETTINGS,
            recording={"preset": "default", "images": "none", "frames": 60},
        ),
        Suite(
            name="dev_rgbd",
            about="The motions and cameras of `dev`, with color and depth of 424 x 240 px in three "
            "views, and a fourth view that is held out.",
            scenes=_DEV_SCENES,
            seeds=(0,),
            methods=(
                *BASELINES,
                *("phystwin+last_residual", "phystwin+restart"),
                *("ours", "ours+last_residual", "ours@refinement.iterations=0"),
                FLOOR,
            ),
            protocols=("main", "single_view"),
            settings=_DEV_SETTINGS,
            recording={
                "preset": "default",
                "frames": 60,
                "image_size": "half",
                "held_out_view": True,
            },
        ),
        Suite(
            name="dev_contact",
            about="What `dev` lacks: flat hands that wipe, a hand that arrives late, and one that "
            "lets go; four sequences without images.",
            scenes=(
                SuiteScene(object_="towel", action="wipe"),
                SuiteScene(object_="cloth", action="wipe", set_out=-0.2),
                SuiteScene(object_="rope", action="push", set_out=-0.2),
                SuiteScene(object_="pouch", action="lift", release=1.2),
            ),
            seeds=(0,),
            methods=(
                *BASELINES,
                *("phystwin+last_residual", "phystwin+restart"),
                *("ours", "ours+last_residual"),
                *ORACLES,
            ),
            settings=_DEV_SETTINGS,
            recording={"preset": "default", "images": "none", "frames": 90},
        ),
        Suite(
            name="full",
            about="Five objects, four actions each, five seeds, with images: the paper's tables.",
            scenes=_scenes(
                *("cloth lift", "cloth fold", "cloth stretch", "cloth wipe"),
                *("towel lift", "towel fold", "towel wipe", "towel push"),
                *("rope lift", "rope stretch", "rope fold", "rope push"),
                *("plush lift", "plush squeeze", "plush stretch", "plush push"),
                *("pouch lift", "pouch squeeze", "pouch stretch", "pouch push"),
            ),
            seeds=(0, 1, 2, 3, 4),
            methods=(
                *BASELINES,
                *("phystwin+last_residual", "phystwin+restart"),
                *("paper", "ours", "ours+last_residual"),
                *("ours@refinement.iterations=0", *ORACLES),
            ),
            protocols=("main", "single_view", "unseen", "robustness", "sensitivity"),
            settings={"node_spacing": 0.01},
            recording={"preset": "default"},
        ),
    )
}
"""All suites by name."""


NAMED_SETTINGS: Mapping[str, Any] = {"node_spacing": 0.01}
"""Settings that all methods share on sequences that belong to no suite."""


def find_suite(name: str) -> Suite:
    """Find a suite by name.

    Raises:
        UsageError: If there is no such suite.
    """
    if name not in SUITES:
        raise UsageError(f"There is no suite '{name}'. Choose from: {', '.join(SUITES)}.")
    return SUITES[name]


def check_seeds(seeds: Many[int]) -> None:
    """Refuse seeds that no sequence can have, or that come twice.

    Raises:
        UsageError: If a seed is negative or named twice.
    """
    for seed in seeds:
        if seed < 0:
            raise UsageError(f"Seed {seed} is negative; seeds count from 0.")
        if list(seeds).count(seed) > 1:
            raise UsageError(f"Seed {seed} is named twice.")


def make_recordings(
    suite: Suite, seeds: Many[int], folder: Path, make: Callable[[Mapping[Path, Making]], None]
) -> tuple[Sequence, ...]:
    """Synthesize the sequences of a suite, or open those that exist.

    Args:
        suite: The suite.
        seeds: Seeds of every scene.
        folder: Folder of the sequences.
        make: Synthesizes the missing ones: `make_one_by_one`, or in parallel by `make_recording`.

    Raises:
        UsageError: If a seed is invalid, or an existing sequence was made with other settings; then
            nothing is made.
        SequenceError: If an existing sequence is damaged; delete its folder to make it again.
    """
    check_seeds(seeds)
    makings = {
        folder / scene.name(seed): _making(suite, scene, seed)
        for scene in suite.scenes
        for seed in seeds
    }
    recordings = {target: Sequence.load(target) for target in makings if target.is_dir()}
    for target, recording in recordings.items():
        _check_made(suite, recording, makings[target])
    make({target: making for target, making in makings.items() if target not in recordings})
    return tuple(recordings.get(target) or Sequence.load(target) for target in makings)


def make_one_by_one(makings: Mapping[Path, Making], progress: Progress) -> None:
    """Synthesize sequences of a suite, given by folder, one after the other."""
    for target, making in makings.items():
        make_recording(making, target, progress)


def make_recording(making: Making, target: Path, progress: Progress) -> None:
    """Synthesize one sequence of a suite in the folder `target`."""
    from physhandi.synthetic.synthesize import synthesize

    others = {name: value for name, value in making.items() if name != "object"}
    synthesize(making["object"], **others, out=target, progress=progress)


def _making(suite: Suite, scene: SuiteScene, seed: int) -> dict[str, Any]:
    scripted = {"object": scene.object_, "action": scene.action, "seed": seed, "hold": scene.hold}
    timed = {"set_out": scene.set_out, "release": scene.release}
    return scripted | timed | dict(suite.recording)


def _check_made(suite: Suite, recording: Sequence, making: Making) -> None:
    """Refuse an existing sequence that differs from the one that would be made.

    Raises:
        UsageError: If it was made with other settings, or by something else.
    """
    from physhandi.synthetic.synthesize import synthesize

    signature = inspect.signature(synthesize).parameters.values()
    expected = {p.name: p.default for p in signature if p.default is not inspect.Parameter.empty}
    expected |= {"changes": {}} | dict(making)
    recorded = named_fields(recording.provenance.get("synthesize"))
    if recorded is None or not {"object", "action", "seed"} <= recorded.keys():
        differs = "was not made by `physhandi synthesize`"
    else:
        # Settings that did not exist yet when it was made belong to another generator.
        others = [n for n in expected if n in recorded and recorded[n] != expected[n]]
        listed = ", ".join(
            f"{name} {recorded[name]} in place of {expected[name]}" for name in others
        )
        differs = f"was made with {listed}" if others else ""
    if differs:
        raise UsageError(
            f"{recording.folder} {differs}, so it is no sequence of the suite '{suite.name}'. "
            "Choose another --out, or delete that folder to have it made anew."
        )
