"""Profiles are read strictly and survive a round trip."""

from pathlib import Path

import pytest

from physhandi.errors import UsageError
from physhandi.fitting import config
from physhandi.fitting.config import PipelineConfig, load_profile, profile_names
from physhandi.settings import flatten


def test_the_four_profiles_of_the_design_exist() -> None:
    assert profile_names() == ["default", "paper", "phystwin", "quick"]


@pytest.mark.parametrize("name", profile_names())
def test_a_profile_survives_a_round_trip(name: str) -> None:
    config = load_profile(name)
    assert config.profile == name
    assert len(config.description) > 20
    assert PipelineConfig.from_dict(config.to_dict()) == config


def shown(value: object) -> str:
    """A value as the documentation writes it."""
    if value is None or isinstance(value, bool):
        return {None: "none", True: "yes", False: "no"}[value]
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def table(first: str) -> dict[str, dict[str, str]]:
    """Rows of the documentation's table whose first column has this head, by profile."""
    text = (Path(__file__).parents[3] / "docs/conventions.md").read_text(encoding="utf-8")
    lines = text[text.index(f"| {first} |") :].split("\n\n")[0].splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]
    names = cells[0][1:5]
    return {row[0].strip("` "): dict(zip(names, row[1:5], strict=True)) for row in cells[2:]}


def test_the_documentation_tells_every_switch_that_differs() -> None:
    told = table("switch")
    profiles = {name: flatten(load_profile(name).to_dict()) for name in profile_names()}
    for switch, values in told.items():
        actual = {name: shown(config[switch]) for name, config in profiles.items()}
        assert values == actual, switch
    skipped = ("profile", "description", "object_.search.variables", "object_.search.tied")
    for switch in profiles["default"]:
        if not switch.startswith(skipped):
            is_same = len({str(config[switch]) for config in profiles.values()}) == 1
            assert is_same or switch in told, switch


def test_the_documentation_tells_every_interval() -> None:
    told = table("variable")
    for name in profile_names():
        search = load_profile(name).object_.search
        assert set(search.variables) <= set(told)
        for variable, values in told.items():
            if variable in search.tied:
                expected = f"tied to `{search.tied[variable]}`"
            elif variable in search.variables:
                found = search.variables[variable]
                expected = f"{found.low:g} … {found.high:g} {found.scale}"
            else:
                expected = "none"
            assert values[name] == expected, (name, variable)


@pytest.mark.parametrize(
    ("name", "start", "floors"),
    [
        ("phystwin", (0.02, 29, 0.04, 50), (0.0, 0.0)),
        ("paper", (0.02, 29, 0.002, 3), (0.0, 1e-3)),
        ("default", (0.02, 29, 0.01, 6), (1e-3, 1e-3)),
    ],
)
def test_each_profile_is_its_row_of_the_design(
    name: str, start: tuple[float, ...], floors: tuple[float, ...]
) -> None:
    config = load_profile(name)
    simulation, first_order = config.simulation, config.object_.first_order
    virtual = (simulation.virtual_connection_radius, simulation.virtual_max_neighbors)
    assert (simulation.connection_radius, simulation.max_neighbors, *virtual) == start
    assert (simulation.rest_length_floor, simulation.virtual_rest_length_floor) == floors
    is_phystwin = name == "phystwin"
    assert config.control_nodes == ("visible" if is_phystwin else "all")
    assert simulation.use_control_velocity is not is_phystwin
    assert first_order.learns_damping is not is_phystwin
    assert first_order.learns_contact is is_phystwin
    assert config.object_.freezes_counts is is_phystwin
    assert first_order.window == (None if name == "default" else 1)
    if name != "default":
        assert (first_order.iterations, first_order.learning_rate) == (200, 1e-3)
        assert (first_order.beta_2, first_order.prior_weight) == (0.99, 0.0)
        assert config.object_.search.generations == (20 if is_phystwin else 100)


