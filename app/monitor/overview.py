"""What there is to say about the machine, the queue and the program, as plain data."""

from dataclasses import asdict
from typing import Any

from app.jobs.catalog import Catalog
from app.jobs.describe import describe_run
from app.jobs.forecast import Forecast
from app.jobs.machine import Machine
from app.jobs.order import settings_of_run, shown_value
from app.jobs.scheduler import Scheduler
from app.settings import Settings
from physhandi.data.environment import describe_environment
from physhandi.errors import SettingsError, UsageError
from physhandi.fitting.overrides import apply_overrides, changes, values_of
from physhandi.fitting.profile import config_to_dict, load_profile
from physhandi.fitting.settings import GROUPS, all_settings


class Overview:
    """Describes the machine, its queue and the program."""

    def __init__(
        self, settings: Settings, catalog: Catalog, scheduler: Scheduler, machine: Machine
    ) -> None:
        """Prepare.

        Args:
            settings: What the server was told.
            catalog: Finds runs and sequences.
            scheduler: Knows what is at work and in line.
            machine: Measures the load.
        """
        self._settings = settings
        self._catalog = catalog
        self._scheduler = scheduler
        self._machine = machine
        about = describe_environment(settings.device)
        self._program = {
            name: about[name] for name in ("packages", "python", "system", "commit", "started")
        }

    def whole(self) -> dict[str, Any]:
        """Describe everything: `moving`, and what stays.

        Returns:
            `moving` with ``program`` (``packages python system commit started``), ``device`` of
            fits and ``data_dir``.
        """
        return self.moving() | {
            "program": self._program,
            "device": self._settings.device,
            "data_dir": str(self._settings.data_dir),
        }

    def moving(self) -> dict[str, Any]:
        """Describe what changes all the time.

        Returns:
            ``machine`` (see `Machine.load`), ``slots`` (``used total``), and the runs ``running``
            and ``waiting`` (see `describe_run`), the running ones with ``load`` (see
            `Machine.of_run`).
        """
        running: list[dict[str, Any]] = []
        for run in self._scheduler.at_work():
            described = describe_run(self._catalog.run_item(run.id), self._scheduler)
            running.append(described | {"load": self._machine.of_run(run.folder)})
        waiting = [
            describe_run(self._catalog.run_item(run.id), self._scheduler)
            for run in self._scheduler.in_line()
        ]
        return {
            "machine": self._machine.load(),
            "slots": {"used": len(running), "total": self._scheduler.slots},
            "running": running,
            "waiting": waiting,
        }


def describe_settings(catalog: Catalog, profile: str | None, run_id: str | None) -> dict[str, Any]:
    """List all settings with their values, to be changed one by one.

    Args:
        catalog: Finds the run.
        profile: Values of this profile; none takes the run's, else the quick one.
        run_id: A run whose own values are given beside those of its profile.

    Returns:
        ``profile``, ``parent`` (the run's id, else none), ``description`` and ``settings``: rows
        of all that a `Setting` has, with ``base`` (the profile's value) and ``value``.

    Raises:
        UsageError: If there is no such profile, or the run has no settings that can be changed.
    """
    own: dict[str, Any] = {}
    if run_id is not None:
        run = catalog.run(run_id)
        config = settings_of_run(run)
        if config is None:
            raise UsageError(
                f"Run '{run_id}' cannot be fitted again with changes: it is a simulation, or "
                "another version of the program made it. Launch a new fit of its sequence."
            )
        if profile in {None, config.profile}:
            profile, own = config.profile, values_of(config)
    base = load_profile(profile or "quick")
    before = values_of(base)
    return {
        "profile": base.profile,
        "parent": run_id,
        "description": base.description,
        "settings": [
            asdict(setting)
            | {
                "group_name": GROUPS[setting.group],
                "base": before[setting.path],
                "base_text": shown_value(before[setting.path]),
                "value": own.get(setting.path, before[setting.path]),
            }
            for setting in all_settings()
        ],
    }


def check_order(
    catalog: Catalog,
    forecast: Forecast,
    sequence_ids: list[str],
    profile: str,
    overrides: dict[str, Any],
) -> dict[str, Any]:
    """Tell what a fit would be, without launching it.

    Returns:
        ``problems`` (``field message`` of each setting that is wrong), ``overrides`` that differ
        from the profile, and ``expected``: ``seconds basis``, none if no earlier fit is known.

    Raises:
        UsageError: If there is no such profile.
        SequenceError: If a sequence is unknown or damaged.
    """
    base = load_profile(profile)
    frames = [catalog.sequence(sequence_id).frame_count for sequence_id in sequence_ids]
    try:
        config = apply_overrides(base, overrides)
    except SettingsError as error:
        problems = [{"field": path, "message": told} for path, told in error.fields.items()]
        return {"problems": problems, "overrides": {}, "expected": None}
    plan = forecast.of_order(config_to_dict(config), frames) if frames else None
    expected = plan and {"seconds": float(round(plan.seconds)), "basis": plan.basis}
    return {"problems": [], "overrides": changes(config, base), "expected": expected}
