"""Settings that a fit may be given: what there is, what is refused, and what comes of them."""

from typing import Any

import pytest

from physhandi.errors import SettingsError
from physhandi.fitting.config import (
    GROUPS,
    INTERVALS,
    PipelineConfig,
    all_settings,
    apply_overrides,
    load_profile,
    overrides_of,
    values_of,
    without_newer,
)

QUICK = load_profile("quick")


def leaves(value: Any, path: str = "") -> set[str]:
    """All paths of a configuration that hold no further fields; an interval is one of them."""
    if not isinstance(value, dict) or path.startswith(f"{INTERVALS}."):
        return {path}
    found: set[str] = set()
    for name, inner in value.items():
        found |= leaves(inner, f"{path}.{name}" if path else name)
    return found


def test_every_field_of_every_profile_is_a_setting_or_left_out_on_purpose() -> None:
    known = {setting.path for setting in all_settings()}
    left_out = {"profile", "description", "simulation.frame_rate", "simulation.ground_height"}
    for name in ("quick", "default", "paper", "phystwin"):
        config = load_profile(name)
        found = {p for p in leaves(config.to_dict()) if "search.tied" not in p}
        assert found - known == left_out
    assert {path for path in known if not path.startswith(INTERVALS)} == found - left_out - {
        path for path in found if path.startswith(INTERVALS)
    }


def test_every_setting_has_a_meaning_a_group_and_bounds() -> None:
    settings = all_settings()
    assert len(settings) == len({setting.path for setting in settings}) > 90
    for setting in settings:
        assert len(setting.about) > 10
        assert "[" not in setting.about.replace("[0, 1", "").replace("]0, 1", "")
        assert setting.group in GROUPS
        is_number = setting.kind in {"number", "whole", "interval"}
        assert not is_number or (setting.low is not None and setting.high is not None)
        assert (setting.kind == "choice") <= (len(setting.choices) > 1)
    kinds = {setting.path: setting.kind for setting in settings}
    assert kinds["object_.search.generations"] == "whole"
    assert kinds["node_spacing"] == "number"
    assert kinds["simulation.self_collision"] == "switch"
    assert kinds["hand.model"] == "choice"
    assert kinds["object_.search.variables.friction"] == "interval"


@pytest.mark.parametrize("name", ["quick", "default", "paper", "phystwin"])
def test_the_settings_of_any_profile_lie_within_the_bounds(name: str) -> None:
    config = load_profile(name)
    assert apply_overrides(QUICK, values_of(config)) == config.replace(
        profile="quick",
        description=QUICK.description,
        object_=config.object_.replace(
            search=config.object_.search.replace(tied=QUICK.object_.search.tied)
        ),
        simulation=config.simulation.replace(
            frame_rate=QUICK.simulation.frame_rate,
            ground_height=QUICK.simulation.ground_height,
        ),
    )


def test_what_is_changed_changes_and_nothing_else() -> None:
    restitution = {"low": 0.1, "high": 0.9, "scale": "linear"}
    overrides = {
        "object_.search.generations": 12,
        "simulation.stiffness": 2000,
        "object_.search.variables.drag": None,
        "object_.search.variables.restitution": restitution,
        "object_.first_order.window": 5,
        "simulation.self_collision": True,
    }
    changed = apply_overrides(QUICK, overrides)
    assert changed.object_.search.generations == 12
    assert isinstance(changed.simulation.stiffness, float)
    assert list(changed.object_.search.variables) == [
        *[name for name in QUICK.object_.search.variables if name != "drag"],
        "restitution",
    ]
    assert changed.object_.search.variables["restitution"].high == 0.9
    assert overrides_of(changed, QUICK) == overrides
    assert overrides_of(QUICK, QUICK) == {}
    back = apply_overrides(changed, overrides_of(QUICK, changed))
    assert overrides_of(back, QUICK) == {}
    assert load_profile("quick") == QUICK
    stored = PipelineConfig.from_dict(changed.to_dict())
    assert overrides_of(stored, QUICK) == overrides
    assert stored.profile == "quick"


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("object_.search.generation", 3, "Do you mean 'object_.search.generations'?"),
        ("profile", "paper", "There is no setting 'profile'"),
        ("simulation.frame_rate", 60, "what the sequence says"),
        ("hand.iterations", 0, "a whole number from 1 to 100000"),
        ("hand.iterations", 10.5, "a whole number"),
        ("hand.iterations", True, "a whole number"),
        ("hand.iterations", None, "is empty"),
        ("node_spacing", float("nan"), "from 0.001 to 0.5"),
        ("node_spacing", "0.01", "a number"),
        ("node_spacing", [1], "a number"),
        ("simulation.stiffness", -1.0, "from 0 to 100000000"),
        ("simulation.gravity", float("inf"), "from -100000 to 100000"),
        ("simulation.self_collision", 1, "true or false"),
        ("hand.model", "smplx", "one of open, mano"),
        ("object_.search.variables.drag", 3.0, "low, high and scale"),
        ("object_.search.variables.drag", {"low": 1.0}, "low, high and scale"),
        ("object_.search.variables.drag", {"low": 2, "high": 1, "scale": "linear"}, "lower"),
        ("object_.search.variables.drag", {"low": 0, "high": 1, "scale": "log"}, "above 0"),
        ("object_.search.variables.drag", {"low": 0, "high": 1, "scale": "cubic"}, "linear or log"),
        ("object_.search.variables.drag", {"low": 0, "high": "x", "scale": "log"}, "'x'"),
        ("object_.search.variables.friction", {"low": 0, "high": 9, "scale": "linear"}, "to 2"),
        (
            "object_.search.variables.max_neighbors",
            {"low": 1, "high": 9, "scale": "linear"},
            "integer",
        ),
        ("simulation.drag", 10**40, "from 0 to 1000000"),
        ("x" * 500, 1, "There is no setting"),
    ],
)
def test_a_wrong_value_is_refused_by_name(path: str, value: Any, said: str) -> None:
    with pytest.raises(SettingsError, match=r"\S") as refused:
        apply_overrides(QUICK, {path: value})
    assert list(refused.value.fields) == [path]
    assert said in refused.value.fields[path]
    assert len(str(refused.value)) < 400


