"""Fits what the object of a run looks like: splats in frame 0 of a recording."""

from pathlib import Path

from physhandi.appearance.config import AppearanceConfig
from physhandi.appearance.fit import FittedSplats, fit_splats
from physhandi.appearance.texture import colored_surface
from physhandi.data.checkpoint import Checkpointer
from physhandi.data.layout import SHAPE_FILE, SequenceFiles
from physhandi.data.sequence import Sequence
from physhandi.fitting import artefacts
from physhandi.fitting.checks.readiness import colored_views
from physhandi.progress import Progress
from physhandi.simulation.object_surface import lay_surface


def fit_appearance(
    out: Path,
    sequence: Sequence,
    config: AppearanceConfig,
    progress: Progress,
    *,
    device: str = "cpu",
    checkpointer: Checkpointer | None = None,
) -> FittedSplats:
    """Fit splats to what all views show in frame 0, on the surface of a run's object.

    Args:
        out: Output folder of the run, with the object's nodes and its kind.
        sequence: The recording; views with color and masks count.
        config: The settings.
        progress: Told about every iteration; may cancel.
        device: Warp device.
        checkpointer: Keeps the state after an iteration; None keeps nothing.

    Raises:
        RunError: If a file of the run is missing or damaged.
        MissingInputError: If no view shows the object.
        CancelledError: If the user asked to stop.
    """
    views = colored_views(sequence)
    node = artefacts.load_array(out / SequenceFiles(sequence.name).object_node)
    kind, thickness = artefacts.load_shape(out) if (out / SHAPE_FILE).is_file() else (None, None)
    surface = lay_surface(node, kind=kind, thickness=thickness or None)
    return fit_splats(
        views,
        node,
        config=config,
        surface=None if surface is None else colored_surface(surface, node, views),
        progress=progress,
        device=device,
        checkpointer=checkpointer,
    )
