"""Choosing a preset, and keeping what sliders have found as a preset or as a run."""

import html
import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import viser

from app.jobs.catalog import Catalog
from app.settings import BUNDLED
from app.viewer.content.content import Content
from app.viewer.live.client import LiveRollouts
from app.viewer.physics.history import History
from app.viewer.physics.presets import (
    AS_FITTED,
    BY_HAND,
    Preset,
    PresetStore,
    builtin_presets,
)
from app.viewer.ui.followed import FollowedChoice
from app.viewer.ui.guard import Guard, notify
from physhandi.data.layout import PARAMETERS_FILE
from physhandi.data.run_folder import new_run_id
from physhandi.data.sequence_meta import SAFE_NAME
from physhandi.errors import UsageError
from physhandi.fitted_object import keeps_springs
from physhandi.fitting.stored_edits import describe_edits, store_edits
from physhandi.fitting.stored_take import StoredTake
from physhandi.run import Run
from physhandi.simulation.edits import Edits
from physhandi.simulation.parameters import SimulationParameters, parameter_changes

_POLL_S = 0.3
_MOST_LETTERS = 80
_MOST_OF_FOLDER = 64
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]+")


@dataclass(frozen=True, kw_only=True)
class SavedRun:
    """How far a run is that was saved from a live scene."""

    id: str
    """Its id; its page is ``/runs/<id>``."""
    name: str
    """What the user calls it."""
    state: str
    """``"queued"`` or ``"running"``, in the end ``"succeeded"``, ``"failed"``, ``"cancelled"``."""
    error: str | None = None
    """Why it failed, if it did."""

    @property
    def is_over(self) -> bool:
        """Whether nothing more will happen to it."""
        return self.state in {"succeeded", "failed", "cancelled"}


class RunSaver:
    """Makes runs of kind ``simulation``, as `physhandi simulate` does, and has them worked on.

    A worker process simulates again and measures, so that a long object stalls nobody; the same
    parameters give the same motion.
    """

    def __init__(
        self,
        catalog: Catalog,
        folder: Path,
        start: Callable[[Run], None],
        sequences: Path | None = None,
    ) -> None:
        """Prepare.

        Args:
            catalog: Finds the run that was shown, and its recordings.
            folder: Where runs are made.
            start: Has a worker begin with a run at once.
            sequences: Where recordings are made; None for ``sequences`` beside the runs.
        """
        self._catalog = catalog
        self._folder = folder
        self._start = start
        self._sequences = folder.parent / "sequences" if sequences is None else sequences

    def save(
        self,
        source_id: str,
        sequence: str,
        name: str,
        changes: Mapping[str, Any],
        edits: Edits | None = None,
    ) -> Run:
        """Make a run and have it worked on.

        Args:
            source_id: Id of the run whose object was simulated.
            sequence: Which of its sequences.
            name: What the user calls the new run.
            changes: Parameters that differ from the source's; see `run_changes`.
            edits: What is done to single springs and nodes; None for the source's own edits.

        Raises:
            UsageError: If the name is empty or too long.
            SequenceError: If the recording is gone, without which nothing can be measured.
            OSError: If the run cannot be written.
        """
        name = _checked_name(name)
        source = self._catalog.run(source_id)
        recordings = self._catalog.sequences_of(source)
        recording = recordings[source.sequence_names.index(sequence)]
        run = Run.create(
            self._folder / new_run_id(),
            name=name,
            kind="simulation",
            sequences=[str(recording.folder)],
            config={
                "source": str(source.folder.resolve()),
                **({} if edits is None else {"edits": describe_edits(edits)}),
                "parameters": dict(changes),
            },
        )
        if edits is not None:
            store_edits(run.folder, edits)
        self._start(run)
        return run

    def save_take(
        self, source_id: str, stored: StoredTake, name: str, changes: Mapping[str, Any]
    ) -> Run:
        """Make a run that simulates what was steered, and have it worked on.

        The worker makes a recording of it first, called as the run, in letters that a folder has.

        Args:
            source_id: Id of the run whose object was steered.
            stored: What was steered.
            name: What the user calls the new run.
            changes: Parameters that differ from the source's; see `run_changes`.

        Raises:
            UsageError: If the name is empty, too long, or that of a recording.
            OSError: If the run cannot be written.
        """
        name = _checked_name(name)
        folder = self._sequences / _UNSAFE.sub("_", name).strip("_")[:_MOST_OF_FOLDER]
        if not SAFE_NAME.fullmatch(folder.name) or folder == self._sequences:
            raise UsageError("Type a name with letters or digits for the recording.")
        if folder.exists() or (BUNDLED / folder.name).exists():
            raise UsageError(f"There is a recording '{folder.name}' already. Type another name.")
        source = self._catalog.run(source_id)
        if keeps_springs(source):  # What is steered of such an object is an edited one, too.
            stored = replace(stored, take=replace(stored.take, is_edited=True))
        run = Run.create(
            self._folder / new_run_id(),
            name=name,
            kind="simulation",
            sequences=[str(folder)],
            config={
                "source": str(source.folder.resolve()),
                "parameters": dict(changes),
                "take": stored.to_dict(),
            },
        )
        stored.save(run.folder)
        self._start(run)
        return run

    def follow(
        self, run: Run, report: Callable[[SavedRun], None], is_closed: threading.Event
    ) -> threading.Thread:
        """Report how far a run is whenever that changes, until it ends or nobody listens.

        Args:
            run: A run that `save` made.
            report: Called in a thread of its own.
            is_closed: Set when nobody listens any more.
        """

        def watch() -> None:
            reported: SavedRun | None = None
            while not is_closed.is_set():
                now = SavedRun(id=run.id, name=run.name, state=run.state, error=run.error)
                if now != reported:
                    report(now)
                    reported = now
                if now.is_over:
                    return
                is_closed.wait(_POLL_S)

        thread = threading.Thread(target=watch, name=f"saving-{run.id}", daemon=True)
        thread.start()
        return thread


