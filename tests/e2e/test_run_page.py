"""The page of a run, live: a worker that does what the test says, watched in a real browser."""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import BrowserContext, Page, expect
from support.inputs.sheet_sequence import write_sheet
from support.server.queue_world import QueueWorld, queue_world, serving

pytestmark = pytest.mark.e2e
TESTS = Path(__file__).parents[1]
X_RANGE = """() => {
  const { min, max } = page.charts.get("first_order").plot.scales.x;
  return [min, max];
}"""
BLUE_PIXELS = """(canvas) => {
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  let count = 0;
  for (let i = 0; i < data.length; i += 4)
    if (data[i + 2] > data[i] + 60 && data[i + 3] > 200) count++;
  return count;
}"""


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[QueueWorld]:
    monkeypatch.setenv("PYTHONPATH", str(TESTS))
    (tmp_path / "bundled").mkdir()
    for name in ("sheet", "other"):
        write_sheet(tmp_path / "data" / "sequences" / name)
    with queue_world(tmp_path / "data", tmp_path / "bundled") as world:
        yield world


@pytest.fixture
def open_run(world: QueueWorld, context: BrowserContext) -> Iterator[Callable[[str], Page]]:
    """Open the page of a run, and see that nothing reloads it from then on."""
    with serving(world) as port:

        def open_one(run_id: str) -> Page:
            page = context.new_page()
            page.goto(f"http://127.0.0.1:{port}/runs/{run_id}?token={world.token}")
            page.evaluate("window.isTheSamePage = true")
            return page

        yield open_one
        for page in context.pages:
            page.goto("about:blank")


def reports(stage: str, iterations: range, loss: Callable[[int], float]) -> list[list]:
    return [["report", stage, i, 100, loss(i)] for i in iterations]


def points(page: Page, stage: str, count: int) -> list[list[float]]:
    """The points that a chart draws, as uPlot holds them, once there are that many."""
    data = "page.charts.get(stage)?.plot.data"
    page.wait_for_function(f"([stage, n]) => {data}?.[0].length === n", arg=[stage, count])
    return page.evaluate(f"stage => {data}", stage)


def test_curves_log_and_stages_grow_without_a_reload(world, open_run):
    run_id = world.launch("script")
    world.until(run_id, "running")
    world.tell(run_id, *reports("hand_reconstruction", range(1, 5), lambda i: 100.0 / i))
    page = open_run(run_id)
    stage = page.locator("[data-stage=hand_reconstruction]")
    expect(stage.locator(".mark")).to_have_text("at work")
    world.tell(run_id, *reports("hand_reconstruction", range(5, 6), lambda i: 100.0 / i))
    expect(page.locator("[data-text]")).to_contain_text("hand reconstruction · 5 of 100 · loss 20")
    expect(page.locator("#losses .uplot")).to_have_count(1)
    assert points(page, "hand_reconstruction", 5) == [[1, 2, 3, 4, 5], [100, 50, 100 / 3, 25, 20]]

    world.tell(run_id, *reports("hand_reconstruction", range(6, 41), lambda i: 100.0 / i))
    world.tell(run_id, ["log", "a line <i>from</i> the worker"])
    expect(page.locator("[data-text]")).to_contain_text("40 of 100 · loss 2.5")
    expect(page.locator("#log")).to_contain_text("a line <i>from</i> the worker")
    iterations, losses = points(page, "hand_reconstruction", 40)
    assert iterations == list(range(1, 41))
    assert losses == pytest.approx([100 / i for i in iterations])

    world.tell(run_id, ["finish", "hand_reconstruction", {"before": 100.0, "after": 2.5}])
    world.tell(run_id, ["report", "observation", 1, 2])
    expect(stage.locator(".mark")).to_have_text("done")
    expect(stage.locator(".loss")).to_have_text("loss 100 → 2.5")
    expect(stage).to_contain_text(" s")
    expect(page.locator("[data-stage=observation] .mark")).to_have_text("at work")
    assert page.evaluate("window.isTheSamePage")


