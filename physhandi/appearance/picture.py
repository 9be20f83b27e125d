"""A picture of an object's splats and of hands, each of which may hide the other."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from physhandi.appearance.binding import SplatBinding
from physhandi.appearance.rasterise import SplatImage, render_splats
from physhandi.appearance.splats import Splats
from physhandi.data.camera import PinholeCamera
from physhandi.rendering.renderer import FROM_ABOVE, rasterize, render
from physhandi.rendering.shapes import Surface


@dataclass(frozen=True, eq=False, kw_only=True)
class FramePicture:
    """A picture of one frame."""

    image: SplatImage
    """The splats over the hands and the background; `alpha` and `depth` are those of splats that
    are seen, so what a hand hides is not in them."""
    is_hand: Bool[ndarray, "row column"]
    """Pixels that show a hand: one is there, and splats cover less than half of it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Appearance:
    """Splats, and how an object's nodes carry them: what draws any frame of any rollout."""

    splats: Splats
    """Splats of the object."""
    binding: SplatBinding
    """Nodes that carry each splat."""

    @classmethod
    def of(cls, splats: Splats) -> "Appearance":
        """Bind splats to their nodes."""
        return cls(splats=splats, binding=SplatBinding.of(splats))

    def render_frame(
        self,
        camera: PinholeCamera,
        node: Float[ndarray, "node 3"],
        hands: Sequence[Surface] = (),
        *,
        background: Float[ndarray, "row column 3"] | None = None,
        light: Float[ndarray, " 3"] = FROM_ABOVE,
        samples: int = 2,
        device: str = "cpu",
    ) -> FramePicture:
        """Draw a frame. A splat that is farther away than a hand at a pixel is not seen there.

        Args:
            camera: Where the picture is taken from.
            node: Where the object's nodes are [m].
            hands: Surfaces of the hands, with their colors and shading.
            background: What is behind everything, from 0 to 1; black if left out.
            light: Direction from which the light on the hands comes, in the world.
            samples: Rows and columns over which a pixel of the hands is averaged.
            device: Warp device.

        Raises:
            ValueError: If the camera has distortion, or the nodes are not those of the splats.
        """
        size = (camera.height, camera.width)
        behind = None if background is None else np.asarray(background, np.float32)
        depth = np.zeros(size, np.float32)
        if hands:
            drawn = render(camera, hands, light=light, samples=samples, device=device)
            cover = drawn[..., 3:] / np.float32(255.0)
            behind = np.zeros((*size, 3), np.float32) if behind is None else behind
            behind = cover * (drawn[..., :3] / np.float32(255.0)) + (1.0 - cover) * behind
            depth = rasterize(camera, hands, device=device).depth.astype(np.float32)
        image = render_splats(
            camera,
            self.splats,
            center=self.binding.carry(node[None])[0],
            background=behind,
            occluder=depth,
            device=device,
        )
        return FramePicture(image=image, is_hand=(depth > 0.0) & (image.alpha < 0.5))
