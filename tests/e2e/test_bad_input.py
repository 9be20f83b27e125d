"""Broken recordings and runs, as a user of the browser meets them on a real server."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect
from support.browser.scene_page import TIMEOUT_MS
from support.browser.small_pictures import place_pictures
from support.hostile.bad_input_world import fields, truncated
from support.inputs.sheet_sequence import write_sheet

pytestmark = pytest.mark.e2e
BUNDLED_RUN = Path(__file__).parents[2] / "sequences/runs/towel_fold_quick"
ROLLOUT = "sequences/towel_fold/rollout.npy"


@pytest.fixture
def page(browser: Browser, served) -> Iterator[Page]:
    """A tab beside damaged recordings and a damaged run; nothing in it may fail by itself."""
    write_sheet(served.data_dir / "sequences/unreadable")
    fields(colour="red")(served.data_dir / "sequences/unreadable")
    torn = served.data_dir / "runs/torn"
    shutil.copytree(BUNDLED_RUN, torn)
    truncated(f"attempts/1/out/{ROLLOUT}")(torn)
    place_pictures(served.data_dir)
    context = browser.new_context(reduced_motion="reduce")
    context.set_default_timeout(TIMEOUT_MS)
    defects: list[str] = []
    context.on("weberror", lambda error: defects.append(str(error.error)))
    page = context.new_page()
    page.goto(served.url)
    yield page
    context.close()
    assert defects == []


def test_what_is_broken_is_told_where_the_user_meets_it(page: Page, served) -> None:
    # A recording that cannot be read says why, and can only be moved aside.
    card = page.locator("[data-sequence=unreadable]")
    expect(card.locator(".problem")).to_contain_text("field 'colour' is not known")
    expect(card.get_by_role("button")).to_have_text(["Move aside"])

    # A run whose files have changed is not shown, and the page stays.
    page.locator("#runs [data-run=torn] [data-open]").click()
    expect(page.locator("#toast")).to_contain_text(f"{ROLLOUT} has 60 bytes instead of")
    expect(page.locator("h1")).to_be_visible()

    # An address of nothing is a page with a way home.
    for path in ("/runs/nothing", "/runs/..%2f..%2fetc", "/live/nothing", "/sequences/x/thumbnail"):
        answer = page.goto(f"{served.base}{path}")
        assert answer is not None
        assert answer.status == 404
        text = page.locator("body").inner_text()
        assert "Traceback" not in text
        assert "{" not in text
        expect(page.locator("a[href='.']").first).to_be_visible()
