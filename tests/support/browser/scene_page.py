"""The page of a live scene as a user works it, and an independent count of its springs."""

import re
import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import parse_qsl, urljoin

import numpy as np
from playwright.sync_api import Locator, Page, expect
from scipy.spatial.distance import cdist

_NUMBER = r"([\d.]+(?:e[+-]?\d+)?)"
TIMEOUT_MS = 300_000
"""How long browsers wait for what must come; a busy machine can be ten times as slow as others."""
FEWER_PICTURES = """{
  const wanted = new Map();
  let last = 0;
  let ticks = 0;
  window.requestAnimationFrame = (draw) => wanted.set((last += 1), draw) && last;
  window.cancelAnimationFrame = (number) => wanted.delete(number);
  window.drawPicture = () => {
    const due = [...wanted.values()];
    wanted.clear();
    for (const draw of due) {
      try { draw(performance.now()); } catch (error) { reportError(error); }
    }
  };
  const isLeftOut = () => window.isResting || (window.isCalm && ++ticks % 2);
  setInterval(() => isLeftOut() || window.drawPicture(), 500);
}"""
"""Two pictures a second in the place of sixty: tests wait for what is in them, not for how many.

Software draws them, which is much of what these tests cost. A page that is calm draws one a second,
which costs more where a scene plays until its picture is seen; one that is resting draws none, and
`drawPicture` draws one at once, for whoever would wait for it.
`physhandi benchmark viewer` measures how many pictures a browser gets."""
LESS_WORK = (
    "--disable-gpu-compositing",
    "--webgl-msaa-sample-count=0",
    "--js-flags=--no-opt",
    "--renderer-process-limit=1",
)
"""Flags of Chromium: without a graphics card draw each picture once, and smooth none. Optimise no
scripts, for which no page of a test lives long enough. And start no process beforehand for a next
page, which most browsers of a test never open."""
_SENT = "() => new Promise((done) => setTimeout(done, 60))"
"""viser's browser sends at once or 50 ms later, and of what waits until then only the last."""
_PICTURE = "() => new Promise((done) => setTimeout(() => done(window.drawPicture())))"
"""A picture of all that had begun before: what a page does of its own accord comes in turn."""
_VALUES = """(body, name) => {
  const isNamed = (label) => label.textContent.trim().replace(/^● /, "") === name;
  const rows = [...body.querySelectorAll("label")].filter(isNamed)
    .map((label) => label.closest("div.mantine-Flex-root"));
  const isSeen = (field) => field.getBoundingClientRect().width > 0
    && getComputedStyle(field).visibility === "visible";
  return rows.flatMap((row) => {
    const fields = [...(row?.querySelectorAll("input.mantine-NumberInput-input") ?? [])];
    const marks = [...(row?.querySelectorAll(".mantine-Slider-markLabel") ?? [])];
    const isFactor = marks.some((mark) => mark.textContent.includes("×"));
    return isFactor && fields.length < 2 ? [] : fields.filter(isSeen).map((field) => field.value);
  });
}"""
"""What the fields of `ScenePage.field` hold, asked for at once: each of its steps is a question to
the browser, and tests that wait for a value ask for it time and again."""
_REST_MS = 250
"""How long the processor is left to the scene between two looks at it, which cost as much as it
takes to draw a picture."""
_SESSION = "document.getElementById('scene').contentWindow.location.pathname.split('/').at(-2)"


def scaled_pictures(pixels: float) -> str:
    """Script that has scenes drawn with other than one pixel for each of the page, and stretched.

    None of them gets a color that nothing in the scene has.

    Args:
        pixels: How many in a row, for each of the page. viser draws no fewer than the page has,
            unless its address says so.
    """
    return f"""
if (location.pathname.includes("/viewer/")) {{
  const address = new URL(location);
  address.searchParams.set("fixedDpr", "{pixels}");
  history.replaceState(history.state, "", address);
  const sharp = new CSSStyleSheet();
  sharp.replaceSync("canvas {{ image-rendering: pixelated; }}");
  document.adoptedStyleSheets.push(sharp);
}}
"""


COARSER_PICTURES = scaled_pictures(0.5)
"""A quarter of the pixels. What is laid out beside the panel counts in those that are drawn, and
needs them all."""