def _checked_name(name: str) -> str:
    """Give a name without surplus blanks, or say what is wrong with it."""
    name = " ".join(name.split())
    if not name or len(name) > _MOST_LETTERS:
        raise UsageError(f"Type a name of 1 to {_MOST_LETTERS} letters for the run first.")
    if not name.isprintable():
        raise UsageError("The run's name has a sign that cannot be printed. Type another one.")
    return name


def saved_html(run: SavedRun) -> str:
    """Say how far a saved run is, with a link to it."""
    name = html.escape(run.name)
    link = f"<a href='../../runs/{run.id}' target='_blank' rel='noopener'>{name}</a>"
    texts = {
        "queued": f"Saving run {link}…",
        "running": f"Simulating and measuring run {link}…",
        "succeeded": f"✓ Saved as run {link}",
        "cancelled": f"Run {link} was cancelled.",
    }
    error = html.escape(run.error or "See its page.")
    return texts.get(run.state, f"✗ Run {link} failed: {error}")


def run_changes(
    source: Run, fitted: SimulationParameters, now: SimulationParameters, *, is_automatic: bool
) -> dict[str, Any]:
    """Find what `physhandi simulate` must be told so that it simulates what is on the screen.

    Args:
        source: The run that is shown; its stored parameters are the ones that are changed.
        fitted: What the scene began with: those parameters in the world of its recording.
        now: What is on the screen.
        is_automatic: Whether its substeps are chosen automatically.
    """
    changes = parameter_changes(fitted, now, is_automatic=is_automatic)
    stored = SimulationParameters.from_dict(source.yaml(PARAMETERS_FILE))
    # A ground or gravity other than the recording's must not be taken from it again.
    for field, switch in (
        ("ground_height", "uses_sequence_ground"),
        ("gravity", "uses_sequence_gravity"),
    ):
        if field in changes and getattr(stored, switch):
            changes[switch] = False
    return changes


_PRESET, _RUN = "Preset", "Run"
_PROBLEMS = 3


@dataclass(frozen=True)
class UserStorage:
    """Where a server keeps what users of its scenes have found."""

    presets: PresetStore
    """Their presets."""
    saver: RunSaver
    """Makes runs."""
    note: Callable[[str, str, str | None], None] = lambda _owner, _what, _run: None
    """Told who has kept or deleted what, and the id of the run that it became."""
    owner: str = ""
    """Whose scene it is that keeps things."""

    def tell(self, what: str, run: Run | None = None) -> None:
        """Have noted what was just done."""
        self.note(self.owner, what, None if run is None else run.id)


class PresetChoice:
    """The list of presets in the physics panel."""

    def __init__(
        self,
        gui: viser.GuiApi,
        guard: Guard,
        history: History,
        *,
        length_unit: str,
        store: PresetStore | None,
        choose: Callable[[SimulationParameters, bool], None],
    ) -> None:
        """Add the list where the caller stands.

        Args:
            gui: Where to.
            guard: Wraps the callbacks.
            history: Keeps the parameters.
            length_unit: Unit of the scene's lengths.
            store: The users' presets; None for built-in ones only.
            choose: Called with the parameters of the preset that a user chose, and whether their
                substeps are automatic.
        """
        self._history = history
        self._unit = length_unit
        self._store = store
        self._choose = choose
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
        choice.on_update(guard.by_user(lambda _: self._take_choice()))
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
        now = self._history.setting[:2]
        fits = {n: p for n, p in self._presets.items() if p.apply(self._history.start) == now}
        return fits.get(self._wanted, next(iter(fits.values()), None))

    def want(self, label: str) -> None:
        """Name this preset as long as its parameters are in force."""
        self._wanted = label
        self.show()

    def _take_choice(self) -> None:
        preset = self._presets.get(self._choice.read())
        if preset is None:
            self.show()  # "By hand" is what the list says, nothing to choose.
            return
        self._wanted = preset.label
        self._choose(*preset.apply(self._history.start))


