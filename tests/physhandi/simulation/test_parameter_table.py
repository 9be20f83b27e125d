"""One table of parameters feeds bounds, sliders, links, presets and the documentation."""

from pathlib import Path

import pytest

from physhandi.errors import SettingsError
from physhandi.settings import changes
from physhandi.simulation.parameters import (
    AUTOMATIC,
    PARAMETERS,
    Parameter,
    SimulationParameters,
    changed_parameters,
    parameter_changes,
    parameter_names,
)

DOCUMENT = Path(__file__).parents[3] / "docs/parameters.md"
START = SimulationParameters(drag=2.0, substeps_per_frame=230)


def row(parameter: Parameter) -> str:
    """One line of the documentation's table."""
    default = getattr(SimulationParameters(), parameter.name)
    shown = (
        {None: "none", True: "yes", False: "no"}.get(default, default)
        if (default is None or isinstance(default, bool))
        else f"{default:g}"
    )
    values = "yes or no" if parameter.kind == "switch" else parameter.range
    cells = (
        f"`{parameter.name}`",
        parameter.unit or "",
        values + (", or none" if parameter.is_optional else ""),
        shown,
        parameter.effect,
        parameter.label,
        parameter.about,
    )
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def table() -> str:
    """The documentation's table as it has to be."""
    head = ("parameter", "unit", "values", "default", "effect", "called", "meaning")
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return "\n".join([*lines, *map(row, PARAMETERS.values())])


def test_the_documentation_holds_the_table() -> None:
    assert table() in DOCUMENT.read_text(encoding="utf-8"), f"Put this there:\n{table()}"


def test_every_parameter_has_a_meaning_and_what_people_move_has_a_name() -> None:
    assert list(PARAMETERS) == list(SimulationParameters().to_dict())
    for parameter in PARAMETERS.values():
        assert len(parameter.about) > 15
        assert parameter.label or parameter.slider is None
        assert parameter.slider is None or parameter.slider.hint.endswith(".")
        # A length, and nothing else but gravity, changes with the recording's unit.
        assert parameter.is_length == parameter.unit.startswith("m")
        is_fit = parameter.problem_of(getattr(SimulationParameters(), parameter.name)) == ""
        assert is_fit, parameter.name


def test_what_a_new_value_takes_is_said_by_the_table() -> None:
    assert parameter_names("material") == ("stiffness", "virtual_stiffness", "damping")
    assert set(parameter_names("step")) == {"frame_rate", "frame_duration", "substeps_per_frame"}
    assert {"connection_radius", "virtual_rest_length_floor"} <= set(parameter_names("topology"))
    assert {"stiffness_scale", "gravity", "self_collision"} <= set(parameter_names("live"))


def test_changes_and_their_application_are_each_others_reverse() -> None:
    now = START.replace(drag=5.0, ground_height=None)
    assert parameter_changes(START, now) == {"drag": 5.0, "ground_height": None}
    assert changed_parameters(START, parameter_changes(START, now)) == (now, False)
    assert parameter_changes(START, START) == {}
    automatic = parameter_changes(START, START, is_automatic=True)
    assert automatic == {"substeps_per_frame": AUTOMATIC}
    assert changed_parameters(START, automatic) == (START, True)
    assert changes({"a": 1.0, "b": True}, {"a": 1, "b": 1, "c": None}) == {"b": 1, "c": None}
    assert changes({"a": 1.0}, {"a": 1.0 + 1e-12}, tolerance=1e-9) == {}


def test_a_copy_is_checked_like_the_original() -> None:
    with pytest.raises(SettingsError, match=r"no field .dragg.\. Do you mean .drag."):
        START.replace(dragg=1.0)
    with pytest.raises(SettingsError) as refused:
        START.replace(drag=-1.0, friction=3)
    assert set(refused.value.fields) == {"drag", "friction"}
    assert isinstance(START.replace(drag=3).drag, float)
