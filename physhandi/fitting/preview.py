"""Previews of the simulated object during a fit."""

import logging
import math
from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor, where

from physhandi.errors import SimulationDivergedError
from physhandi.fitting.object_problem import ObjectProblem
from physhandi.progress import Preview, Progress

logger = logging.getLogger(__name__)


class RolloutPreview:
    """Sends simulated motions of one stage to the progress receiver, when it wants a preview.

    Most are rollouts that the fit computes anyway (`update`, then `show`).
    """

    def __init__(self, stage: str, progress: Progress) -> None:
        self._stage = stage
        self._progress = progress
        self._latest: tuple[ObjectProblem, Tensor, Tensor | None] | None = None

    def update(
        self,
        problem: ObjectProblem,
        node: Float[Tensor, "frame node 3"],
        control: Float[Tensor, "frame control 3"] | None = None,
    ) -> None:
        """Remember a simulated motion; of several sequences only the first is shown.

        Args:
            problem: The sequence.
            node: Its object nodes [m].
            control: Its control nodes, if they differ from those of the problem [m].
        """
        if self._latest is None or self._latest[0].name == problem.name:
            self._latest = problem, node, control

    def show(self, loss: float) -> None:
        """Show the remembered motion and its loss [m²], if a preview is due."""
        if self._latest is not None and self._progress.wants_preview():
            problem, node, control = self._latest
            self._progress.preview(lambda: self._preview(problem, loss, node, control))

    def show_simulated(
        self,
        problem: ObjectProblem,
        loss: float,
        simulate: Callable[[], Float[Tensor, "frame node 3"]],
    ) -> None:
        """Simulate a motion for the preview alone and show it with its loss [m²], if one is due.

        One that diverges is not shown: what holds in a batch of candidates may not do so alone.
        """
        if not self._progress.wants_preview():
            return
        try:
            node = simulate()
        except SimulationDivergedError as error:
            logger.warning("%s: there is no preview. %s", self._stage, error)
            return
        self._progress.preview(lambda: self._preview(problem, loss, node))

    def _preview(
        self,
        problem: ObjectProblem,
        loss: float,
        node: Float[Tensor, "frame node 3"],
        control: Float[Tensor, "frame control 3"] | None = None,
    ) -> Preview:
        frames = len(node)
        moved = problem.control[:frames] if control is None else control.detach().cpu().numpy()
        # A sequence of markers has tracks and no cloud.
        point, is_known = problem.cloud, problem.is_observed
        if not point.shape[1]:
            point, is_known = problem.track, problem.is_valid
        unknown = point.new_tensor(math.nan)
        observed = where(is_known[:frames, :, None], point[:frames], unknown)
        return Preview(
            stage=self._stage,
            sequence=problem.name,
            loss=loss,
            frame_rate=problem.frame_rate,
            points={
                "object": node.detach().cpu().numpy(),
                "control": moved,
                "seen": observed.cpu().numpy(),
            },
        )
