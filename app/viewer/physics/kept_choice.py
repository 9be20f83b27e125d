"""The list of what is kept under names: one of it is chosen, and a user's own is deleted."""

import html
import threading
from collections.abc import Callable, Sequence
from typing import Any, Generic, Protocol, TypeVar

import viser

from app.viewer.physics.kept_files import KeptFiles, Named
from app.viewer.physics.presets import AS_FITTED, BY_HAND
from app.viewer.ui.followed import FollowedChoice
from app.viewer.ui.guard import Guard, notify
from physhandi.errors import UsageError

_PROBLEMS = 3


class Offered(Named, Protocol):
    """Something that a list offers."""

    @property
    def label(self) -> str:
        """Its entry in the list."""
        ...

    @property
    def is_own(self) -> bool:
        """Whether a user keeps it, so that it can be deleted."""
        ...


Listed = TypeVar("Listed", bound=Offered)


class KeptChoice(Generic[Listed]):
    """A list that names what is in force, and brings into force what is chosen from it."""

    def __init__(
        self,
        gui: viser.GuiApi,
        guard: Guard,
        label: str,
        hint: str,
        *,
        offered: Callable[[], tuple[Sequence[Listed], tuple[str, ...]]],
        is_in_force: Callable[[Listed], bool],
        choose: Callable[[Listed], None],
    ) -> None:
        """Add the list where the caller stands.

        Args:
            gui: Where to.
            guard: Wraps the callbacks.
            label: What the list is called.
            hint: What it is for.
            offered: Reads what it offers, and what is wrong with files of users.
            is_in_force: Tells whether something has what is in force.
            choose: Called with what a user chose.
        """
        self._offered = offered
        self._is_in_force = is_in_force
        self._choose = choose
        self._listed: dict[str, Listed] = {}
        self._wanted = AS_FITTED
        self._turn = threading.Lock()
        self.problems: tuple[str, ...] = ()
        """Problems of users' files."""
        choice: Any = gui.add_dropdown(label, (AS_FITTED, BY_HAND), hint=hint)
        choice.on_update(guard.by_user(lambda _: self._take_choice()))
        self._choice = FollowedChoice(choice, guard)
        self.refresh()

    def refresh(self) -> None:
        """Read again what is offered."""
        offered, self.problems = self._offered()
        self._listed = {entry.label: entry for entry in offered}
        self._choice.offer((*self._listed, BY_HAND))
        self.show()

    def show(self) -> None:
        """Name what is in force."""
        with self._turn:  # What is shown last must be what was read last.
            chosen = self.chosen
            self._choice.show(BY_HAND if chosen is None else chosen.label)

    @property
    def chosen(self) -> Listed | None:
        """The current entry, if there is one; of several the one that was chosen."""
        listed = self._listed
        wanted = listed.get(self._wanted)
        if wanted is not None and self._is_in_force(wanted):
            return wanted
        return next(filter(self._is_in_force, listed.values()), None)

    def want(self, label: str) -> None:
        """Name this one as long as it is in force."""
        self._wanted = label
        self.show()

    def _take_choice(self) -> None:
        entry = self._listed.get(self._choice.read())
        if entry is None:
            self.show()  # "By hand" is what the list says, nothing to choose.
            return
        self._wanted = entry.label
        try:
            self._choose(entry)
        finally:
            self.show()  # What was refused is not in force.


class OwnKept(Generic[Listed]):
    """Below a list of what is kept: deletes a user's own, and tells of damaged files."""

    def __init__(
        self,
        gui: viser.GuiApi,
        guard: Guard,
        choice: KeptChoice[Listed],
        *,
        store: KeptFiles[Listed],
        what: str,
        tell: Callable[[], None],
    ) -> None:
        """Add button and text where the caller stands, and follow what users keep.

        Args:
            gui: Where to.
            guard: Wraps the callbacks.
            choice: The list.
            store: Keeps what is listed.
            what: What one of it is called on the button.
            tell: Called when something was deleted.
        """
        self._choice = choice
        self._store = store
        self._what = what
        self._tell = tell
        self._delete: Any = gui.add_button(f"Delete {what}", color="gray", visible=False)
        self._problems: Any = gui.add_html("", visible=False)
        self._delete.on_click(guard(self._remove))
        self._unsubscribe = store.subscribe(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        """Show what users have kept as it is now."""
        self._choice.refresh()
        problems = self._choice.problems
        lines = [f"⚠ {html.escape(problem)}" for problem in problems[:_PROBLEMS]]
        if len(problems) > _PROBLEMS:
            lines.append(f"… and {len(problems) - _PROBLEMS} more")
        write_small(self._problems, "<br/>".join(lines))
        self.show()

    def show(self) -> None:
        """Offer to delete what is in force, if it is a user's."""
        chosen = self._choice.chosen
        is_own = chosen is not None and chosen.is_own
        if chosen is not None and is_own:
            self._delete.label = f"Delete {self._what} “{chosen.name}”"
        if self._delete.visible != is_own:
            self._delete.visible = is_own

    def close(self) -> None:
        """Stop following."""
        self._unsubscribe()

    def _remove(self, event: Any) -> None:
        chosen = self._choice.chosen
        if chosen is None or not chosen.is_own:
            raise UsageError("Choose one of your own first; the program's stay.")
        self._store.delete(chosen.name)
        self._tell()
        notify(event.client, f"{self._what.capitalize()} deleted", chosen.name, color="blue")


def write_small(place: Any, content: str) -> None:
    """Write small print; without content it takes no room."""
    style = "font-size:0.8em;line-height:1.4;padding:0 0.5em"
    place.content = f"<div style='{style}'>{content}</div>"
    place.visible = bool(content)
