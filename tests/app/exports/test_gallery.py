"""Galleries: folders of pages that need no server."""

import json
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from support.server.server_world import World

from app.cli import main
from app.exports import gallery
from app.exports.gallery import GALLERY_FILE, write_gallery
from app.exports.request import FileRequest
from app.previews.clip import Clip
from physhandi.errors import RunError, UsageError
from physhandi.run import Run

NAME = '<img src=x onerror="alert(1)">'


@pytest.fixture
def queries(monkeypatch: pytest.MonkeyPatch) -> list[Mapping[str, str]]:
    """Makes small pages and pictures in the place of scenes; what pages were asked to show."""
    asked: list[Mapping[str, str]] = []

    def make(order: FileRequest, path: Path, report: object) -> None:
        del report
        asked.append(order.query)
        path.write_text("<html><head><title>Scene</title></head><body></body></html>")

    picture = np.zeros((2, 2, 4), np.uint8)
    monkeypatch.setattr(gallery, "make", make)
    monkeypatch.setattr(gallery, "clip_of_run", lambda *_, **__: Clip([picture], 40))
    return asked


def test_the_command_writes_an_index_and_whole_pages(world: World, tmp_path: Path) -> None:
    out, data = tmp_path / "new" / "gallery", str(world.settings.data_dir)
    with pytest.raises(SystemExit) as end:
        main(["gallery", "fitted", "--out", str(out), "--title", "<b>&", "--data-dir", data])
    assert end.value.code in {0, None}
    index = (out / "index.html").read_text()
    assert "<h1>&lt;b&gt;&amp;</h1>" in index
    addresses = re.findall(r'(?:href|src|srcset)="([^"]+)"', index)
    assert len(addresses) >= 4
    assert all((out / address).stat().st_size for address in addresses)
    about = json.loads((out / GALLERY_FILE).read_text())
    (run,) = about["runs"]
    page = (out / run["pages"]["sheet"]).read_text()
    assert page.index("Content-Security-Policy") < page.index("<script")
    assert 'href="../index.html"' in page
    assert "__VISER_EMBED_DATA__" in page
    assert not re.search(r"""(src|href)=["']?(https?:)?//""", page)
    assert [path.name for path in out.parent.iterdir()] == ["gallery"]


@pytest.mark.usefixtures("queries")
def test_names_are_text_and_runs_of_the_same_id_have_pages_of_their_own(
    world: World, run: Run, tmp_path: Path
) -> None:
    run.name = NAME
    index = write_gallery([run, run], tmp_path / "gallery", world.catalog).read_text()
    assert NAME not in index
    assert index.count("&lt;img src=x") == 2
    pages = sorted((tmp_path / "gallery" / "runs").iterdir())
    assert [page.name for page in pages] == ["fitted_1.html", "fitted_2_1.html"]


def test_only_a_gallery_is_replaced_and_nothing_is_left_half_written(
    world: World,
    run: Run,
    queries: list[Mapping[str, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "gallery"
    write_gallery([run], out, world.catalog, title="First", link="?color=strain")
    assert queries == [{"color": "strain", "sequence": "sheet"}]
    with pytest.raises(UsageError, match="exists already"):
        write_gallery([run], out, world.catalog)

    def fail(*_: object) -> None:
        raise RunError("broken")

    with monkeypatch.context() as patch:
        patch.setattr(gallery, "make", fail)
        with pytest.raises(RunError, match="broken"):
            write_gallery([run], out, world.catalog, overwrite=True)
    assert "First" in (out / "index.html").read_text()
    write_gallery([run], out, world.catalog, title="Second", overwrite=True)
    assert "Second" in (out / "index.html").read_text()
    foreign = tmp_path / "thesis"
    foreign.mkdir()
    (foreign / "index.html").write_text("mine")
    with pytest.raises(UsageError, match="no gallery"):
        write_gallery([run], foreign, world.catalog, overwrite=True)
    assert (foreign / "index.html").read_text() == "mine"
    assert not list(tmp_path.glob(".*.tmp"))


def test_what_makes_no_gallery_is_refused(world: World, run: Run, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="at least one run"):
        write_gallery([], tmp_path / "gallery", world.catalog)
    with pytest.raises(UsageError, match="all sequences"):
        write_gallery([run], tmp_path / "gallery", world.catalog, link="sequence=sheet")
