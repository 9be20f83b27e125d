"""Shows how the object moves as it is fitted, mostly from simulations that are made anyway."""

import math
from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor, where

from physhandi.fitting.object_problem import ObjectProblem
from physhandi.progress import Preview, Progress


class RolloutPreview:
    """Hands simulated motions on to whoever watches."""

    def __init__(self, stage: str, progress: Progress) -> None:
        """Prepare.

        Args:
            stage: Name of the stage.
            progress: Says when it is time for a preview, and takes it.
        """
        self._stage = stage
        self._progress = progress
        self._seen: tuple[ObjectProblem, Tensor, Tensor | None] | None = None

    def see(
        self,
        problem: ObjectProblem,
        node: Float[Tensor, "frame node 3"],
        control: Float[Tensor, "frame control 3"] | None = None,
    ) -> None:
        """Take note of a simulated motion; of several sequences the first one is shown.

        Args:
            problem: The sequence.
            node: Its object nodes [m].
            control: Its control nodes, if they are not those of the problem [m].
        """
        if self._seen is None or self._seen[0].name == problem.name:
            self._seen = problem, node, control

    def show(self, loss: float) -> None:
        """Show the motion seen last, if it is time.

        Args:
            loss: Its loss [m²].
        """
        if self._seen is not None and self._progress.wants_preview():
            problem, node, control = self._seen
            self._progress.preview(lambda: self._preview(problem, loss, node, control))

    def show_made(
        self,
        problem: ObjectProblem,
        loss: float,
        make: Callable[[], Float[Tensor, "frame node 3"]],
    ) -> None:
        """Show a motion that is simulated for this alone, if it is time; the rarer the longer.

        Args:
            problem: The sequence.
            loss: Loss of the motion [m²].
            make: Simulates it.
        """
        if self._progress.wants_preview():
            self._progress.preview(lambda: self._preview(problem, loss, make()))

    def _preview(
        self,
        problem: ObjectProblem,
        loss: float,
        node: Float[Tensor, "frame node 3"],
        control: Float[Tensor, "frame control 3"] | None = None,
    ) -> Preview:
        frames = len(node)
        moved = problem.control[:frames] if control is None else control.detach().cpu().numpy()
        # Markers have no cloud, but tracks.
        point, is_known = problem.cloud, problem.is_observed
        if not point.shape[1]:
            point, is_known = problem.track, problem.is_valid
        unknown = point.new_tensor(math.nan)
        seen = where(is_known[:frames, :, None], point[:frames], unknown)
        return Preview(
            stage=self._stage,
            sequence=problem.name,
            loss=loss,
            frame_rate=problem.frame_rate,
            points={
                "object": node.detach().cpu().numpy(),
                "control": moved,
                "seen": seen.cpu().numpy(),
            },
        )