def test_a_zoomed_chart_stays_zoomed_while_it_grows(world, open_run):
    run_id = world.launch("script")
    world.until(run_id, "running")
    world.tell(run_id, *reports("first_order", range(1, 41), lambda i: 100.0 / i))
    page = open_run(run_id)
    # Points that come build the chart anew, and the first load makes room for what it says.
    points(page, "first_order", 40)
    expect(page.locator("[data-takes]")).to_contain_text("This fit takes")
    chart = page.locator("[data-chart=first_order]")
    log = chart.get_by_role("button", name="Logarithmic scale")
    expect(log).to_have_attribute("aria-pressed", "true")
    log.click()
    expect(log).to_have_attribute("aria-pressed", "false")
    box = chart.locator(".u-over").bounding_box()
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.25 * box["width"], middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.5 * box["width"], middle, steps=4)
    page.mouse.up()
    expect(chart.get_by_role("button", name="show all")).to_be_visible()
    zoomed = page.evaluate(X_RANGE)
    assert zoomed == pytest.approx([10.75, 20.5], abs=0.5)

    world.tell(run_id, *reports("first_order", range(41, 61), lambda i: 100.0 / i))
    expect(page.locator("[data-text]")).to_contain_text("60 of 100")
    assert points(page, "first_order", 60)[0] == list(range(1, 61))
    assert page.evaluate(X_RANGE) == zoomed
    expect(log).to_have_attribute("aria-pressed", "false")
    chart.get_by_role("button", name="show all").click()
    assert page.evaluate(X_RANGE) == [1, 60]


def test_a_marked_text_stays_marked_and_a_lost_stream_is_taken_up_without_gap(world, open_run):
    run_id = world.launch("script")
    world.until(run_id, "running")
    page = open_run(run_id)
    expect(page.locator(".state")).to_have_text("running")
    page.evaluate("getSelection().selectAllChildren(document.querySelector('h1'))")
    page.wait_for_function("() => stream?.readyState === EventSource.OPEN")
    page.evaluate("unfollow()")
    world.tell(run_id, *reports("zeroth_order", range(1, 4), float), ["log", "while away"])
    world.tell(run_id, ["finish", "hand_reconstruction", {"before": 2.0, "after": 1.0}])
    world.until_reported(run_id, "zeroth_order", 3)
    page.evaluate("follow()")
    expect(page.locator("#log .line", has_text="while away")).to_have_count(1)
    expect(page.locator("[data-stage=hand_reconstruction] .mark")).to_have_text("done")
    page.evaluate("unfollow(); follow()")
    world.tell(run_id, *reports("zeroth_order", range(4, 7), float), ["log", "afterwards"])
    expect(page.locator("#log .line", has_text="afterwards")).to_have_count(1)
    expect(page.locator("#log .line", has_text="while away")).to_have_count(1)
    assert points(page, "zeroth_order", 6) == [[1, 2, 3, 4, 5, 6]] * 2
    assert page.evaluate("getSelection().toString()") == "script"


def test_the_log_stays_where_its_reader_scrolled(world, open_run):
    run_id = world.launch("script")
    world.until(run_id, "running")
    page = open_run(run_id)
    log = page.locator("#log")
    world.tell(run_id, ["log", *(f"line {number}" for number in range(80))])
    expect(log).to_contain_text("line 79")
    rest = "log => log.scrollHeight - log.scrollTop - log.clientHeight"
    assert log.evaluate(rest) < 8
    log.evaluate("log => { log.scrollTop = 100; }")
    follow = page.locator("[data-log-follow]")
    expect(follow).to_be_visible()
    world.tell(run_id, ["log", "2026-01-01 10:00:00,000 ERROR a bad line"])
    expect(log.locator(".error")).to_have_text("2026-01-01 10:00:00,000 ERROR a bad line\n")
    expect(follow).to_have_text("↓ 1 new line")
    assert log.evaluate("log => log.scrollTop") == 100
    follow.click()
    assert log.evaluate(rest) < 8
    expect(follow).to_be_hidden()
    with page.expect_download() as download:
        page.locator("[data-log-download]").click()
    assert "line 42\n" in Path(download.value.path()).read_text()


def test_a_failure_is_told_in_words_without_a_traceback(world, open_run):
    run_id = world.launch("defect")
    page = open_run(run_id)
    expect(page.locator(".failure h2")).to_have_text("The fit failed in zeroth order")
    expect(page.locator(".failure")).to_contain_text("KeyError: 'a <b>key</b>'")
    expect(page.locator(".failure .advice")).to_contain_text("mistake of the program")
    expect(page.locator("[data-stage=zeroth_order] .mark")).to_have_text("failed")
    expect(page.get_by_role("button", name="Resume")).to_be_visible()
    # A log is open from the start if the run was at work when the page was loaded.
    if page.locator("#log-details").get_attribute("open") is None:
        page.locator("#log-details summary").click()
    expect(page.locator("#log")).to_be_visible()
    expect(page.locator("#log .error").last).to_contain_text("KeyError")
    assert "Traceback" in (world.folder(run_id) / "log.txt").read_text()
    text = page.locator("body").inner_text()
    assert "Traceback" not in text
    assert "job_worker.py" not in text


