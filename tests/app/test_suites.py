"""The pages of suites, over a folder that a suite of one small sheet filled."""

import json
import shutil
from pathlib import Path

import pytest
from server_world import World

from physhandi.data.sequence import Sequence
from physhandi.synthetic.evaluation import Order, evaluate

METHODS = ("static", "rigid_follow", "quick@simulation.connection_radius=0.01")


@pytest.fixture(scope="module")
def suite_folder(tmp_path_factory: pytest.TempPathFactory, sheet_folder: Path) -> Path:
    radius = "object_.search.variables.connection_radius"
    settings = {radius: {"low": 0.001, "high": 0.02, "scale": "linear"}}
    folder = tmp_path_factory.mktemp("suites") / "small"
    recordings = (Sequence.load(sheet_folder),)
    order = Order(title="A <b>sheet</b>", recordings=recordings, methods=METHODS, settings=settings)
    assert evaluate(order, folder)["failed"] == 1
    return folder


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
    assert f'<a href="/runs/{shown["static"]["run"]}/view">{error:#.4g}</a>' in page
    lost = shown[METHODS[2]]
    assert f'<a href="/runs/{lost["run"]}/view">' not in page
    assert "Missing output" in page
    assert "connection_radius" in page.partition("Missing output")[2]


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
    assert "/suites/whole" in page
    assert "damaged" in world.browser().get("/suites/small").text
    (suite.with_name("whole") / "table.csv").write_text("method\n")
    assert "table.csv is not readable" in world.browser().get("/suites/whole").text