def test_profiles_differ_where_the_design_says() -> None:
    default, paper, phystwin = (load_profile(n) for n in ("default", "paper", "phystwin"))
    assert phystwin.control_nodes == "visible"
    assert phystwin.control_count == 30
    assert not phystwin.simulation.use_control_velocity
    assert default.simulation.use_control_velocity
    assert phystwin.object_.first_order.window == paper.object_.first_order.window == 1
    assert default.object_.first_order.window is None
    assert paper.simulation.virtual_connection_radius == 0.002
    assert paper.simulation.virtual_max_neighbors == 3
    assert phystwin.simulation.max_neighbors == 29
    assert not phystwin.object_.first_order.learns_damping
    assert phystwin.object_.track_weight == pytest.approx(1 / 6)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"spacing": 1.0}, r"no field 'spacing'. Do you mean 'node_spacing'"),
        ({"node_spacing": "wide"}, r"node_spacing is 'wide'; expected a number from 0.001 to 0.5"),
        ({"control_nodes": "some"}, r"control_nodes is 'some'; expected one of all, visible"),
        ({"control_count": 2.5}, r"control_count is 2.5; expected a whole number"),
        ({"object_": 3}, r"object_ is 3; expected a mapping"),
        ({"object_": {"search": {"variables": {"drag": {"low": 1.0}}}}}, r"drag lacks .*'high'"),
        (
            {"object_": {"search": {"variables": {"drag": {"low": 2.0, "high": 1.0}}}}},
            "drag: .* lower",
        ),
        ({"simulation": {"friction": 9.0}}, "simulation.friction is 9.0; expected .* from 0 to 2"),
    ],
)
def test_a_wrong_field_is_named(change: dict[str, object], told: str) -> None:
    with pytest.raises(UsageError, match=told):
        PipelineConfig.from_dict(change)


def test_an_unknown_profile_lists_the_known_ones() -> None:
    with pytest.raises(UsageError, match="quick"):
        load_profile("fastest")


def test_a_users_mistake_in_a_file_names_the_profile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.yaml").write_text("node_spacing: {a: 1}\n")
    monkeypatch.setattr(config, "PROFILES", tmp_path)
    with pytest.raises(UsageError, match=r"mine\.yaml, line 1: node_spacing"):
        load_profile("mine")


def test_numbers_without_a_point_are_numbers() -> None:
    plain = load_profile("quick").to_dict()
    plain["simulation"]["drag"] = 2
    assert PipelineConfig.from_dict(plain).simulation.drag == 2.0


def test_self_collision_can_be_switched_on_and_searched_in_any_profile() -> None:
    plain = load_profile("default").to_dict()
    assert plain["simulation"]["self_collision"] is False
    plain["simulation"] |= {"self_collision": True, "collision_distance": 0.015}
    searched = plain["object_"]["search"]["variables"]
    for name, high in (("collision_distance", 0.05), ("self_restitution", 1.0)):
        searched[name] = {"low": 0.0, "high": high}
    config = PipelineConfig.from_dict(plain)
    assert config.simulation.self_collision
    assert config.simulation.collision_distance == 0.015
    assert config.object_.search.variables["collision_distance"].from_unit(0.5) == 0.025


def test_a_profile_does_otherwise_on_cuda_only_what_it_says() -> None:
    for name in ("quick", "paper", "phystwin"):
        config = load_profile(name).object_
        assert config.on("cuda:0") == config
    config = load_profile("default").object_
    assert config.on("cpu") is config
    there = config.on("cuda:0")
    assert (there.search.population, there.search.generations) == (32, 12)
    assert there.search.variables["damping"].low == 30.0
    assert there.search.variables["damping"].high == config.search.variables["damping"].high
    assert (there.first_order.iterations, there.first_order.learning_rate) == (40, 0.04)
    assert (there.most_substeps, there.most_grips) == (500, 12)
    # What asks for less is left as it is.
    small = config.replace(
        most_substeps=90,
        search=config.search.replace(generations=2),
        first_order=config.first_order.replace(iterations=3),
    ).on("cuda:0")
    assert (small.search.generations, small.most_substeps) == (2, 90)
    assert (small.first_order.iterations, small.first_order.learning_rate) == (3, 0.02)
