"""Shown parts of a scene, and their colors."""

from dataclasses import dataclass, replace
from typing import Literal, get_args

from app.viewer.content.content import Content
from physhandi.object_rollout import ObjectRollout

BLUE = (47, 111, 222)
RED = (214, 39, 40)
GREEN = (46, 160, 67)
YELLOW = (245, 190, 20)
GREY = (120, 130, 145)
TEAL = (0, 175, 140)
PURPLE = (125, 65, 195)
SKIN = {"right": (224, 172, 140), "left": (205, 150, 122)}

Theme = Literal["as the browser", "light", "dark"]
"""Backgrounds to choose from."""
THEMES: tuple[Theme, ...] = ("as the browser", "light", "dark")

Coloring = Literal[
    "plain", "error", "stiffness", "damping", "strain", "speed", "force", "difference"
]
"""Quantity by which nodes, surface and springs are colored."""
COLORINGS: tuple[Coloring, ...] = get_args(Coloring)

ObjectForm = Literal["splats", "surface", "nodes"]
"""Forms in which an object can be drawn."""
OBJECT_FORMS: tuple[ObjectForm, ...] = get_args(ObjectForm)

PLAYING_SPRINGS = 2_000
"""Most springs that are streamed while the clock is running."""


@dataclass
class Layers:
    """Shown parts of the scene."""

    hands: bool = True
    """Hand meshes."""
    nodes: bool = True
    """Object nodes."""
    surface: bool = False
    """Smooth surface of the object, which follows its nodes."""
    splats: bool = False
    """Splats of the object in the colors of the recording; its surface stands for those that there
    are not, and where colors mean something else."""
    controls: bool = True
    """Control nodes that hold the object by a virtual spring."""
    all_controls: bool = False
    """Control nodes that hold nothing."""
    virtual_springs: bool = True
    """Springs between control nodes and object nodes."""
    object_springs: bool = False
    """Springs between object nodes."""
    forces: bool = True
    """Force of the hands on each object node."""
    observed: bool = False
    """Observed points."""
    cameras: bool = True
    """Camera frustums with the frame's image."""
    ground: bool = True
    """Grid on the ground, or below everything if the ground is not known."""
    looks_from: str | None = None
    """View whose image is the backdrop."""
    dark: bool = False
    """Dark background."""
    force_scale: float = 1.0
    """Length of the force arrows, relative to the automatic one."""
    color: Coloring = "plain"
    """Quantity by which nodes, surface and springs are colored."""
    color_range: tuple[float, float] | None = None
    """Values at the ends of the color scale, in SI units; None for those of the sequence."""
    mass: float | None = None
    """Mass of the object for which forces are shown [kg]; None for that of the content."""


def default_layers(content: Content) -> Layers:
    """Choose what is shown at first: the result if there is one, else the recording.

    Nodes and springs would hide what an object looks like, and come in its place if nothing tells
    that. Splats have the light of the recording in them: they agree with its pictures, but show no
    folds from elsewhere, and come first only where no surface could be laid.
    Hands without an object are seen as the first camera with a picture saw them, before it.
    """
    has_object = content.fitted is not None
    has_splats, has_surface = content.splats is not None, content.surface is not None
    has_look = has_splats or has_surface
    seen_from = [view.name for view in content.views if view.has_color]
    is_before_video = bool(content.hands and seen_from) and not has_object
    return Layers(
        surface=has_surface,
        splats=has_splats and not has_surface,
        nodes=not has_look,
        controls=not has_look,
        virtual_springs=not has_look,
        observed=not has_object or (content.tracks is not None and content.tracks.node is not None),
        cameras=not has_object and bool(content.views),
        object_springs=content.fitted is not None
        and not has_look
        and has_few_springs(content.fitted),
        looks_from=seen_from[0] if is_before_video else None,
    )


def with_surface_for_splats(layers: Layers) -> Layers:
    """Show the surface where splats were asked for and cannot be shown."""
    return replace(layers, splats=False, surface=layers.surface or layers.splats)


def next_form(layers: Layers, content: Content) -> ObjectForm:
    """Find as what the object is to be shown after what it is shown as now."""
    forms: list[tuple[ObjectForm, bool]] = [
        ("surface", content.surface is not None),
        ("splats", content.splats is not None),
        ("nodes", True),
    ]
    order: list[ObjectForm] = [form for form, is_there in forms if is_there]
    shown = [at for at, form in enumerate(order) if getattr(layers, form)]
    return order[(shown[0] + 1) % len(order)] if shown else order[0]


def has_few_springs(rollout: ObjectRollout) -> bool:
    """Return whether all springs fit into a playing frame; with them nodes look like cloth."""
    return rollout.model.object_spring_count <= PLAYING_SPRINGS
