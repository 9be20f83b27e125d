"""Settings of stage 2; docs/conventions.md shows what the four profiles make of them."""

from dataclasses import dataclass, field
from typing import Literal

from physhandi.fitting.search import SearchConfig


@dataclass(frozen=True, kw_only=True)
class FirstOrderConfig:
    """How per-spring stiffness and damping are optimised (Adam)."""

    iterations: int = 60
    """Passes over all sequences; 0 skips the stage."""
    learning_rate: float = 0.02
    """Step of Adam: of the logarithms, and of the contact coefficients where they are learned."""
    beta_2: float = 0.99
    """Adam's second moment decay."""
    window: int | None = None
    """Frames that a gradient reaches back, with one update a window; none is the whole sequence."""
    is_annealed: bool = True
    """Fit the first frames first and lengthen the horizon over the first half of the iterations."""
    learns_damping: bool = True
    """Whether each spring gets its own damping (paper) or all keep the searched one (PhysTwin)."""
    learns_contact: bool = False
    """Whether restitution and friction, of the ground and of self-collision, are optimised too."""
    prior_weight: float = 1e-8
    """Pull of every logarithm towards its searched value [m²]."""
    most_stiffness: float | None = None
    """A spring acts no stiffer than this, and has no gradient above it [N]; none for no limit."""
    steepest: float | None = 100.0
    """Largest sane gradient, in losses per unit of the logarithm of a stiffness; a steeper one
    reaches back over fewer frames, or is not used. None uses every gradient, as PhysTwin does."""
    truncates_damping: bool = False
    """Whether damping and drag lose their fraction between the search and this stage.

    PhysTwin's quirk: its configuration holds both as whole numbers and casts what the search found
    to them, so the stage starts from another object than the one that was searched."""
    judged_every: int = 1
    """Iterations between those whose springs may be returned; the first and last always may."""
    judges_online: bool = False
    """Whether iterations are ranked by the loss met on the way, while the springs still changed
    after every window (PhysTwin), or by simulating once more with the springs at their end. Ranked
    on the way, the start is no candidate."""

    def __post_init__(self) -> None:
        if self.judged_every < 1:
            raise ValueError(f"judged_every is {self.judged_every}; expected at least 1")


@dataclass(frozen=True, kw_only=True)
class ObjectFitConfig:
    """What stage 2 does."""

    search: SearchConfig = field(default_factory=SearchConfig)
    """Zeroth-order part: global parameters."""
    first_order: FirstOrderConfig = field(default_factory=FirstOrderConfig)
    """First-order part: one stiffness and one damping for each spring."""
    track_weight: float = 1.0
    """Weight of the track term beside the Chamfer term; PhysTwin's is 1/6."""
    acceleration_weight: float = 0.0
    """Weight of the acceleration term, in the search only [s²]; PhysTwin's is 0.01."""
    freezes_counts: bool = False
    """Divide every frame's loss by the counts of frame 1, as PhysTwin does."""
    chamfer_points: Literal["cloud", "tracks"] = "cloud"
    """What the Chamfer term compares with: the fused cloud, or the tracks that are visible."""
    cloud_points: int | None = 300
    """Most points of a frame that enter the Chamfer term; none for all."""
    starts_at_rest: bool = False
    """Take the object to rest at frame 0 instead of estimating its velocity (PhysTwin)."""
    automatic_substeps: bool = False
    """Give each candidate the substeps that its own stability limit asks for."""
    most_substeps: int = 2000
    """A candidate that needs more substeps a frame than this is not tried."""
