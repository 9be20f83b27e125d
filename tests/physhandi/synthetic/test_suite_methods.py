"""The names of methods, and what the suites hold."""

import pytest

from physhandi.errors import UsageError
from physhandi.synthetic.suite.methods import (
    METHODS,
    method_settings,
    parse_method,
    searched_from,
    shared_stages,
)
from physhandi.synthetic.suite.suite import SUITES, check_seeds, find_suite


def test_a_name_says_base_settings_and_correction() -> None:
    method = parse_method("quick@node_spacing=0.03,object_.search.generations=2+last_residual")
    assert (method.profile, method.rule, method.correction) == ("quick", None, "last_residual")
    assert method.base.name == "quick@node_spacing=0.03,object_.search.generations=2"
    settings = method_settings(method, {"node_spacing": 0.5, "refinement.iterations": 3})
    assert settings["node_spacing"] == 0.03
    assert settings["object_"]["search"]["generations"] == 2
    assert settings["refinement"]["iterations"] == 3
    assert "last residual" in method.about


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("statik", "no method 'statik'"),
        ("quick+last", r"only '\+last_residual'"),
        ("quick@node_spacing", "SETTING=VALUE"),
        ("quick@node_spacin=1", "node_spacing"),
        ("quick@node_spacing=-1", "node_spacing is -1"),
        ("quick@a=[1,2]", "There is no setting 'a'"),
        ("quick@node_spacing=[1,2", "not a value of YAML"),
        ("quick@node_spacing=1,b", "'b' is not SETTING=VALUE"),
        ("quick+5", r"no method 'quick\+5'"),
        ("oracle_parameters+last_residual", "has no predicted frames"),
        ("quick+restart", "restarts by its own settings"),
        ("static+restart", "'static' is a rule"),
        ("oracle_parameters@prediction.restarts=false+restart", "has no predicted frames"),
        ("oracle_parameters@node_spacing=0.02+last_residual", "has no predicted frames"),
    ],
)
def test_a_wrong_name_is_refused(name: str, told: str) -> None:
    with pytest.raises(UsageError, match=told):
        parse_method(name)


def test_a_fit_is_repeated_for_every_seed_of_its_search_and_a_rule_is_not() -> None:
    found = searched_from(parse_method("quick@node_spacing=0.03+last_residual"), (1, 2, 1))
    assert [method.name for method in found] == [
        f"quick@node_spacing=0.03,object_.search.seed={seed}+last_residual" for seed in (1, 2)
    ]
    assert {method.seed_of for method in found} == {"quick@node_spacing=0.03+last_residual"}
    for method, seed in zip(found, (1, 2), strict=True):
        assert method.correction == "last_residual"
        assert method_settings(method, {})["object_"]["search"]["seed"] == seed
        assert method.base.name.endswith(f"seed={seed}")
    (plain,) = searched_from(parse_method("ours"), (5,))
    assert (plain.name, plain.seed_of) == ("ours@object_.search.seed=5", "ours")
    for alone in ("static", "true_motion", "ours@object_.search.seed=9"):
        assert searched_from(parse_method(alone), (1, 2)) == (parse_method(alone),)
    assert searched_from(parse_method("ours"), ()) == (parse_method("ours"),)
    with pytest.raises(UsageError, match="seed is 0"):
        searched_from(parse_method("ours"), (0,))


def test_a_value_may_hold_commas_and_signs() -> None:
    radius = "object_.search.variables.connection_radius"
    interval = "{low: 0.01, high: 0.05, scale: log}"
    name = f"quick@{radius}={interval},simulation.stiffness=1.0e+4+last_residual"
    method = parse_method(name)
    assert method.correction == "last_residual"
    assert method.base.name == name.removesuffix("+last_residual")
    assert method.overrides == {
        radius: {"low": 0.01, "high": 0.05, "scale": "log"},
        "simulation.stiffness": 1e4,
    }
    assert parse_method("quick@simulation.stiffness=1.0e+4").correction is None


def test_a_fit_that_does_not_restart_can_be_restarted() -> None:
    for name in ("phystwin+restart", "paper+restart", "quick@prediction.restarts=false+restart"):
        method = parse_method(name)
        assert method.correction == "restart"
        assert not method_settings(method.base, {})["prediction"]["restarts"]
        assert "starts from the observed state" in method.about
    assert method_settings(METHODS["ours"], {})["prediction"]["restarts"]


def test_hindsight_is_not_told_as_a_bound() -> None:
    about = METHODS["oracle_parameters"].about
    assert "one optimisation in hindsight" in about
    assert "any choice" not in about


def test_stages_are_shared_as_far_as_settings_agree() -> None:
    common = {"node_spacing": 0.02, "hand.iterations": 7}
    one, other, sparse = (
        method_settings(METHODS[name], common) for name in ("static", "quick", "phystwin")
    )
    assert len(shared_stages(one, other)) == 2
    assert shared_stages(one, sparse) == shared_stages(one, other)[:1]
    assert shared_stages(one, method_settings(METHODS["quick"], {"hand.iterations": 8})) == ()


@pytest.mark.parametrize("suite", SUITES.values(), ids=list(SUITES))
def test_every_suite_holds_methods_that_exist_and_reserved_seeds_are_not_in_it(suite) -> None:
    assert all(method_settings(parse_method(name), suite.settings) for name in suite.methods)
    assert {"static", "phystwin", "true_motion"} <= set(suite.methods)
    assert len(set(suite.scenes)) == len(suite.scenes)
    assert max(suite.seeds) < 1000
    assert "node_spacing" in suite.settings


def test_the_full_suite_has_five_objects_of_four_actions() -> None:
    scenes = find_suite("full").scenes
    objects = [scene.object_ for scene in scenes]
    assert len(scenes) == 20
    assert {objects.count(name) for name in objects} == {4}
    assert len({scene.action for scene in scenes}) == 6
    assert sum(scene.hold == "friction" for scene in scenes) >= 10
    assert len(find_suite("dev").scenes) == 6
    assert find_suite("dev_rgbd").scenes == find_suite("dev").scenes
    assert find_suite("dev_rgbd").recording["held_out_view"]
    assert len(find_suite("tiny").scenes) <= 2
    assert len(find_suite("tiny").methods) >= 4


def test_wrong_suites_and_seeds_are_refused() -> None:
    with pytest.raises(UsageError, match="no suite 'huge'"):
        find_suite("huge")
    with pytest.raises(UsageError, match="twice"):
        check_seeds((1, 2, 1))
    with pytest.raises(UsageError, match="negative"):
        check_seeds((-1,))
