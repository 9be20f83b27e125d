"""A run as scripts, the command line and the viewer hold it: its measures and its object."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

from physhandi.data.files import named_fields
from physhandi.data.layout import METRICS_FILE
from physhandi.data.run import RunFolder
from physhandi.data.run_folder import PartsFile, checked

if TYPE_CHECKING:
    from physhandi.fitted_object import FittedObject
    from physhandi.viewer_process import ViewerProcess


def warnings_in(metrics: Mapping[str, Any]) -> list[dict[str, str]]:
    """Collect the warnings of all sequences from what ``metrics.json`` holds.

    Returns:
        For each ``sequence code message``.
    """
    collected: list[dict[str, str]] = []
    for name, scores in metrics.items():
        listed = (named_fields(scores) or {}).get("warnings")
        for warning in cast("list[Any]", listed) if isinstance(listed, list) else []:
            fields = named_fields(warning) or {}
            texts = {key: str(fields.get(key, "")) for key in ("code", "message")}
            collected.append({"sequence": name, **texts})
    return collected


class Run(RunFolder):
    """One execution of the pipeline: its folder, its measures and the object that it fitted."""

    @property
    def metrics(self) -> dict[str, Any]:
        """The measures of each sequence by its name (docs/metrics.md).

        Raises:
            RunError: If the run has not been measured yet, or what it holds is damaged.
        """
        return dict(checked(self.json(METRICS_FILE), PartsFile, self.out / METRICS_FILE))

    @property
    def warnings(self) -> list[dict[str, str]]:
        """Warnings about the fit: ``sequence code message`` each (docs/metrics.md).

        Empty if there is nothing, if the run has not been measured yet, or if a version measured it
        that looked for no doubts.

        Raises:
            RunError: If what it holds is damaged.
        """
        return warnings_in(self.metrics) if self.has(METRICS_FILE) else []

    @property
    def object(self) -> "FittedObject":
        """The fitted object in the run's first sequence, which can be simulated again.

        Raises:
            MissingInputError: If the run has no fitted object.
        """
        return self.object_in(self.sequence_names[0])

    def object_in(self, sequence: str) -> "FittedObject":
        """Load the fitted object in one of the run's sequences.

        Args:
            sequence: Name of the sequence.

        Raises:
            MissingInputError: If the run has no fitted object for that sequence.
        """
        from physhandi.fitted_object import FittedObject

        return FittedObject.of(self, sequence)

    def show(self, *, opens_browser: bool = True) -> "ViewerProcess":
        """Show the run in the viewer, which a child process serves on this machine alone.

        Args:
            opens_browser: Whether to open the page in the user's browser too.

        Returns:
            The process: ``url`` to open, ``stop()`` to end it. It ends with this program.

        Raises:
            RunError: If the viewer cannot be started; says why.
        """
        from physhandi.viewer_process import show_run

        return show_run(self, opens_browser=opens_browser)
