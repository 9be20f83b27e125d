"""The pages that list runs and sequences, and the one that compares runs."""

import re
from pathlib import Path
from typing import Any

import pytest
from support.server.server_world import World

from app.pages.diff import Section, compare_runs, flatten
from physhandi.run import Run


def described(**fields: Any) -> dict[str, Any]:
    return {
        "state": "succeeded",
        "kind": "reconstruction",
        "sequences": ["towel"],
        "profile": "quick",
        "tags": [],
        "created": "2026-11-21T09:21:11",
        "duration_s": None,
    } | fields


def scores(error: float, f1: float) -> dict[str, Any]:
    part = {"frames": [1, 9], "rollout": {"track_error": error, "contact_f1_5mm": f1}}
    return {"towel": {"unit": "m", "reconstruction": part, "topology": {"node_count": 140}}}


def row_of(sections: list[Section], section: str, name: str) -> Any:
    (found,) = [part for part in sections if part.name == section]
    (row,) = [row for row in found.rows if row.name == name]
    return row


def test_runs_are_laid_side_by_side_with_the_best_marked_and_the_change_told() -> None:
    configs = [
        {"profile": {"profile": "quick", "object_": {"search": {"generations": 6, "seed": 42}}}},
        {"profile": {"profile": "quick", "object_": {"search": {"generations": 40, "seed": 42}}}},
    ]
    results: list[dict[str, Any]] = [
        {
            "metrics": scores(0.004, 0.8),
            "parameters": {"drag": 3.0, "virtual_connection_radius": 0.0125, "damping": 2.0},
            "environment": {"device": "cpu", "commit": "0123456789abcdef", "started": "a"},
            "losses": {"first_order": {"before": 2.0, "after": 0.5}},
        },
        {
            "metrics": scores(0.005, 0.9),
            "parameters": {"drag": 3.0 + 1e-12, "virtual_connection_radius": 0.02},
            "environment": {"device": "cuda:0", "commit": None, "started": "b"},
            "losses": {"first_order": {"before": 2.0, "after": 0.5}},
        },
    ]
    pair = [described(duration_s=90), described(tags=["best"])]
    sections = compare_runs(pair, configs, results)

    error = row_of(sections, "Scores of towel, fitted frames", "track error")
    assert [(cell.text, cell.is_best, cell.change) for cell in error.cells] == [
        ("4.000", True, ""),
        ("5.000", False, "+25 %"),
    ]
    assert (error.unit, error.differs) == ("mm", True)
    assert "tracked point" in error.about
    contact = row_of(sections, "Scores of towel, fitted frames", "contact F1 5 mm")
    assert [cell.is_best for cell in contact.cells] == [False, True]
    assert contact.unit == "%"
    nodes = row_of(sections, "Scores of towel, topology", "node count")
    assert not nodes.differs
    assert not any(cell.is_best for cell in nodes.cells)

    found = "Parameters that the simulation ended with"
    radius = row_of(sections, found, "virtual connection radius")
    assert ([cell.text for cell in radius.cells], radius.unit) == (["12.5", "20"], "mm")
    assert not any(cell.is_best for cell in radius.cells)
    assert not row_of(sections, found, "drag").differs
    damping = row_of(sections, found, "damping")
    assert [cell.text for cell in damping.cells] == ["2", "–"]  # noqa: RUF001
    assert damping.differs

    generations = row_of(sections, "Settings", "object / search / generations")
    assert [cell.text for cell in generations.cells] == ["6", "40"]
    assert not row_of(sections, "Settings", "object / search / seed").differs
    assert not row_of(sections, "Loss at the end of each stage", "first order").differs
    commit = row_of(sections, "Computed with", "commit")
    assert [cell.text for cell in commit.cells] == ["0123456789ab", "not run from a checkout"]
    took = row_of(sections, "The runs", "took")
    assert [cell.text for cell in took.cells] == ["1 min 30 s", "–"]  # noqa: RUF001
    with pytest.raises(ValueError, match="unpack"):
        row_of(sections, "Computed with", "started")


