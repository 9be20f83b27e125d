"""Orders of fits: a profile, what differs from it, and the run it is made from."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from typing import Any

from app.jobs.catalog import Catalog, RunItem, UnknownRunError
from app.jobs.eta import Forecast
from physhandi.data.files import named_fields
from physhandi.data.sequence import Sequence as Recording
from physhandi.errors import MissingInputError, SettingsError, UsageError
from physhandi.fitting.checks.readiness import nothing_to_fit, readiness, skipped_object
from physhandi.fitting.config import (
    EVALUATION,
    GROUPS,
    PipelineConfig,
    Setting,
    all_settings,
    apply_overrides,
    named_profile,
    overrides_of,
    profile_names,
    values_of,
)
from physhandi.run import Run


def fit_config(
    profile: str, overrides: Mapping[str, Any] | None = None, parent: str | None = None
) -> dict[str, Any]:
    """Make the configuration that a run stores.

    All settings are stored, so that a run stays what it is when a profile changes; ``overrides``
    holds those that differ from the profile as it is now.

    Args:
        profile: Name of a profile.
        overrides: New values of settings by their paths; those that change nothing are dropped.
        parent: The run that it was made from.

    Raises:
        UsageError: If there is no such profile.
        SettingsError: If settings are unknown or wrong; names all of them.
    """
    settings = fit_settings(named_profile(profile), overrides or {})
    return settings | ({"parent": parent} if parent else {})


def fit_settings(base: PipelineConfig, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Make what a run stores of a profile that some settings differ from; see `fit_config`."""
    config = apply_overrides(base, overrides)
    changed = overrides_of(config, base)
    stored: dict[str, Any] = {"profile": config.to_dict()}
    return stored | ({"overrides": changed} if changed else {})


def default_name(sequence: str, config: Mapping[str, Any]) -> str:
    """Name a fit that its user gave no name."""
    count = len(config.get("overrides", {}))
    changed = f", {count} change{'' if count == 1 else 's'}" if count else ""
    return f"{sequence} · {config['profile']['profile']}{changed}"


def settings_of_run(run: Run) -> PipelineConfig | None:
    """Read the settings of a fit; none if it is no fit, or of another version of the program."""
    profile = named_fields(run.config.get("profile"))
    if run.kind != "reconstruction" or not profile:
        return None
    try:
        return PipelineConfig.from_dict(profile)
    except UsageError:
        return None


def order_of(item: RunItem, catalog: Catalog) -> dict[str, Any]:
    """Describe what a listed run was asked to do, for its page.

    Returns:
        `describe_order` of it, and ``parent_name``: none if the parent is gone.
    """
    order: dict[str, Any] = {"parent": None, "changes": []}
    order = describe_order(item.run) if item.run else order
    if order["parent"] is None:
        return order
    try:
        parent = catalog.run_item(order["parent"]).run
    except UnknownRunError:
        return order | {"parent_name": None}
    return order | {"parent_name": parent.name if parent else order["parent"]}


def describe_order(run: Run) -> dict[str, Any]:
    """Describe what a run was asked to do.

    Returns:
        ``parent`` (id of the run that it was made from, else none), ``overrides`` (values by
        their paths) and ``changes``: rows of ``path title group about unit base value``.
    """
    parent = run.config.get("parent")
    overrides = named_fields(run.config.get("overrides")) or {}
    profile = named_fields(run.config.get("profile")) or {}
    base = _base_values(str(profile.get("profile", "")))
    settings = {setting.path: setting for setting in all_settings()}
    rows = [
        _row(settings[path], base.get(path), value)
        for path, value in overrides.items()
        if path in settings
    ]
    return {
        "parent": parent if isinstance(parent, str) else None,
        "overrides": overrides,
        "changes": rows,
    }


def shown_value(value: Any) -> str:
    """Write the value of a setting for people."""
    fields = named_fields(value)
    if fields is not None:
        scale = "" if fields.get("scale") in {"linear", None} else f" ({fields['scale']})"
        return f"{shown_value(fields.get('low'))} to {shown_value(fields.get('high'))}{scale}"
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _row(setting: Setting, base: Any, value: Any) -> dict[str, Any]:
    is_interval = setting.kind == "interval"
    before, after = (
        "not searched" if is_interval and v is None else shown_value(v) for v in (base, value)
    )
    return {
        "path": setting.path,
        "title": setting.title,
        "group": GROUPS[setting.group],
        "about": setting.about,
        "unit": setting.unit if any(c.isdigit() for c in after) else "",
        "base": before,
        "value": after,
    }


@lru_cache(maxsize=32)
def _base_values(profile: str) -> dict[str, Any]:
    return values_of(named_profile(profile)) if profile in profile_names() else {}


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
        # A profile of the user's own is not among those offered; the run holds all its settings.
        of_run = config.profile if config.profile in profile_names() else "default"
        if profile in {None, of_run}:
            profile, own = of_run, values_of(config)
    base = named_profile(profile or "quick")
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


class SkippedObjectError(MissingInputError):
    """A fit would leave out an object of which depth was recorded, and nobody agreed to that."""


def require_agreement(sequences: Sequence[Recording], *, accepts_missing: bool) -> None:
    """Refuse a fit of nothing, and one of less than was recorded unless the user accepts that.

    Args:
        sequences: What is to be fitted.
        accepts_missing: Whether the object may be left out although depth was recorded.

    Raises:
        MissingInputError: If there is nothing to fit.
        SkippedObjectError: If the object would be left out.
    """
    if not readiness(sequences)[EVALUATION].is_ready:
        raise MissingInputError(nothing_to_fit(sequences))
    skipped = skipped_object(sequences)
    if skipped is not None and not accepts_missing:
        raise SkippedObjectError(
            f"{skipped} To fit the hands alone, accept that (accepts_missing)."
        )


def describe_readiness(
    sequences: Sequence[Recording], config: PipelineConfig | None = None
) -> dict[str, Any]:
    """Tell which stages of a fit would run.

    Returns:
        ``stages`` (``ready missing state why remedy`` of each by its name), and the texts
        ``nothing_to_fit`` and ``skips_object``, none if that is not so.
    """
    if not sequences:
        return {"stages": {}, "nothing_to_fit": None, "skips_object": None}
    stages = readiness(sequences, config)
    return {
        "stages": {name: stage.to_dict() for name, stage in stages.items()},
        "nothing_to_fit": None if stages[EVALUATION].is_ready else nothing_to_fit(sequences),
        "skips_object": skipped_object(sequences),
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
        from the profile, ``expected`` (``seconds basis``, none if no earlier fit is known), and
        what `describe_readiness` tells.

    Raises:
        UsageError: If there is no such profile.
        SequenceError: If a sequence is unknown or damaged.
    """
    base = named_profile(profile)
    sequences = [catalog.sequence(sequence_id) for sequence_id in sequence_ids]
    report: dict[str, Any] = {"problems": [], "overrides": {}, "expected": None}
    try:
        config = apply_overrides(base, overrides)
    except SettingsError as error:
        report["problems"] = [
            {"field": path, "message": problem} for path, problem in error.fields.items()
        ]
        return report | describe_readiness(sequences)
    report["overrides"] = overrides_of(config, base)
    report["expected"] = forecast.of_order(config.to_dict(), sequences)
    return report | describe_readiness(sequences, config)
