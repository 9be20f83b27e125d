"""The documentation: what it links to is there, and the first page stays one page."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
LINK = re.compile(r"\]\(([^)\s]+)\)")
ARCHITECTURE = ROOT / "docs/architecture.md"
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """What a link may name after #, as code hosts make it of headings."""
    titles = (re.sub(r"[^\w\- ]", "", title.lower()) for title in HEADING.findall(page.read_text()))
    return {title.strip().replace(" ", "-") for title in titles}


def test_every_link_leads_somewhere() -> None:
    broken, count = [], 0
    for page in PAGES:
        for link in LINK.findall(page.read_text()):
            if link.startswith(("http:", "https:", "mailto:")):
                continue
            count += 1
            target, _, anchor = link.partition("#")
            file = (page.parent / target).resolve() if target else page
            if not file.exists() or (anchor and anchor not in anchors(file)):
                broken.append(f"{page.relative_to(ROOT)}: {link}")
    assert count > 50
    assert broken == []


def test_the_first_page_is_short_and_every_page_is_in_the_index() -> None:
    assert len((ROOT / "README.md").read_text().split()) <= 900
    index = (ROOT / "docs/index.md").read_text()
    linked = {(ROOT / "docs" / link).resolve() for link in LINK.findall(index)}
    pages = {path for path in PAGES if "docs" in path.parts} - {ROOT / "docs/index.md"}
    assert pages - linked == set()


def test_the_first_page_counts_what_follows() -> None:
    words = ("Zero", "One", "Two", "Three", "Four", "Five", "Six", "Seven", "Eight", "Nine")
    text = (ROOT / "README.md").read_text()
    (section,) = re.findall(r"^## (\w+) things to do$(.+?)^## ", text, re.M | re.S)
    assert len(re.findall(r"^\*\*\w{2,}", section[1], re.M)) == words.index(section[0])
    (profiles,) = re.findall(r"^(\w+) profiles set every switch: ([^;]+?) *\(their", text, re.M)
    named = re.findall(r"`(\w+)`", profiles[1])
    shipped = {path.stem for path in (ROOT / "physhandi/fitting/profiles").glob("*.yaml")}
    assert len(named) == words.index(profiles[0])
    assert set(named) == shipped


def defined_names(path: Path) -> set[str]:
    """Functions and classes of a module, and methods as ``Class.method``."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            methods = (part.name for part in node.body if isinstance(part, ast.FunctionDef))
            found.update(f"{node.name}.{name}" for name in methods)
    return found


def test_the_ways_of_values_lead_through_what_is_there() -> None:
    text = ARCHITECTURE.read_text()
    ways = re.findall(r"^## The way of [^\n]+\n```\n(.+?)^```\n(.*?)$", text, re.M | re.S)
    assert len(ways) == 2
    for way, below in ways:
        rows = [line.split()[:3] for line in way.splitlines()]
        # A dot stands before what is called on the way and returns.
        steps = [row for row in rows if row[0] != "·"]
        assert [int(number) for number, _, _ in steps] == list(range(1, len(steps) + 1))
        assert 8 < len(steps) <= 12
        missing = [
            f"{file}: {name}"
            for _, file, name in rows
            if not (ROOT / file).is_file() or name not in defined_names(ROOT / file)
        ]
        assert missing == []
        counted = re.match(r"(\d+) steps through (\d+) files", below)
        if counted is not None:
            files = {file for _, file, _ in steps}
            assert (int(counted[1]), int(counted[2])) == (len(steps), len(files))
    assert re.search(r"^\d+ steps through \d+ files", text, re.M)


def test_files_that_the_architecture_names_are_there() -> None:
    named = set(re.findall(r"`([\w/]+\.(?:py|js))`", ARCHITECTURE.read_text()))
    assert len(named) > 15
    places = (ROOT, ROOT / "physhandi", ROOT / "app/viewer")
    assert [name for name in named if not any((place / name).is_file() for place in places)] == []