def test_what_was_changed_comes_first_and_scores_only_if_they_really_differ() -> None:
    fit = {"profile": {"profile": "quick", "object_": {"search": {"seed": 42}}}}
    again = {"source": "/runs/fit", "parameters": {"drag": 4.0}}
    results: list[dict[str, Any]] = [
        {"metrics": scores(0.004, 0.8), "parameters": {"drag": 3.0}, "losses": {"a": {"after": 1}}},
        {"metrics": scores(0.00401, 0.9), "parameters": {"drag": 4.0}},
    ]
    pair = [described(), described(kind="simulation")]
    sections = compare_runs(pair, [fit, again], results)
    shown = [(section.name, [row.name for row in section.shown]) for section in sections]
    assert [part for part in shown if part[1]] == [
        ("The runs", ["kind"]),
        ("Parameters that the simulation ended with", ["drag"]),
        ("Settings", ["parameters / drag"]),
        ("Scores of towel, fitted frames", ["contact F1 5 mm"]),
    ]
    error = row_of(sections, "Scores of towel, fitted frames", "track error")
    assert [(cell.text, cell.is_best) for cell in error.cells] == [
        ("4.000", False),
        ("4.010", False),
    ]


def test_edits_come_first_step_by_step() -> None:
    fit = {"profile": {"profile": "quick"}}
    steps = ["Cut 12 springs", "Pin 4 nodes from frame 10 on"]
    again = {"source": "/runs/fit", "edits": {"steps": steps, "sha256": "abc"}, "parameters": {}}
    pair = [described(), described(kind="simulation")]
    first = compare_runs(pair, [fit, again], [{}, {}])[0]
    assert first.name == "Edits of springs and nodes"
    assert [(row.name, [cell.text for cell in row.cells]) for row in first.shown] == [
        ("step 1", ["–", steps[0]]),  # noqa: RUF001
        ("step 2", ["–", steps[1]]),  # noqa: RUF001
    ]
    fewer = {**again, "edits": {"steps": steps[:1], "sha256": "def"}}
    first = compare_runs(pair, [again, fewer], [{}, {}])[0]
    assert [row.name for row in first.shown] == ["step 2"]
    others = {**again, "edits": {"steps": steps, "sha256": "def"}}
    first = compare_runs(pair, [again, others], [{}, {}])[0]
    assert [row.name for row in first.shown] == [
        "the same steps, of other springs, nodes or frames"
    ]
    assert compare_runs(pair, [fit, fit], [{}, {}])[0].name == "The runs"


def test_nested_fields_are_named_by_their_path() -> None:
    assert flatten({"a": {"b": 1, "c": {}}, "d": [1]}) == {"a.b": 1, "d": [1]}


def test_the_list_says_what_it_shows_and_every_column_sorts_by_a_link(still_world: World) -> None:
    client = still_world.browser()
    page = client.get("/runs?q=sheet&sort=-created").text
    assert '<tr class="plays" data-run="fitted"' in page
    assert "towel_fold_quick" not in page.partition('id="runs"')[2]
    assert re.search(r"<strong>1</strong> of \d+ runs", page)
    sorted_by = re.findall(r'class="col-(\w+)" aria-sort="(\w+)"><a href="([^"]+)"', page)
    assert [name for name, _, _ in sorted_by] == [
        "name",
        "state",
        "created",
        "duration",
        "fitted",
        "predicted",
    ]
    assert ("created", "descending") in [entry[:2] for entry in sorted_by]
    for _, _, address in sorted_by:
        again = client.get(address.replace("&amp;", "&"))
        assert again.status_code == 200
        assert 'data-run="fitted"' in again.text
    finished = [
        run for run in still_world.catalog.runs() if still_world.scheduler.view(run).is_published
    ]
    assert f'value="succeeded" >succeeded ({len(finished)})' in page
    headers = client.get("/runs?q=&state=&sort=name", headers={"HX-Trigger": "filter"}).headers
    assert headers["HX-Replace-Url"] == "runs?sort=name"
    assert "HX-Push-Url" in client.get("/runs?q=a").headers
    quiet = client.get("/runs?q=a", headers={"HX-Trigger": "runs"}).headers
    assert not {"hx-push-url", "hx-replace-url"} & set(quiet)


