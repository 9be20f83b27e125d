"""`run.show()`: the viewer of a run in a child process."""

import http.cookiejar
import urllib.request
from pathlib import Path

import pytest

import physhandi as ph
from physhandi import viewer_process
from physhandi.child import start_module
from physhandi.errors import RunError

BUNDLED = Path(__file__).parents[3] / "sequences" / "runs" / "towel_fold_quick"


@pytest.mark.slow
def test_a_run_is_shown_on_this_machine_alone_until_it_is_stopped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    with ph.open_run(BUNDLED).show() as viewer:
        assert opened == [viewer.url]
        assert viewer.url.startswith("http://127.0.0.1:")
        cookies = urllib.request.HTTPCookieProcessor(http.cookiejar.CookieJar())
        with urllib.request.build_opener(cookies).open(viewer.url) as page:
            assert "Towel fold" in page.read().decode()
        assert viewer.is_running
    assert not viewer.is_running
    viewer.stop()
    assert repr(viewer) == "ViewerProcess(stopped)"


def test_a_viewer_that_does_not_start_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def start_nothing(_module: str, *arguments: str, **options: object) -> object:
        return start_module("physhandi.no_such_module", *arguments, **options)  # type: ignore[arg-type]  # as given

    monkeypatch.setattr(viewer_process, "start_module", start_nothing)
    with pytest.raises(RunError, match=r"could not be started: .*no_such_module"):
        ph.open_run(BUNDLED).show(opens_browser=False)


def test_a_viewer_that_does_not_answer_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer_process, "_PATIENCE_S", 0.0)
    with pytest.raises(RunError, match="could not be started: it said nothing"):
        ph.open_run(BUNDLED).show(opens_browser=False)
