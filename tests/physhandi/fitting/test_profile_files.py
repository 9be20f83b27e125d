"""Profiles of a user's own, and settings that are typed on the command line."""

from pathlib import Path
from typing import Any

import pytest

from physhandi.errors import SettingsError, UsageError
from physhandi.fitting.config import (
    SearchVariable,
    apply_overrides,
    load_profile,
    named_profile,
    overrides_of,
    parse_override,
)

DEFAULT = named_profile("default")


@pytest.fixture
def write(tmp_path: Path):
    def write_(text: str, name: str = "mine.yaml") -> Path:
        (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path / name

    return write_


def test_a_file_says_only_what_differs_from_its_base(write) -> None:
    path = write(
        "base: default\n"
        "description: Softer cloth.\n"
        "object_:\n"
        "  search:\n"
        "    generations: 5\n"
        "    variables:\n"
        "      stiffness: {high: 1e6}\n"
        "      friction:\n"
    )
    config = load_profile(path)
    assert (config.profile, config.description) == ("mine", "Softer cloth.")
    assert overrides_of(config, DEFAULT) == {
        "object_.search.generations": 5,
        "object_.search.variables.stiffness": {
            "low": 300.0,
            "high": 1e6,
            "scale": "log",
            "is_scaled": True,
        },
        "object_.search.variables.friction": None,
    }
    assert load_profile(str(path)) == config


def test_an_interval_that_a_file_gives_as_a_whole_is_taken_as_it_is(write) -> None:
    whole = "{low: 2e3, high: 1e4, scale: linear}"
    config = load_profile(
        write(f"base: quick\nobject_:\n  search:\n    variables:\n      stiffness: {whole}\n")
    )
    variables = config.object_.search.variables
    assert variables["stiffness"] == SearchVariable(low=2e3, high=1e4, scale="linear")
    assert variables["virtual_stiffness"].is_scaled


def test_a_file_may_extend_another_file_but_not_itself(write) -> None:
    write("base: quick\nnode_spacing: 0.03\n", "first.yaml")
    second = load_profile(write("base: first.yaml\ncontrol_count: 7\n", "second.yaml"))
    assert (second.node_spacing, second.control_count) == (0.03, 7)
    write("base: b.yaml\n", "a.yaml")
    with pytest.raises(UsageError, match=r"extends this file itself"):
        load_profile(write("base: a.yaml\n", "b.yaml"))


def test_a_file_without_a_base_starts_from_the_classes_own_values(write) -> None:
    config = load_profile(write("simulation: {drag: 1e1}\n"))
    assert config.simulation.drag == 10.0
    assert config.object_.search.variables == {}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "base: default\nnode_spacin: 0.02\n",
            r"mine\.yaml, line 2: .*'node_spacin'.*'node_spacing'",
        ),
        (
            "base: default\n\nobject_:\n  search:\n    generations: many\n",
            r"mine\.yaml, line 5: object_\.search\.generations is 'many'; expected a whole number",
        ),
        (
            "object_:\n  search:\n    variables:\n      drag: {low: 0, high: 5, scale: log}\n",
            r"line 4: object_\.search\.variables\.drag: .* above 0",
        ),
        (
            "object_:\n  search:\n    variables:\n      dragg: {low: 0, high: 5}\n",
            r"line 4: .* no parameter that can be searched 'dragg'. Do you mean 'drag'",
        ),
        ("simulation: {stiffness: 0}\nbase: default\n", "log scale must start above 0"),
        ("simulation:\n  friction: 9\n", r"line 2: simulation\.friction is 9.*from 0 to 2"),
        ("base: fastest\n", r"mine\.yaml: base: There is no profile 'fastest'"),
        ("base: other.yaml\n", r"base: there is no file .*other\.yaml"),
        ("base: [1]\n", r"base is \[1\]"),
        ("- 1\n", "holds no fields"),
        ("a: 1\na: 2\n", "twice"),
        ("a: {\n", "cannot be read as YAML"),
    ],
)
def test_a_mistake_is_told_with_file_line_and_field(write, text: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        load_profile(write(text))


def test_what_is_no_profile_is_refused(write) -> None:
    with pytest.raises(UsageError, match="There is no profile file"):
        load_profile("missing.yaml")
    with pytest.raises(UsageError, match=r"ends in \.yaml"):
        load_profile(str(write("", "mine.txt")))
    with pytest.raises(UsageError, match="Choose one of: default"):
        named_profile("mine.yaml")


@pytest.mark.parametrize(
    ("text", "path", "value"),
    [
        ("node_spacing=0.02", "node_spacing", 0.02),
        (
            "object_.search.variables.stiffness.high=1e6",
            "object_.search.variables.stiffness.high",
            1e6,
        ),
        ("simulation.self_collision = true", "simulation.self_collision", True),
        ("object_.first_order.window=none", "object_.first_order.window", None),
        ("hand.model=mano", "hand.model", "mano"),
        (
            "object_.search.variables.drag={low: 1e-1, high: 5, scale: log}",
            "object_.search.variables.drag",
            {"low": 0.1, "high": 5, "scale": "log"},
        ),
    ],
)
def test_a_setting_is_typed_as_path_and_value(text: str, path: str, value: Any) -> None:
    assert parse_override(text) == (path, value)
    apply_overrides(DEFAULT, {path: value})


@pytest.mark.parametrize("text", ["node_spacing", "=1", "node_spacing=", "a={", ""])
def test_what_is_no_setting_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"PATH=VALUE|cannot be read"):
        parse_override(text)


def test_one_end_of_an_interval_can_be_changed() -> None:
    config = apply_overrides(DEFAULT, {"object_.search.variables.drag.high": 5})
    assert config.object_.search.variables["drag"].high == 5.0
    with pytest.raises(SettingsError, match="the low end must be lower"):
        apply_overrides(DEFAULT, {"object_.search.variables.drag.high": 0})
    with pytest.raises(SettingsError, match="is not searched in this profile"):
        apply_overrides(DEFAULT, {"object_.search.variables.self_friction.high": 1})
    with pytest.raises(SettingsError, match=r"Do you mean 'object_\.search\.variables\.drag'"):
        apply_overrides(DEFAULT, {"object_.search.variables.drag.hig": 1})
