"""Keeping the edits in force under a name, and choosing kept ones."""

from typing import Any

import viser

from app.viewer.physics.edit_presets import EditPreset, ObjectMark, RecordingMark
from app.viewer.physics.keep_panel import UserStorage
from app.viewer.physics.kept_choice import KeptChoice, OwnKept
from app.viewer.physics.panel import PhysicsPanel
from app.viewer.physics.presets import AS_FITTED
from app.viewer.ui.guard import Guard, notify
from physhandi.object_rollout import ObjectRollout


class EditPresetPanel:
    """A list of the edits that users have kept, and what keeps those in force."""

    def __init__(
        self,
        gui: viser.GuiApi,
        guard: Guard,
        physics: PhysicsPanel,
        *,
        fitted: ObjectRollout,
        recording: str,
        storage: UserStorage,
    ) -> None:
        """Add the controls where the caller stands.

        Args:
            gui: Where to.
            guard: Wraps the callbacks.
            physics: Keeps the edits with its parameters, and has them simulated.
            fitted: The object's fitted rollout.
            recording: What its recording is called.
            storage: Where edits are kept.
        """
        self._physics = physics
        self._fitted = fitted
        self._object = ObjectMark.of(fitted)
        self._recording = RecordingMark.of(fitted, recording)
        self._storage = storage
        self._choice = KeptChoice(
            gui,
            guard,
            "Kept edits",
            "Edits in place of all in force, on an object with the same nodes and springs; ★ are "
            "your own",
            offered=self._offered,
            is_in_force=self._is_in_force,
            choose=self._apply,
        )
        self._name: Any = gui.add_text("Name of edits", "", hint="The same name replaces")
        keep: Any = gui.add_button("Keep edits", hint="For every scene of this server")
        keep.on_click(guard(self._keep))
        self._own = OwnKept(
            gui,
            guard,
            self._choice,
            store=storage.edit_presets,
            what="edits",
            tell=lambda: storage.tell("delete edits"),
        )
        physics.follow(self._show)

    def close(self) -> None:
        """Stop listening to what others keep."""
        self._physics.follow(lambda: None)
        self._own.close()

    def _offered(self) -> tuple[tuple[EditPreset, ...], tuple[str, ...]]:
        own, problems = self._storage.edit_presets.presets()
        fitted = self._preset(AS_FITTED, is_own=False)
        return (fitted, *own), problems

    def _preset(self, name: str, *, is_own: bool) -> EditPreset:
        """Give the edits in force as a user's preset, or the fitted ones."""
        history = self._physics.history
        return EditPreset(
            name=name,
            edits=history.setting.edits if is_own else history.begin.edits,
            object=self._object,
            recording=self._recording,
            is_own=is_own,
        )

    def _is_in_force(self, preset: EditPreset) -> bool:
        is_same = preset.edits == self._physics.history.setting.edits
        return is_same and not preset.misfit(self._object, self._recording)

    def _apply(self, preset: EditPreset) -> None:
        preset.check(self._fitted, self._recording.name)
        name = f"“{preset.name}”" if preset.is_own else preset.name
        self._physics.put_edits(preset.edits, f"Edits {name}")

    def _keep(self, event: Any) -> None:
        storage = self._storage
        preset = storage.edit_presets.save(self._preset(self._name.value, is_own=True))
        storage.tell("keep edits")
        self._choice.want(preset.label)
        self._own.show()
        notify(event.client, "Edits kept", preset.name, color="blue")

    def _show(self) -> None:
        self._choice.show()
        self._own.show()
