"""One rollout is kept while the sliders move the other, as a client without a browser sees it."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import FRAMES, FakeSettings, FolderCatalog

from app.exports.permalink import state_from_query
from app.viewer.sessions import Sessions
from physhandi.run import Run

FRAME = 15


@pytest.fixture(scope="module")
def sessions(root: Path) -> Iterator[Sessions]:
    sessions = Sessions(FakeSettings(), FolderCatalog(root))
    yield sessions
    sessions.shutdown()


@pytest.fixture
def client(sessions: Sessions) -> Iterator[ViewerClient]:
    """A browser with a run that rests at a frame and is simulated to its end."""
    at_rest = state_from_query({"f": str(FRAME)})
    session_id = sessions.open("run", "sheet", "me", state=at_rest)
    session = sessions.get(session_id)
    assert session is not None
    try:
        with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
            client.until(lambda: is_ready(client) and client.find("Keep as A") != "")
            yield client
    finally:
        sessions.close(session_id)


def said(client: ViewerClient) -> str:
    return "\n".join(str(p["content"]) for p in client.gui.values() if "content" in p)


def nodes(client: ViewerClient, side: str) -> np.ndarray:
    return client.array(f"/compare/{side}/object/compared", "points")


def press(client: ViewerClient, hotkey: str) -> None:
    """Press a key, as the browser tells it."""
    client.until(lambda: hotkey in commands(client))
    client.send("CommandTriggerMessage", uuid=commands(client)[hotkey])


def commands(client: ViewerClient) -> dict[str, str]:
    """The ids of the commands that are heard, by their keys."""
    return {
        message["props"]["hotkey"]: message["uuid"]
        for message in client.messages
        if message["type"] == "RegisterCommandMessage" and message["props"]["modifier"] is None
    }


def is_ready(client: ViewerClient) -> bool:
    return f"simulated {FRAMES}/{FRAMES} frames" in client.texts()


def is_done(client: ViewerClient) -> bool:
    """Whether another rollout than the fitted one is simulated to its end."""
    told = re.search(r"([\d.e+-]+) mm from the fitted rollout", client.texts())
    return is_ready(client) and told is not None and float(told[1]) > 0


def is_as_fitted(client: ViewerClient) -> bool:
    """Whether the fitted parameters are simulated to their end; the status comes after the list."""
    texts = client.texts()
    return is_ready(client) and "nothing: parameters as fitted" in texts and not is_done(client)


def is_fitted(client: ViewerClient, side: str, fitted: np.ndarray) -> bool:
    return np.allclose(nodes(client, side), fitted[FRAME], atol=1e-6)


def mean_difference(client: ViewerClient) -> float:
    offset = nodes(client, "b").astype(np.float64) - nodes(client, "a")
    return 1e3 * float(np.sqrt((offset**2).sum(axis=1)).mean())


def test_the_fit_is_kept_while_sliders_move_the_other(client: ViewerClient, run: Run) -> None:
    fitted = run.array("sequences/lift/rollout.npy")
    client.set("Object nodes", True)
    client.set("Keep as A", "the fit")
    client.until(lambda: "/compare/b/object/compared" in client.nodes)
    client.until(lambda: "mean 0 mm" in said(client) and "equal parameters" in said(client))
    client.until(lambda: client.visible.get("/object/surface") is False)
    client.set("stiffness", -1.5)
    client.until(lambda: "From A to B: stiffness" in said(client))
    client.until(lambda: is_done(client) and mean_difference(client) > 0.1)
    # The panel may tell of it later than the scene.
    client.until(lambda: f"mean {mean_difference(client):.3g} mm" in said(client))
    client.until(lambda: is_fitted(client, "a", fitted))
    told = f"mean {mean_difference(client):.3g} mm"
    # What is kept next is the rollout of now, from which the fit differs as much.
    client.set("Keep as A", "this rollout")
    client.until(lambda: "mean 0 mm" in said(client))
    client.set("Steps", "Reset")
    client.until(lambda: told in said(client))
    client.until(lambda: is_fitted(client, "b", fitted))
    client.set("Stop comparing", True)
    client.until(lambda: client.visible["/object/surface"] is True)
    client.until(lambda: client.find("Colors of A and B") == "")


def test_a_key_compares_with_what_was_kept_last_or_with_the_fit(
    client: ViewerClient, run: Run
) -> None:
    fitted = run.array("sequences/lift/rollout.npy")
    client.set("Object nodes", True)
    # Nothing was changed: a rollout is not compared with itself.
    press(client, "V")
    client.until(lambda: client.is_told("V compares with the fit"))
    client.set("stiffness", -1.5)
    client.until(lambda: is_done(client))
    press(client, "V")
    drawn = {f"/compare/{side}/object/compared" for side in "ab"}
    client.until(lambda: drawn <= set(client.nodes))
    client.until(lambda: mean_difference(client) > 0.1)
    client.until(lambda: is_fitted(client, "a", fitted))
    changed = nodes(client, "b").copy()
    client.set("Keep as A", "this rollout")
    client.until(lambda: "mean 0 mm" in said(client))
    press(client, "V")
    client.until(lambda: client.visible.get("/object/surface") is True)
    # What was kept is on the screen itself, so that the fit tells more. It may be simulated anew.
    client.set("Steps", "Undo")
    client.until(lambda: is_as_fitted(client))
    client.set("Steps", "Redo")
    client.until(lambda: is_done(client))
    press(client, "V")
    client.until(lambda: client.find("Colors of A and B") != "")
    client.until(lambda: is_fitted(client, "a", fitted))
    press(client, "V")
    client.until(lambda: client.find("Colors of A and B") == "")
    client.set("Steps", "Reset")
    client.until(lambda: is_as_fitted(client))
    press(client, "V")
    client.until(lambda: client.find("Colors of A and B") != "")
    client.until(lambda: is_fitted(client, "b", fitted))
    client.until(lambda: np.allclose(nodes(client, "a"), changed, atol=1e-6))


def test_the_figure_and_what_was_kept_take_turns(client: ViewerClient) -> None:
    client.set("Keep as A", "the fit")
    client.until(lambda: "A kept: the fit" in said(client))
    client.set("Compare with PhysTwin", True)
    client.until(lambda: client.find("Back to the scene") != "")
    client.until(lambda: "A ours: δ 20 mm" in said(client))
    # The figure is a comparison like any other: its difference is measured and colored.
    client.until(lambda: f"PhysTwin-style: simulated {FRAMES}/{FRAMES}" in said(client))
    client.until(lambda: re.search(r"mean [\d.]+ mm", said(client)))
    # The keys of the colors are those of what is shown.
    colors = next(m for m in client.messages if m.get("uuid") == client.find("Color by"))
    client.until(lambda: client.gui[colors["container_uuid"]]["visible"] is False)
    press(client, "C")
    client.until(lambda: client.value("Colors of A and B") == "of A and B")
    press(client, "C")
    client.until(lambda: "≥" in said(client))
    client.set("Keep as A", "the fit")
    client.until(lambda: client.find("Compare with PhysTwin") != "")
    client.until(lambda: "A kept: the fit" in said(client))
