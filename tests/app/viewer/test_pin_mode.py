"""One rollout is kept while the sliders move the other, as a client without a browser sees it."""

import numpy as np
from viewer_client import ViewerClient
from viewer_world import FRAMES

from app.viewer.session import Sessions
from physhandi.data.run import Run

FRAME = 15


def watch(sessions: Sessions) -> ViewerClient:
    session = sessions.get(sessions.open("run", "sheet", "me"))
    assert session is not None
    return ViewerClient(f"ws://127.0.0.1:{session.port}")


def said(client: ViewerClient) -> str:
    return "\n".join(str(p["content"]) for p in client.gui.values() if "content" in p)


def nodes(client: ViewerClient, side: str) -> np.ndarray:
    return client.array(f"/compare/{side}/object/compared", "points")


def is_ready(client: ViewerClient) -> bool:
    return f"simulated {FRAMES}/{FRAMES} frames" in client.texts()


def mean_difference(client: ViewerClient) -> float:
    offset = nodes(client, "b").astype(np.float64) - nodes(client, "a")
    return 1e3 * float(np.sqrt((offset**2).sum(axis=1)).mean())


def test_the_fit_is_kept_while_sliders_move_the_other(sessions: Sessions, run: Run) -> None:
    fitted = run.array("sequences/lift/rollout.npy")
    with watch(sessions) as client:
        client.until(lambda: is_ready(client) and client.find("Keep as A") != "")
        client.set("Frame", FRAME)
        client.set("Keep as A", "the fit")
        client.until(lambda: "/compare/b/object/compared" in client.nodes)
        client.until(lambda: "mean 0 mm" in said(client) and "equal parameters" in said(client))
        assert client.visible["/object/nodes"] is False
        client.set("stiffness 10^", -1.5)
        client.until(lambda: "From A to B: stiffness" in said(client))
        client.until(lambda: is_ready(client) and "mean 0 mm" not in said(client))
        client.until(lambda: not client.take_in(0.5))  # Until all of it has been drawn.
        assert mean_difference(client) > 0.1
        np.testing.assert_allclose(nodes(client, "a"), fitted[FRAME], atol=1e-6)
        told = f"mean {mean_difference(client):.3g} mm"
        assert told in said(client)
        # What is kept next is the rollout of now, from which the fit differs as much.
        client.set("Keep as A", "this rollout")
        client.until(lambda: "mean 0 mm" in said(client))
        client.set("History", "Reset")
        client.until(lambda: told in said(client))
        np.testing.assert_allclose(nodes(client, "b"), fitted[FRAME], atol=1e-6)
        client.set("Stop comparing", True)
        client.until(lambda: client.visible["/object/nodes"] is True)
        assert client.find("Difference colors") == ""


def test_the_figure_and_the_comparison_take_turns(sessions: Sessions) -> None:
    with watch(sessions) as client:
        client.until(lambda: is_ready(client) and client.find("Keep as A") != "")
        client.set("Keep as A", "the fit")
        client.until(lambda: client.find("Difference colors") != "")
        client.set("Compare with PhysTwin", True)
        client.until(lambda: client.find("Back to the scene") != "")
        client.until(lambda: client.find("Difference colors") == "")
        client.set("Keep as A", "the fit")
        client.until(lambda: client.find("Compare with PhysTwin") != "")
        client.until(lambda: client.find("Difference colors") != "")