def test_results_appear_when_the_run_ends(world, open_run):
    order = {"sequences": ["sheet", "other"], "profile": "quick", "name": "script"}
    run_id = world.client.post("/api/v1/runs", json=order).json()["id"]
    world.until(run_id, "running")
    page = open_run(run_id)
    expect(page.locator("#frames")).to_be_hidden()
    metrics = {
        "unit": "m",
        "future": {
            "frames": [7, 10],
            "rollout": {"track_error": 0.004},
            "static": {"track_error": 0.02},
        },
    }
    world.tell(
        run_id,
        ["save", "metrics.json", {"sheet": metrics, "other": metrics}],
        ["save", "sequences/sheet/frame_errors.json", frame_errors(0.001)],
        ["save", "sequences/other/frame_errors.json", frame_errors(0.002)],
        ["finish", "evaluation", {}],
        ["publish"],
    )
    expect(page.locator(".state")).to_have_text("succeeded")
    best = page.locator("#results td.best").first
    expect(best).to_contain_text("4.000")
    # What one sequence tells may be shown before the other is told, and is drawn anew then.
    page.wait_for_function("() => Object.keys(frameErrors).length === 2")
    expect(page.locator("#frames .uplot")).to_have_count(2)
    shown = page.evaluate("window.isTheSamePage && frameErrors.sheet.future_start")
    assert shown == 7
    # Blue pixels of the rollout's line are really on the canvas.
    canvas = page.locator("[data-chart=track_error] canvas")
    assert canvas.evaluate(BLUE_PIXELS) > 100
    page.locator("[data-chart=track_error] .plot").focus()
    page.keyboard.press("End")
    page.keyboard.press("ArrowLeft")
    expect(page.locator("[data-chart=track_error] .readout")).to_contain_text("frame 8")
    expect(page.locator("[data-chart=track_error] .readout")).to_contain_text("rollout 8 mm")
    page.keyboard.press("Enter")
    expect(page.locator("#frames .held")).to_contain_text("Frame 8 · track error: rollout 8 mm")
    page.locator("#frames select").select_option("other")
    expect(page.locator("#frames .held")).to_be_hidden()
    readout = page.locator("[data-chart=track_error] .readout")
    expect(readout).to_contain_text("frame 9")
    expect(readout).to_contain_text("rollout 18 mm")


def frame_errors(step: float) -> dict:
    """Errors that grow with the frame, for both methods; frame 0 is not scored."""
    grows = [None, *(step * frame for frame in range(1, 10))]
    curves = {"track_error": grows, "chamfer_l2": grows}
    twice = {name: [v and 2 * v for v in curve] for name, curve in curves.items()}
    return json.loads(
        json.dumps({"unit": "m", "frames": list(range(10)), "rollout": curves, "static": twice})
    )


def test_name_tags_and_note_are_changed_in_place(world, open_run):
    run_id = world.launch("script")
    world.until(run_id, "running")
    page = open_run(run_id)
    page.get_by_role("button", name="Edit").click()
    page.locator("#about [name=name]").fill("Wider <i>δ</i>")
    page.locator("#about [name=tags]").fill("paper, wide")
    note = page.locator("#about [name=note]")
    note.fill("First line\n<b>second</b>")
    world.tell(run_id, *reports("hand_reconstruction", range(1, 3), lambda i: 100.0 / i))
    world.tell(run_id, ["finish", "hand_reconstruction", {"before": 100.0, "after": 50.0}])
    expect(page.locator("[data-stage=hand_reconstruction] .mark")).to_have_text("done")
    expect(note).to_have_value("First line\n<b>second</b>")
    note.press("Control+Enter")
    expect(page.locator("[data-note]")).to_have_text("First line\n<b>second</b>")
    expect(page.locator("#about")).to_be_hidden()
    expect(page.locator("h1")).to_contain_text("Wider <i>δ</i>")
    expect(page.locator(".tags a")).to_have_text(["paper", "wide"])
    expect(page).to_have_title(re.compile("Wider <i>δ</i>"))
    assert page.evaluate("window.isTheSamePage")