def test_all_that_is_wrong_is_told_at_once_and_what_clashes_too() -> None:
    wrong = {"hand.iterations": 0, "simulation.stiffness": -1.0, "simulation.drag": 2.0}
    with pytest.raises(SettingsError) as refused:
        apply_overrides(QUICK, wrong)
    assert set(refused.value.fields) == {"hand.iterations", "simulation.stiffness"}
    with pytest.raises(SettingsError, match="log scale must start above 0"):
        apply_overrides(QUICK, {"simulation.stiffness": 0.0})


def test_whatever_lies_on_the_bounds_is_taken_by_the_settings_classes() -> None:
    for setting in all_settings():
        if setting.kind not in {"number", "whole"}:
            continue
        for end in (setting.low, setting.high):
            is_log = end == 0 and setting.group == "simulation"
            if end is None or (is_log and setting.name in QUICK.object_.search.variables):
                continue
            value = int(end) if setting.kind == "whole" else end
            assert values_of(apply_overrides(QUICK, {setting.path: value}))[setting.path] == value


def test_no_setting_takes_a_senseless_number_and_all_that_are_given_one_are_named() -> None:
    numbers = [s for s in all_settings() if s.kind in {"number", "whole"} and s.name != "seed"]
    for sense in (10**9, -(10**9)):
        with pytest.raises(SettingsError) as refused:
            apply_overrides(QUICK, {setting.path: sense for setting in numbers})
        told = refused.value.fields
        assert set(told) == {setting.path for setting in numbers}
        assert told["simulation.connection_radius"].endswith("from 0 to 1000.")
    intervals = {s.path: [s.low, 1e9] for s in all_settings() if s.kind == "interval"}
    asked = {
        path: {"low": low, "high": high, "scale": "linear"}
        for path, (low, high) in intervals.items()
    }
    with pytest.raises(SettingsError) as refused:
        apply_overrides(QUICK, asked)
    assert set(refused.value.fields) == set(intervals)


def test_settings_that_a_stored_configuration_lacks_are_dropped_and_only_these() -> None:
    asked = QUICK.to_dict()
    stored = QUICK.replace(node_spacing=0.02).to_dict()
    del stored["object_"]["rests_where_seen"], stored["refinement"]
    del stored["object_"]["search"]["variables"]["drag"]
    known = without_newer(asked, stored)
    assert leaves(asked) - leaves(known) == {
        path for path in leaves(asked) if path.startswith("refinement")
    } | {"object_.rests_where_seen"}
    # A searched parameter is a choice, not a setting that there was not yet.
    assert known["object_"]["search"] == asked["object_"]["search"]
    assert known["node_spacing"] == QUICK.node_spacing != stored["node_spacing"]


def test_an_interval_that_a_profile_got_later_is_newer_than_runs_made_before() -> None:
    asked, stored = QUICK.to_dict(), QUICK.to_dict()
    del stored["object_"]["search"]["variables"]["friction"]
    # A run of today that does not search it was asked for that.
    assert "friction" in without_newer(asked, stored)["object_"]["search"]["variables"]
    del stored["hand"]["smooths_motion"]
    assert without_newer(asked, stored) == stored
    # Of an older run it was not asked for, but another interval than the profile's is asked for.
    other = {"low": 0.2, "high": 1.0, "scale": "linear"}
    changed = apply_overrides(QUICK, {"object_.search.variables.friction": other}).to_dict()
    known = without_newer(changed, stored)["object_"]["search"]["variables"]
    assert known["friction"]["high"] == 1.0
