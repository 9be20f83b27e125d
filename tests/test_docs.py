"""The documentation: what it links to is there, and the first page stays one page."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
LINK = re.compile(r"\]\(([^)\s]+)\)")
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
