"""What can be said on the command line to commands that write sequences."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, subcommand


@dataclass(frozen=True, kw_only=True)
class Synthesize:
    """Make a sequence: hands handle a soft body in MuJoCo, and made-up cameras film it."""

    object: str
    """What is handled: cloth, towel, rope, plush or pouch."""
    action: str
    """What is done with it: lift, fold, stretch, squeeze, wipe or push."""
    out: Path
    """Sequence folder to write."""
    seed: int = 0
    """Decides size and material, motion, cameras and errors; from 1000 on for verification only."""
    preset: str = "default"
    """How imperfect sensors and detectors are: clean, default, hard or paper."""
    change: tuple[str, ...] = ()
    """Levels that differ from the preset's, like depth_noise=0.1 (docs/synthhdi.md lists them)."""
    cameras: int = 3
    """Number of cameras, 1 to 4."""
    frames: int = 90
    """Number of frames, 30 a second."""
    hold: Literal["friction", "attachment"] = "friction"
    """Hands hold by friction alone, or what they have touched for 0.1 s sticks to them."""
    images: Literal["all", "none"] = "all"
    """none writes lifted tracks instead of color, depth and masks: small, and made in seconds."""
    resolution: Literal["fine", "tiny"] = "fine"
    """How many nodes the simulated body has."""
    overwrite: bool = False
    """Replace a sequence that is there."""


@dataclass(frozen=True, kw_only=True)
class ImportStereo:
    """Two calibrated videos of a hand (cam0_test.mp4, c0.dat, rot_trans_c0.dat, …)."""

    source: Positional[Path]
    """Folder of the recording."""
    out: Path
    """Sequence folder to write."""


@dataclass(frozen=True, kw_only=True)
class ImportMocap:
    """Motion capture of a rope held by two grippers (one .npy per trajectory)."""

    source: Positional[Path]
    """A trajectory, or a folder of them."""
    out: Path
    """Folder to write one sequence per trajectory into."""


@dataclass(frozen=True, kw_only=True)
class ImportPhystwin:
    """A case of the PhysTwin data set, and what PhysTwin made of it."""

    source: Positional[Path]
    """Case folder (calibrate.pkl, metadata.json, final_data.pkl, color/, depth/, mask/, …)."""
    out: Path
    """Sequence folder to write."""
    optimal_params: Path | None = None
    """optimal_params.pkl of PhysTwin's search; makes a run of it."""
    checkpoint: Path | None = None
    """best_*.pth of PhysTwin's training, with per-spring stiffness; needs --optimal-params."""
    inference: Path | None = None
    """inference.pkl, PhysTwin's own rollout; the report says how far ours is from it."""
    keep_decimals: bool = False
    """Keep the decimals of dashpot and drag, which PhysTwin drops after its search."""
    run: Path | None = None
    """Run folder to write; none takes the sequence folder's name with _phystwin after it."""
    device: str = "auto"
    """Warp device that rolls the imported run out: auto, cpu or cuda:0."""


@dataclass(frozen=True, kw_only=True)
class ImportMano:
    """MANO hand models that you have downloaded under their own licence."""

    sources: Positional[tuple[Path, ...]]
    """MANO_LEFT.pkl, MANO_RIGHT.pkl or both."""
    out: Path | None = None
    """Folder of hand models (PHYSHANDI_HANDS, else ~/.local/share/physhandi/hands)."""


@dataclass(frozen=True, kw_only=True)
class Import:
    """Turn a recording, a result or a hand model of another format into ours."""

    source: (
        Annotated[ImportStereo, subcommand("stereo", prefix_name=False)]
        | Annotated[ImportMocap, subcommand("mocap", prefix_name=False)]
        | Annotated[ImportPhystwin, subcommand("phystwin", prefix_name=False)]
        | Annotated[ImportMano, subcommand("mano", prefix_name=False)]
    )
    """What to import."""
