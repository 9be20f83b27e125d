"""Profiles are read strictly and survive a round trip."""

from dataclasses import replace
from pathlib import Path

import pytest

from physhandi.errors import UsageError
from physhandi.fitting import profile
from physhandi.fitting.profile import (
    config_from_dict,
    config_to_dict,
    load_profile,
    profile_names,
)


def test_the_four_profiles_of_the_design_exist() -> None:
    assert profile_names() == ["default", "paper", "phystwin", "quick"]


@pytest.mark.parametrize("name", profile_names())
def test_a_profile_survives_a_round_trip(name: str) -> None:
    config = load_profile(name)
    assert config.profile == name
    assert len(config.description) > 20
    assert config_from_dict(config_to_dict(config)) == config


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
        ({"spacing": 1.0}, r"no field 'spacing'"),
        ({"node_spacing": "wide"}, r"node_spacing is 'wide'; expected float"),
        ({"control_nodes": "some"}, r"control_nodes is 'some'; expected one of"),
        ({"control_count": 2.5}, r"control_count is 2.5; expected int"),
        ({"object_": 3}, r"object_ is 3; expected a mapping"),
        ({"object_": {"search": {"variables": {"drag": {"low": 1.0}}}}}, r"drag lacks .*'high'"),
        ({"object_": {"search": {"variables": {"drag": {"low": 2.0, "high": 1.0}}}}}, "empty"),
        ({"simulation": {"friction": 9.0}}, "friction"),
    ],
)
def test_a_wrong_field_is_named(change: dict[str, object], told: str) -> None:
    with pytest.raises(UsageError, match=told):
        config_from_dict(change)


def test_an_unknown_profile_lists_the_known_ones() -> None:
    with pytest.raises(UsageError, match="quick"):
        load_profile("fastest")


def test_a_users_mistake_in_a_file_names_the_profile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.yaml").write_text("node_spacing: {a: 1}\n")
    monkeypatch.setattr(profile, "FOLDER", tmp_path)
    with pytest.raises(UsageError, match="profile 'mine': node_spacing"):
        load_profile("mine")


def test_numbers_without_a_point_are_numbers() -> None:
    config = replace(load_profile("quick"), node_spacing=1.0)
    assert config_from_dict(config_to_dict(config) | {"node_spacing": 1}) == config


def test_self_collision_can_be_switched_on_and_searched_in_any_profile() -> None:
    plain = config_to_dict(load_profile("default"))
    assert plain["simulation"]["self_collision"] is False
    plain["simulation"] |= {"self_collision": True, "collision_distance": 0.015}
    searched = plain["object_"]["search"]["variables"]
    for name, high in (("collision_distance", 0.05), ("self_restitution", 1.0)):
        searched[name] = {"low": 0.0, "high": high}
    config = config_from_dict(plain)
    assert config.simulation.self_collision
    assert config.simulation.collision_distance == 0.015
    assert config.object_.search.variables["collision_distance"].from_unit(0.5) == 0.025