def test_the_home_page_opens_what_came_with_it_and_says_whose_it_is(still_world: World) -> None:
    page = still_world.browser().get("/").text
    opened = re.findall(r'<button class="([^"]+)" data-open="run" data-id="([^"]+)"', page)
    hero = [(name, run) for name, run in opened if run != "fitted"][:2]
    # Physics can be changed where there is an object, so that one comes first.
    assert hero == [("big", "towel_fold_quick"), ("secondary outline", "stereo_hand_default")]
    card = page.partition('data-sequence="stereo_hand"')[2].partition("</article>")[0]
    assert "TemugeB/handpose3d" in card
    assert "MIT" in card
    told = still_world.script().get("/api/v1/sequences").json()["sequences"]
    licences = {entry["id"]: entry["licence"] for entry in told if entry["is_bundled"]}
    assert licences == {"stereo_hand": "MIT, see LICENSE", "towel_fold": "Apache-2.0"}
    runs = still_world.script().get("/api/v1/runs").json()["runs"]
    assert {run["id"]: run["has_object"] for run in runs} == {
        "fitted": True,
        "stereo_hand_default": False,
        "towel_fold_quick": True,
    }
    of_hand = still_world.browser().get("/runs/stereo_hand_default").text
    assert "<dd>1.52 px</dd>" in of_hand
    assert "format=mjcf" not in of_hand
    assert "format=newton" not in of_hand
    of_towel = still_world.browser().get("/runs/towel_fold_quick").text
    assert "format=mjcf" in of_towel
    assert "format=newton" in of_towel


@pytest.mark.parametrize(
    ("query", "text"),
    [
        ("q=nothing-like-this", "No run fits this filter"),
        ("q=is:nice", "knows no &#39;is:nice&#39;"),
        ("q=%3Cimg%20src%3Dx%3E", 'value="&lt;img src=x&gt;"'),
        ("profile=gone", '<option value="gone" selected>gone (0)</option>'),
        ("offset=500", "This list ends before"),
    ],
)
def test_an_empty_list_says_why(still_world: World, query: str, text: str) -> None:
    page = still_world.browser().get(f"/runs?{query}")
    assert page.status_code == 200
    assert text in page.text
    assert "<img src=x" not in page.text


def test_a_wrong_address_of_a_list_is_told(still_world: World) -> None:
    for wrong in ("/runs?sort=size", "/runs?limit=0", "/diff?run=a%2Fb&run=c", "/diff?show=some"):
        assert still_world.browser().get(wrong).status_code == 422


def test_sequences_are_filtered_and_lead_to_their_runs(still_world: World) -> None:
    client = still_world.browser()
    page = client.get("/sequences?q=marker%20control").text
    assert 'data-sequence="sheet"' in page
    assert "towel_fold" not in page.partition('id="sequences"')[2].partition("<dialog")[0]
    assert '<a href="runs?sequence=sheet">1 run</a>' in page
    ordered = client.get("/sequences?sort=-frame_count").text
    assert ordered.index('data-sequence="towel_fold"') < ordered.index('data-sequence="sheet"')
    assert "No sequence fits this filter" in client.get("/sequences?q=nothing").text


def test_two_runs_are_compared_by_their_address(still_world: World) -> None:
    client = still_world.browser()
    address = "/diff?run=fitted&run=towel_fold_quick"
    page = client.get(address).text
    assert "2 runs compared" in page
    assert "a sheet" in page
    assert "Towel fold, fitted" in page
    assert "★" in page
    same = '<th scope="row">kind</th>'
    assert same not in page
    assert same in client.get(f"{address}&show=all").text
    created = client.get("/api/v1/runs/fitted").json()["created"]
    assert f'<time datetime="{created}">' in page
    assert 'href="compare?a=fitted&amp;b=towel_fold_quick"' in page
    for run, status in (("", 422), ("&run=fitted", 422), ("&run=gone", 404), ("&run=..", 422)):
        assert client.get(f"/diff?run=fitted{run}").status_code == status
    many = "".join(f"&run=r{n}" for n in range(6))
    assert "2 to 5 runs" in client.get(f"/diff?{many}").text


def test_a_damaged_run_can_be_compared_too(world: World) -> None:
    run = Run.open(world.settings.run_dir / "fitted")
    (run.out / "metrics.json").write_text("{")
    (world.settings.run_dir / "broken").mkdir()
    Path(world.settings.run_dir / "broken" / "run.yaml").write_text("name: [")
    page = world.browser().get("/diff?run=fitted&run=broken&run=towel_fold_quick")
    assert page.status_code == 200
    assert "leave out" in page.text


def test_numbers_that_differ_never_read_the_same() -> None:
    results = [
        {"losses": {"first_order": {"after": after}}, "parameters": {"drag": drag}}
        for after, drag in ((1.31002e-4, 3.0), (1.31049e-4, 3.0))
    ]
    sections = compare_runs([described(), described()], [{}, {}], results)
    loss = row_of(sections, "Loss at the end of each stage", "first order")
    assert [cell.text for cell in loss.cells] == ["1.3100e-4", "1.3105e-4"]
    drag = row_of(sections, "Parameters that the simulation ended with", "drag")
    assert [cell.text for cell in drag.cells] == ["3", "3"]
