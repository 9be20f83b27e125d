"""The parameters and edits that were tried in a session, with undo and redo."""

from typing import Any, NamedTuple

from physhandi.simulation.edits import Edits
from physhandi.simulation.parameters import SimulationParameters

MOST_STEPS = 50
"""Steps that are kept; the oldest go first. `History.reset` needs none of them."""


class TriedSetting(NamedTuple):
    """Setting of a simulation."""

    parameters: SimulationParameters
    """Their number of substeps is that in force before the automatic choice."""
    is_automatic: bool = False
    """Whether the number of substeps is chosen automatically."""
    edits: Edits = ()
    """Edits of single springs and nodes."""


class History:
    """The settings that were tried; one gesture is one step.

    A gesture moves one control, however far and slowly: from a pointer's going down to its going
    up, while a key is held, or while a number is typed. Where it ends is told by the page; without
    a page, changes of one control are one step until another control is used. Changed by one
    thread at a time; `setting` may be read by any.
    """

    def __init__(self, start: SimulationParameters, edits: Edits = ()) -> None:
        """Begin with the fitted parameters.

        Args:
            start: The fitted parameters, to which `reset` returns.
            edits: Those of the fitted object, likewise.
        """
        self.start = start
        self.begin = self.setting = TriedSetting(start, edits=edits)
        """The current setting, `begin` at first."""
        self._steps = [self.setting]
        self._index = 0
        self._before = 0
        """Index of the step that the gesture started from."""
        self._gesture: tuple[str, int] | None = None

    @property
    def current(self) -> SimulationParameters:
        """The parameters in force."""
        return self.setting.parameters

    @property
    def is_automatic(self) -> bool:
        """Whether the number of substeps is chosen automatically."""
        return self.setting.is_automatic

    @property
    def steps(self) -> tuple[TriedSetting, ...]:
        """All settings that can be returned to, in the order in which they were tried."""
        return tuple(self._steps)

    @property
    def index(self) -> int:
        """Index of the current step."""
        return self._index

    def set(self, field: str, value: Any, *, gesture: int = 0) -> TriedSetting:
        """Change one parameter, as a control does that is being moved.

        Args:
            field: Name of the parameter.
            value: Its new value.
            gesture: Number of the gesture; another one is another step.
        """
        changed = self.setting._replace(parameters=self.current.replace(**{field: value}))
        if field == "substeps_per_frame":
            changed = changed._replace(is_automatic=False)
        return self._put(changed, (field, gesture))

    def replace(
        self, parameters: SimulationParameters, *, is_automatic: bool = False
    ) -> TriedSetting:
        """Change all parameters at once; edits stay."""
        return self._put(TriedSetting(parameters, is_automatic, self.setting.edits), None)

    def edit(self, edits: Edits) -> TriedSetting:
        """Change what is done to single springs and nodes; this is a step of its own."""
        return self._put(self.setting._replace(edits=edits), None)

    def choose_substeps(self, *, is_automatic: bool) -> TriedSetting:
        """Have the number of substeps chosen automatically, or take the fitted one."""
        number = self.start.substeps_per_frame
        changed = self.current.replace(substeps_per_frame=number)
        return self.replace(changed, is_automatic=is_automatic)

    def put_back(self, *fields: str) -> TriedSetting:
        """Give some parameters their fitted values again."""
        fitted = {field: getattr(self.start, field) for field in fields}
        is_automatic = self.is_automatic and "substeps_per_frame" not in fields
        return self.replace(self.current.replace(**fitted), is_automatic=is_automatic)

    def undo(self) -> TriedSetting:
        """Take the last change back."""
        return self.go(self._index - 1)

    def redo(self) -> TriedSetting:
        """Make the change again that was taken back last."""
        return self.go(self._index + 1)

    def go(self, index: int) -> TriedSetting:
        """Return to one of the `steps`, the nearest if there is none of that index."""
        self._gesture = None
        self._index = min(max(index, 0), len(self._steps) - 1)
        self.setting = self._steps[self._index]
        return self.setting

    def reset(self) -> TriedSetting:
        """Return to the fitted parameters and edits; this can be undone."""
        return self._put(self.begin, None)

    def _put(self, setting: TriedSetting, gesture: tuple[str, int] | None) -> TriedSetting:
        """Bring a setting into force; what a gesture has set before gives way to it."""
        if setting == self.setting:
            return setting
        if gesture is None or gesture != self._gesture:
            self._before = self._index
        self._gesture = gesture
        # A gesture that ends where it began is no step.
        now = [setting] if setting != self._steps[self._before] else []
        self._steps[self._before + 1 :] = now
        surplus = max(len(self._steps) - MOST_STEPS, 0)
        del self._steps[:surplus]
        self._before -= surplus
        self._index = len(self._steps) - 1
        self.setting = setting
        return setting