class ScenePage:
    """A tab with the viewer; it works the panel inside the frame."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.panel = page.frame_locator("#scene")

    @classmethod
    def opened_from(cls, home: Page) -> "ScenePage":
        """Press the button of the start page that invites to the finished run."""
        home.locator("[data-featured]").click()
        home.wait_for_url("**/live/**")
        scene = cls(home)
        scene.until(lambda: scene.has("object springs"), "the panel appears")
        return scene

    def text(self) -> str:
        return self.panel.locator("body").inner_text()

    def has(self, text: str) -> bool:
        return text in self.text()

    def number(self, before: str = "", after: str = "", text: str | None = None) -> float | None:
        """Read the number between two texts of the panel, as long as it is there."""
        text = self.text() if text is None else text
        found = re.search(re.escape(before) + r"\s*" + _NUMBER + re.escape(after), text)
        return float(found[1]) if found else None

    def row(self, label: str) -> Locator:
        """A control of the panel with its label."""
        row = self.panel.locator("label", has_text=re.compile(f"^(● )?{re.escape(label)}$"))
        return row.locator("xpath=ancestor::div[contains(@class, 'mantine-Flex-root')][1]")

    def field(self, label: str) -> Locator:
        """The number beside a slider."""
        number = "input.mantine-NumberInput-input"
        row = self.row(label).filter(has=self.panel.locator(f"{number}:visible"))
        row.wait_for()
        fields = row.locator(number)
        if row.locator(".mantine-Slider-markLabel", has_text="×").count():
            # Before the next picture, viser's own is there alone and takes powers of ten.
            expect(fields).to_have_count(2)
        return fields.filter(visible=True)

    def chosen(self, label: str) -> str:
        """What a list shows."""
        return self.row(label).get_by_role("combobox").input_value()

    def choose(self, label: str, option: str) -> None:
        """Choose from a list."""
        self.row(label).get_by_role("combobox").click()
        self.panel.get_by_role("option", name=option, exact=True).click()

    def drag(self, label: str, pixels: int, values: int) -> None:
        """Drag the handle of a slider aside, so slowly that the slider takes many values."""
        handle = self.row(label).get_by_role("slider")
        handle.scroll_into_view_if_needed()
        box = handle.bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        for number in range(1, values + 1):
            before = handle.get_attribute("aria-valuenow")
            self.page.mouse.move(x + pixels * number / values, y)
            expect(handle).not_to_have_attribute("aria-valuenow", before or "")
            self._send()
        self.page.mouse.up()

    def value(self, label: str) -> float:
        shown = self.panel.locator("body").evaluate(_VALUES, label)
        text = shown[0] if len(shown) == 1 else self.field(label).input_value()  # Waits for it.
        return float(text.removeprefix("×"))

    def set(self, label: str, value: float) -> None:
        """Put a value into the field beside a slider at once, as pasting does."""
        field = self.field(label)
        # The field looks for what changed around the caret of the last key, which may be long ago;
        # emptied, it forgets that caret and reads all of what comes next.
        field.fill("")
        field.fill(f"{value:g}")
        field.press("Enter")
        self._send()

    def type(self, label: str, text: str) -> None:
        """Type over what is in the field beside a slider, key by key."""
        field = self.field(label)
        # Entered by Control+a, a field may move its caret behind a sign after all was selected,
        # which ends that; entered with all selected, it moves none.
        field.select_text()
        field.press_sequentially(text)
        self._send()

    def write(self, label: str, text: str) -> None:
        """Type into a field for text."""
        row = self.panel.locator("label", has_text=re.compile(f"^{re.escape(label)}$"))
        row = row.locator("xpath=ancestor::div[contains(@class, 'mantine-Flex-root')][1]")
        field = row.locator("input")
        field.fill(text)
        field.press("Enter")
        self._send()

    def press(self, name: str) -> None:
        button = self.panel.get_by_role("button", name=name, exact=True)
        expect(button).to_be_enabled()
        # Lines above it come and go while something is simulated; a mouse that goes down on a
        # button and up beside it has pressed nothing.
        button.evaluate("button => button.click()")
        self._send()

    def _send(self) -> None:
        """Let what was done leave the browser, before anything else is done takes its place."""
        self.panel.locator("body").evaluate(_SENT)

    def link(self) -> dict[str, str]:
        """What the server shows, as its link tells it; a field holds at once what is typed."""
        session = self.page.evaluate(_SESSION)
        address = urljoin(self.page.evaluate("document.baseURI"), f"api/v1/sessions/{session}/link")
        return dict(parse_qsl(self.page.request.get(address).json()["query"]))

    def frame(self) -> int:
        """The frame that the server shows; links of comparisons leave out frame 0."""
        return int(self.link().get("f", 0))

    def pause(self) -> None:
        """Stop the clock; the last frame that it drew may be told after the button has changed."""
        self.press("Pause")
        self.panel.get_by_role("button", name="Play", exact=True).wait_for()
        self.until(lambda: self.value("Frame") == self.frame(), "the clock stands")

    def go(self, frame: int) -> None:
        """Go to a frame, and wait until the server has done so."""
        self.set("Frame", frame)
        self.until(lambda: self.frame() == frame == self.value("Frame"), f"frame {frame}")

    def tab(self, name: str) -> None:
        """Open a tab of the panel."""
        tab = self.panel.get_by_role("tab", name=name, exact=True)
        tab.click()
        expect(tab).to_have_attribute("aria-selected", "true")
        # Controls that appear get their names before the next picture.
        self.panel.locator("body").evaluate(_PICTURE)

    def draw(self) -> None:
        """Let the browser draw what it has heard of: what comes within a picture is in the next."""
        for _ in range(2):
            self.panel.locator("body").evaluate(_PICTURE)

    def rest(self, *, on: bool) -> None:
        """Let the browser draw nothing while nobody looks, and go on later."""
        for frame in self.page.frames:
            frame.evaluate("is => { window.isResting = is; }", on)

    def calm_down(self) -> None:
        """Let the browser draw half as many pictures from now on, since nothing plays."""
        for frame in self.page.frames:
            frame.evaluate("() => { window.isCalm = true; }")

    def download(self, name: str, path: Path) -> Path:
        """Press a button of the export panel and keep the file that the browser gets."""
        with self.page.expect_download() as download:
            self.press(name)
        target = path / download.value.suggested_filename
        download.value.save_as(target)
        return target

    def difference(self) -> float | None:
        """How far the rollout is from the fitted one [mm]; None while it is simulated."""
        return self.number(after=" mm from the fitted rollout")

    def new_difference(self, what: str, *known: float) -> float:
        """Wait until another rollout than the fitted one and known ones is there, and read it once.

        A value may be simulated twice, when it is typed and when it is entered.
        """
        found: list[float] = []

        def is_there() -> bool:
            value = self.difference()
            if value is None or value in {0.0, *known}:
                return False
            found.append(value)
            return True

        self.until(is_there, what)
        return found[-1]

    def springs(self) -> tuple[float | None, float | None]:
        """The numbers of object springs and virtual springs that are shown."""
        return self.rollout()[:2]

    def rollout(self) -> tuple[float | None, float | None, float | None]:
        """Both numbers of springs and the difference, as they are shown at one moment."""
        text = self.text()
        return (
            self.number("object springs", text=text),
            self.number("virtual springs", text=text),
            self.number(after=" mm from the fitted rollout", text=text),
        )

    def until(
        self, condition: Callable[[], bool], what: str, seconds: float = TIMEOUT_MS / 1e3
    ) -> None:
        """Wait for something; says what the panel shows if it does not come true."""
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, (
                f"{what} did not come true; the panel says\n{self.text()}"
            )
            self.page.wait_for_timeout(_REST_MS)


def object_springs(node: np.ndarray, radius: float, most: int) -> set[tuple[int, int]]:
    """Join each node to its `most` nearest others below `radius`, by comparing all pairs."""
    distance = cdist(node, node)
    np.fill_diagonal(distance, np.inf)
    springs = set()
    for first, row in enumerate(distance):
        for second in np.argsort(row, kind="stable")[:most]:
            if 1e-4 < row[second] < radius:
                springs.add((min(first, int(second)), max(first, int(second))))
    return springs
