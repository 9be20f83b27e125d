"""Choosing a preset, and keeping what sliders have found as a preset or as a run."""

import html
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
from app.viewer.physics.edit_presets import EditPresetStore
from app.viewer.physics.history import History
from app.viewer.physics.kept_choice import KeptChoice, OwnKept, write_small
from app.viewer.physics.presets import Preset, PresetStore, builtin_presets
from app.viewer.ui.guard import Guard, notify
from physhandi.data.layout import PARAMETERS_FILE
from physhandi.data.run_folder import new_run_id
from physhandi.data.sequence_meta import LONGEST_NAME, SAFE_NAME, safe_name
from physhandi.errors import UsageError
from physhandi.fitting.stored_edits import describe_edits, store_edits
from physhandi.fitting.stored_take import StoredTake, keeps_springs
from physhandi.run import Run
from physhandi.simulation.edits import Edits
from physhandi.simulation.parameters import SimulationParameters, parameter_changes

_POLL_S = 0.3
_MOST_LETTERS = 80


@dataclass(frozen=True, kw_only=True)
class SavedRun:
    """Progress of a run that was saved from a live scene."""

    id: str
    """Its id; its page is ``/runs/<id>``."""
    name: str
    """Its name, as the user gave it."""
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
        start: Callable[[Callable[[], Run]], Run],
        sequences: Path | None = None,
    ) -> None:
        """Prepare.

        Args:
            catalog: Finds the run that was shown, and its recordings.
            folder: Where runs are made.
            start: Makes a run by what it is given, and has a worker begin with it at once.
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
        parameters = {"parameters": dict(changes)}
        if edits is None:
            return self._simulate(source, recording.folder, name, parameters)
        return self._simulate(
            source,
            recording.folder,
            name,
            {"edits": describe_edits(edits)} | parameters,
            lambda folder: store_edits(folder, edits),
        )

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
        safe = safe_name(name, longest=None, joins_unsafe=True).strip("_")[:LONGEST_NAME]
        folder = self._sequences / safe
        if not SAFE_NAME.fullmatch(folder.name) or folder == self._sequences:
            raise UsageError("Type a name with letters or digits for the recording.")
        if folder.exists() or (BUNDLED / folder.name).exists():
            raise UsageError(f"There is a recording '{folder.name}' already. Type another name.")
        source = self._catalog.run(source_id)
        if keeps_springs(source):  # What is steered of such an object is an edited one, too.
            stored = replace(stored, take=replace(stored.take, is_edited=True))
        config = {"parameters": dict(changes), "take": stored.to_dict()}
        return self._simulate(source, folder, name, config, stored.save)

    def _simulate(
        self,
        source: Run,
        recording: Path,
        name: str,
        config: Mapping[str, Any],
        store: Callable[[Path], None] | None = None,
    ) -> Run:
        """Make a run of a source's object and have it worked on.

        Args:
            source: The run whose object is simulated.
            recording: Folder of the recording that it is measured by.
            name: What the user calls the new run.
            config: What its configuration says beside the source.
            store: Writes into its folder what the configuration describes; None for nothing.
        """

        def make() -> Run:
            run = Run.create(
                self._folder / new_run_id(),
                name=name,
                kind="simulation",
                sequences=[str(recording)],
                config={"source": str(source.folder.resolve()), **config},
            )
            if store is not None:
                store(run.folder)
            return run

        return self._start(make)

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


@dataclass(frozen=True)
class UserStorage:
    """Storage of a server for runs and presets that users of its scenes keep."""

    presets: PresetStore
    """Their presets."""
    edit_presets: EditPresetStore
    """Their presets of edits."""
    saver: RunSaver
    """Makes runs."""
    note: Callable[[str, str, str | None], None] = lambda _owner, _what, _run: None
    """Told who has kept or deleted what, and the id of the run that it became."""
    owner: str = ""
    """Whose scene it is that keeps things."""

    def tell(self, what: str, run: Run | None = None) -> None:
        """Have noted what was just done."""
        self.note(self.owner, what, None if run is None else run.id)


class PresetChoice(KeptChoice[Preset]):
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

        def suitable() -> tuple[list[Preset], tuple[str, ...]]:
            own, problems = store.presets() if store is not None else ((), ())
            every = (*builtin_presets(), *own)
            return [p for p in every if p.suits(history.start, length_unit)], problems

        super().__init__(
            gui,
            guard,
            "Preset",
            "Changes made to the fitted parameters, all at once; ★ are your own",
            offered=suitable,
            is_in_force=lambda preset: preset.apply(history.start) == history.setting[:2],
            choose=lambda preset: choose(*preset.apply(history.start)),
        )


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
            self._progress: Any = gui.add_html("", visible=False)
            self._own = OwnKept(
                gui,
                guard,
                choice,
                store=storage.presets,
                what="preset",
                tell=lambda: storage.tell("delete a preset"),
            )
        buttons.on_click(guard(self._press))

    def show(self) -> None:
        """Offer to delete the preset in force, if it is a user's."""
        self._own.show()

    def show_run(self, run: SavedRun) -> None:
        """Write how far a saved run is, with a link to it."""
        write_small(self._progress, saved_html(run))

    def remove(self) -> None:
        """Take the folder away."""
        self._folder.remove()

    def close(self) -> None:
        """Stop listening."""
        self._closed.set()
        self._own.close()

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
        text = preset.name
        if history.setting.edits:
            text += ": the parameters. Edits are kept in the tab Edit, or with a run."
        notify(event.client, "Preset saved", text, color="blue")
