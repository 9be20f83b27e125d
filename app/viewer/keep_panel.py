"""Choosing a preset, and keeping what sliders have found as a preset or as a run."""

import html
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import viser

from app.viewer.followed import FollowedChoice
from app.viewer.guard import Guard, notify
from app.viewer.history import History
from app.viewer.preset_store import PresetStore
from app.viewer.presets import AS_FITTED, BY_HAND, Preset, builtin_presets, changes_of
from app.viewer.save_run import RunSaver, SavedRun
from physhandi.errors import UsageError

_PRESET, _RUN = "Preset", "Run"
_PROBLEMS = 3


@dataclass(frozen=True)
class Keeping:
    """Where a server keeps what users of its scenes have found."""

    presets: PresetStore
    """Their presets."""
    saver: RunSaver
    """Makes runs."""


class PresetChoice:
    """The list of presets."""

    def __init__(
        self,
        gui: viser.GuiApi,
        guard: Guard,
        history: History,
        *,
        length_unit: str,
        store: PresetStore | None,
        moved: Callable[[], None],
    ) -> None:
        """Add the list where the caller stands.

        Args:
            gui: Where to.
            guard: Wraps the callbacks.
            history: Keeps the parameters.
            length_unit: Unit of the scene's lengths.
            store: The users' presets; None for built-in ones only.
            moved: Called when a user has chosen one.
        """
        self._history = history
        self._unit = length_unit
        self._store = store
        self._moved = moved
        self._presets: dict[str, Preset] = {}
        self._wanted = AS_FITTED
        self._turn = threading.Lock()
        self.problems: tuple[str, ...] = ()
        """What is wrong with files among the users' presets."""
        choice: Any = gui.add_dropdown(
            "Preset",
            (AS_FITTED, BY_HAND),
            hint="Changes made to the fitted parameters, all at once; ★ are your own",
        )
        choice.on_update(guard.by_user(lambda _: self._choose()))
        self._choice = FollowedChoice(choice, guard)
        self.refresh()

    def refresh(self) -> None:
        """Read the users' presets again."""
        own, self.problems = self._store.presets() if self._store is not None else ((), ())
        fitted = self._history.start
        suitable = [p for p in (*builtin_presets(), *own) if p.suits(fitted, self._unit)]
        self._presets = {preset.label: preset for preset in suitable}
        self._choice.offer((*self._presets, BY_HAND))
        self.show()

    def show(self) -> None:
        """Name the preset in force."""
        with self._turn:  # What is shown last must be what was read last.
            chosen = self.chosen
            self._choice.show(BY_HAND if chosen is None else chosen.label)

    @property
    def chosen(self) -> Preset | None:
        """The preset whose parameters are in force, if there is one; of several that was chosen."""
        now = (self._history.current, self._history.is_automatic)
        fits = {n: p for n, p in self._presets.items() if p.apply(self._history.start) == now}
        return fits.get(self._wanted, next(iter(fits.values()), None))

    def want(self, label: str) -> None:
        """Name this preset as long as its parameters are in force."""
        self._wanted = label
        self.show()

    def _choose(self) -> None:
        preset = self._presets.get(self._choice.take())
        if preset is None:
            self.show()  # "By hand" is what the list says, nothing to choose.
            return
        self._wanted = preset.label
        parameters, is_automatic = preset.apply(self._history.start)
        self._history.replace(parameters, is_automatic=is_automatic)
        self._moved()


class KeepPanel:
    """A name, and buttons that keep the parameters under it."""

    def __init__(
        self,
        gui: viser.GuiApi,
        guard: Guard,
        history: History,
        *,
        choice: PresetChoice,
        length_unit: str,
        keeping: Keeping,
        save: Callable[[str], None],
    ) -> None:
        """Add the folder where the caller stands.

        Args:
            gui: Where to.
            guard: Wraps the callbacks.
            history: Keeps the parameters.
            choice: The list of presets.
            length_unit: Unit of the scene's lengths.
            keeping: Where things are kept.
            save: Makes a run of a name out of what is on the screen.
        """
        self._history = history
        self._choice = choice
        self._unit = length_unit
        self._store = keeping.presets
        self._save = save
        with gui.add_folder("Keep", expand_by_default=False):
            self._name: Any = gui.add_text("name", "", hint="Of the preset or the run")
            buttons = gui.add_button_group(
                "Save as",
                (_PRESET, _RUN),
                hint="A preset is for every scene of this server; a run keeps motion and metrics",
            )
            self._delete: Any = gui.add_button("Delete preset", color="gray", visible=False)
            self._told: Any = gui.add_html("", visible=False)
            self._bad: Any = gui.add_html("", visible=False)
        buttons.on_click(guard(self._press))
        self._delete.on_click(guard(self._remove))
        self._unsubscribe = self._store.subscribe(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        """Show the users' presets as they are now."""
        self._choice.refresh()
        problems = self._choice.problems
        lines = [f"⚠ {html.escape(problem)}" for problem in problems[:_PROBLEMS]]
        if len(problems) > _PROBLEMS:
            lines.append(f"… and {len(problems) - _PROBLEMS} more")
        _say(self._bad, "<br/>".join(lines))
        self.show()

    def show(self) -> None:
        """Offer to delete the preset in force, if it is a user's."""
        chosen = self._choice.chosen
        is_own = chosen is not None and chosen.is_own
        if chosen is not None and is_own:
            self._delete.label = f"Delete preset “{chosen.name}”"
        if self._delete.visible != is_own:
            self._delete.visible = is_own

    def tell(self, run: SavedRun) -> None:
        """Say how far a saved run is, with a link to it."""
        name = html.escape(run.name)
        link = f"<a href='/runs/{run.id}' target='_blank' rel='noopener'>{name}</a>"
        said = {
            "queued": f"Saving run {link}…",
            "running": f"Simulating and measuring run {link}…",
            "succeeded": f"✓ Saved as run {link}",
            "cancelled": f"Run {link} was cancelled.",
        }
        error = html.escape(run.error or "See its page.")
        _say(self._told, said.get(run.state, f"✗ Run {link} failed: {error}"))

    def close(self) -> None:
        """Stop listening."""
        self._unsubscribe()

    def _press(self, event: Any) -> None:
        if event.target.value == _RUN:
            self._save(self._name.value)
            return
        history = self._history
        changes = changes_of(history.start, history.current, is_automatic=history.is_automatic)
        preset = self._store.save(self._name.value, changes, self._unit)
        self._choice.want(preset.label)
        self.show()
        notify(event.client, "Preset saved", preset.name, color="blue")

    def _remove(self, event: Any) -> None:
        chosen = self._choice.chosen
        if chosen is None or not chosen.is_own:
            raise UsageError("Choose one of your own presets first; the program's stay.")
        self._store.delete(chosen.name)
        notify(event.client, "Preset deleted", chosen.name, color="blue")


def _say(place: Any, content: str) -> None:
    """Write small print; without content it takes no room."""
    style = "font-size:0.8em;line-height:1.4;padding:0 0.5em"
    place.content = f"<div style='{style}'>{content}</div>"
    place.visible = bool(content)