class KeepPanel:
    """A name, and buttons that keep the parameters under it as a preset or as a run."""

    def __init__(
        self,
        gui: viser.GuiApi,
        guard: Guard,
        history: History,
        rollouts: LiveRollouts,
        *,
        choice: PresetChoice,
        content: Content,
        run: Run,
        storage: UserStorage,
    ) -> None:
        """Add the folder where the caller stands.

        Args:
            gui: Where to.
            guard: Wraps the callbacks.
            history: Keeps the parameters.
            rollouts: What is on the screen.
            choice: The list of presets.
            content: What is shown.
            run: The run whose object is simulated.
            storage: Where things are kept.
        """
        self._history = history
        self._rollouts = rollouts
        self._choice = choice
        self._unit = content.length_unit
        self._sequence = content.sequence_name
        self._source = run
        self._storage = storage
        self._store = storage.presets
        self._closed = threading.Event()
        self._folder = gui.add_folder("Keep these parameters")
        with self._folder:
            self._name: Any = gui.add_text("name", "", hint="Of the preset or the run")
            buttons = gui.add_button_group(
                "Save as",
                (_PRESET, _RUN),
                hint="A preset is for every scene of this server; a run keeps motion and metrics",
            )
            self._delete: Any = gui.add_button("Delete preset", color="gray", visible=False)
            self._progress: Any = gui.add_html("", visible=False)
            self._problems: Any = gui.add_html("", visible=False)
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
        write_small(self._problems, "<br/>".join(lines))
        self.show()

    def show(self) -> None:
        """Offer to delete the preset in force, if it is a user's."""
        chosen = self._choice.chosen
        is_own = chosen is not None and chosen.is_own
        if chosen is not None and is_own:
            self._delete.label = f"Delete preset “{chosen.name}”"
        if self._delete.visible != is_own:
            self._delete.visible = is_own

    def show_run(self, run: SavedRun) -> None:
        """Write how far a saved run is, with a link to it."""
        write_small(self._progress, saved_html(run))

    def remove(self) -> None:
        """Take the folder away."""
        self._folder.remove()

    def close(self) -> None:
        """Stop listening."""
        self._closed.set()
        self._unsubscribe()

    def _press(self, event: Any) -> None:
        if event.target.value == _RUN:
            self._save_run(self._name.value)
        else:
            self._save_preset(event)

    def _save_run(self, name: str) -> None:
        """Have what is on the screen simulated and measured as a run of its own."""
        readout, setting = self._rollouts.readout, self._history.setting
        if readout.error is not None:
            raise UsageError(
                f"The simulation stopped at frame {readout.simulated_count}, and as a run it would "
                "too. Change the parameters until it reaches the end."
            )
        changes = run_changes(
            self._source,
            self._history.start,
            setting.parameters,
            is_automatic=setting.is_automatic,
        )
        edits = setting.edits if setting.edits != self._history.begin.edits else None
        saver = self._storage.saver
        run = saver.save(self._source.id, self._sequence, name, changes, edits)
        self._storage.tell("keep a run", run)
        saver.follow(run, self.show_run, self._closed)

    def _save_preset(self, event: Any) -> None:
        history = self._history
        changes = parameter_changes(
            history.start, history.current, is_automatic=history.is_automatic
        )
        preset = self._store.save(self._name.value, changes, self._unit)
        self._storage.tell("keep a preset")
        self._choice.want(preset.label)
        self.show()
        kept = preset.name
        if history.setting.edits:
            kept += ": the parameters. Edits are of this object alone; save them as a run."
        notify(event.client, "Preset saved", kept, color="blue")

    def _remove(self, event: Any) -> None:
        chosen = self._choice.chosen
        if chosen is None or not chosen.is_own:
            raise UsageError("Choose one of your own presets first; the program's stay.")
        self._store.delete(chosen.name)
        self._storage.tell("delete a preset")
        notify(event.client, "Preset deleted", chosen.name, color="blue")


def write_small(place: Any, content: str) -> None:
    """Write small print; without content it takes no room."""
    style = "font-size:0.8em;line-height:1.4;padding:0 0.5em"
    place.content = f"<div style='{style}'>{content}</div>"
    place.visible = bool(content)
