"""The pages of suites, over a folder that a suite of one small sheet filled."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.server.server_world import World

from physhandi.data.sequence import Sequence
from physhandi.metrics.suite_report import SEED_COLUMNS, read_rows, to_csv
from physhandi.synthetic.suite.evaluation import Order, evaluate_suite

METHODS = ("static", "rigid_follow", "quick@simulation.connection_radius=0.01")


@pytest.fixture(scope="module")
def suite_folder(tmp_path_factory: pytest.TempPathFactory, sheet_folder: Path) -> Path:
    radius = "object_.search.variables.connection_radius"
    settings = {radius: {"low": 0.001, "high": 0.02, "scale": "linear"}}
    folder = tmp_path_factory.mktemp("suites") / "small"
    recordings = (Sequence.load(sheet_folder),)
    order = Order(title="A <b>sheet</b>", recordings=recordings, methods=METHODS, settings=settings)
    assert evaluate_suite(order, folder)["failed"] == 1
    return folder


@pytest.fixture
def world(still_world: World) -> Iterator[World]:
    """One server for all tests: these write nothing but suites, which are removed."""
    yield still_world
    shutil.rmtree(still_world.settings.suite_dir, ignore_errors=True)


@pytest.fixture
def suite(world: World, suite_folder: Path) -> Path:
    target = world.settings.suite_dir / "small"
    shutil.copytree(suite_folder, target)
    return target


def test_suites_are_behind_the_gate(world: World, suite: Path) -> None:
    for path in ("/suites", "/suites/small", "/suites/small/files/table.csv"):
        assert world.client().get(path).status_code in {401, 403}
        assert world.browser().get(path).status_code == 200


def test_without_a_suite_the_page_tells_how_to_make_one(world: World) -> None:
    page = world.browser().get("/suites").text
    assert "physhandi evaluate suite --suite tiny" in page
    assert world.browser().get("/suites/none").status_code == 404


def test_a_suite_shows_its_tables_and_every_cell(world: World, suite: Path) -> None:
    assert "A &lt;b&gt;sheet&lt;/b&gt;" in world.browser().get("/suites").text
    page = world.browser().get("/suites/small").text
    assert "<b>sheet" not in page
    assert "Reconstruction and future prediction" in page
    cells = json.loads((suite / "cells.json").read_text())["cells"]
    shown = {cell["method"]: cell for cell in cells}
    error = 1000 * shown["static"]["figures"]["future"]["track_error"]
    assert f'<a href="runs/{shown["static"]["run"]}/view">{error:#.4g}</a>' in page
    lost = shown[METHODS[2]]
    assert f'<a href="runs/{lost["run"]}/view">' not in page
    assert "Missing output" in page
    assert "connection_radius" in page.partition("Missing output")[2]


def test_seeds_of_a_search_are_shown_as_their_mean(world: World, suite: Path) -> None:
    rows = read_rows((suite / "table.csv").read_text())
    mean = [replace(r, method="quick", spread=0.0011) for r in rows if r.method == METHODS[2]]
    (suite / "table.csv").write_text(to_csv([*mean, *rows], SEED_COLUMNS))
    content = json.loads((suite / "cells.json").read_text())
    content["about"]["seed_of"] = {METHODS[2]: "quick"}
    (suite / "cells.json").write_text(json.dumps(content))
    tables = world.browser().get("/suites/small").text.partition("Every sequence")[0]
    assert '<th scope="row">quick</th>' in tables
    assert "± 1.10" in tables
    assert f'<th scope="row">{METHODS[2]}</th>' not in tables


def test_another_figure_is_chosen_by_the_address(world: World, suite: Path) -> None:
    page = world.browser().get("/suites/small?split=reconstruction&metric=chamfer_l2").text
    assert '<option value="chamfer_l2" selected>' in page
    assert "No cell has this split" in world.browser().get("/suites/small?split=x").text
    assert world.browser().get("/suites/small?page=2").status_code == 422


def test_a_cell_is_a_run_that_opens_but_is_not_listed(world: World, suite: Path) -> None:
    (folder,) = (suite / "cells").glob("*-static-*")
    assert world.catalog.run(folder.name).has("metrics.json")
    page = world.browser().get(f"/runs/{folder.name}")
    assert page.status_code == 200
    assert "static on sheet" in page.text
    assert folder.name not in {item.id for item in world.catalog.runs()}


def test_files_and_charts_are_served_and_nothing_else(world: World, suite: Path) -> None:
    browser = world.browser()
    table = browser.get("/suites/small/files/table.csv")
    assert table.text.startswith("method,split,metric,mean,low,high,n\n")
    chart = browser.get("/suites/small/charts/future.svg")
    assert chart.headers["content-type"] == "image/svg+xml"
    assert chart.text.startswith("<svg")
    (suite / "charts" / "secret.svg").symlink_to("/etc/hostname")
    for path in ("files/cells.json", "charts/secret.svg", "charts/none.svg", "files/..%2fx"):
        assert browser.get(f"/suites/small/{path}").status_code in {404, 422}


def test_a_damaged_suite_is_told_and_hides_no_other(world: World, suite: Path) -> None:
    shutil.copytree(suite, suite.with_name("whole"))
    (suite / "cells.json").write_text('{"about": 3}')
    page = world.browser().get("/suites").text
    assert "cells.json is damaged" in page
    assert "suites/whole" in page
    assert "damaged" in world.browser().get("/suites/small").text
    (suite.with_name("whole") / "table.csv").write_text("method\n")
    assert "table.csv is not readable" in world.browser().get("/suites/whole").text


@pytest.mark.parametrize(
    ("place", "wrong", "told"),
    [
        (("about", "environment"), {}, "about.environment.started"),
        (("about", "methods"), ["static"], "about.methods"),
        (("about", "charts"), ["../secret.svg"], "about.charts.0"),
        (("cells", 0, "figures"), {"future": 3}, "cells.0.figures.future"),
        (("cells", 1, "run"), "../x", "cells.1.run"),
        (("cells", 0), 7, "cells.0"),
        (("cells",), {}, "cells"),
    ],
)
def test_what_is_damaged_inside_is_named(
    world: World, suite: Path, place: tuple[str | int, ...], wrong: Any, told: str
) -> None:
    content = json.loads((suite / "cells.json").read_text())
    part = content
    for name in place[:-1]:
        part = part[name]
    part[place[-1]] = wrong
    (suite / "cells.json").write_text(json.dumps(content))
    assert f"cells.json is damaged: {told}" in world.browser().get("/suites").text
    page = world.browser().get("/suites/small")
    assert page.status_code < 500
    assert f"cells.json is damaged: {told}" in page.text


def test_a_folder_that_no_route_leads_to_is_not_listed(world: World, suite: Path) -> None:
    shutil.copytree(suite, suite.with_name("a name with spaces"))
    page = world.browser().get("/suites").text
    assert "suites/small" in page
    assert "with spaces" not in page


def test_only_charts_of_the_last_order_are_shown(world: World, suite: Path) -> None:
    (suite / "charts/old.svg").write_text("<svg/>")
    (suite / "charts/reconstruction.svg").unlink()
    page = world.browser().get("/suites/small").text
    assert "charts/future.svg" in page
    assert "charts/sequence_sheet.svg" in page
    assert "old.svg" not in page
    assert "charts/reconstruction.svg" not in page


def test_the_page_does_not_read_curves(world: World, suite: Path) -> None:
    (suite / "curves.json").write_text("damaged")
    assert world.browser().get("/suites/small").status_code == 200
    assert "curves" not in (suite / "cells.json").read_text()


def test_neither_an_oracle_nor_what_stands_in_is_the_best(world: World, suite: Path) -> None:
    content = json.loads((suite / "cells.json").read_text())
    for cell, value in zip(content["cells"], (0.002, 0.003, 0.001), strict=True):
        cell["figures"] = {"future": {"track_error": value}}
    (suite / "cells.json").write_text(json.dumps(content))

    def best() -> str:
        page = world.browser().get("/suites/small").text.partition('id="sequences"')[2]
        assert page.count('class="best"') == 1
        return page.partition('class="best"')[2].partition("(best)")[0]

    assert ">2.000<" in best()  # The third one has no output.
    content["cells"][2]["error"] = ""
    content["about"]["oracles"] = [METHODS[2]]
    (suite / "cells.json").write_text(json.dumps(content))
    assert ">2.000<" in best()
    content["about"]["oracles"] = []
    (suite / "cells.json").write_text(json.dumps(content))
    assert ">1.000<" in best()


def test_a_table_that_is_not_finished_or_for_verification_says_so(
    world: World, suite: Path
) -> None:
    content = json.loads((suite / "cells.json").read_text())
    content["about"] |= {"missing": 5, "is_verification": True, "notes": ["made <i>before</i>"]}
    (suite / "cells.json").write_text(json.dumps(content))
    page = world.browser().get("/suites/small").text
    assert "5 cells are missing" in page
    assert "(verification)" in page
    assert "made &lt;i&gt;before&lt;/i&gt;" in page
