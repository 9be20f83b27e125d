"""Starts the live simulation process: ``python -m app.viewer.live FD DEVICE``."""

from physhandi.child import Channel, loading_modules, run_child


def _work(channel: Channel) -> None:
    with loading_modules():
        from app.viewer.live.worker import serve_simulations
    serve_simulations(channel)


run_child(_work)
