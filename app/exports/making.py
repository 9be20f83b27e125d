"""Making the file of an order: the same for the server's child process and for the shell."""

import json
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from app.exports.request import FileRequest
from app.viewer.content.content import Content, open_run_content, open_sequence_content
from app.viewer.content.session_state import Pose, SessionState
from app.viewer.export.bundle import Screenshot, bundle
from app.viewer.export.snapshot import Snapshot, scene_data
from app.viewer.restoring import complete_state
from physhandi.appearance.binding import SplatBinding
from physhandi.appearance.splats import Splats
from physhandi.child import Channel, run_child
from physhandi.data.exporters import export_scene
from physhandi.data.exporters.splat_ply import read_splats, splats_to_ply
from physhandi.data.files import write_atomically, write_bytes, write_json
from physhandi.data.sequence import Sequence
from physhandi.errors import RunError, UsageError
from physhandi.object_rollout import ObjectRollout
from physhandi.run import Run
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.object_surface import ObjectSurface
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.restart import Restart

_ARRAYS, _PARAMETERS, _MODEL, _RESTART = "rollout.npz", "parameters.json", "model_", "restart_"


def store_rollout(folder: Path, rollout: ObjectRollout) -> None:
    """Keep the frames of a rollout that are ready.

    Args:
        folder: Where to; must exist.
        rollout: The rollout; later frames are left out.
    """
    count = rollout.ready
    arrays: dict[str, Any] = {
        "position": np.asarray(rollout.position[:count]),
        "control": np.asarray(rollout.control[:count]),
    }
    if rollout.velocity is not None:
        arrays["velocity"] = np.asarray(rollout.velocity[:count])
    arrays |= {_MODEL + name: array for name, array in rollout.model.to_tensors().items()}
    if rollout.restart is not None:
        arrays |= {_RESTART + name: array for name, array in rollout.restart.to_tensors().items()}
    write_atomically(
        folder / _ARRAYS,
        lambda stream: np.savez(stream, allow_pickle=False, **arrays),
        is_durable=False,
    )
    write_json(folder / _PARAMETERS, rollout.parameters.to_dict(), is_durable=False)


def load_rollout(folder: Path) -> ObjectRollout:
    """Read a rollout that `store_rollout` wrote."""
    with np.load(folder / _ARRAYS, allow_pickle=False) as stored:
        arrays = dict(stored)
    model, restart = (
        {name.removeprefix(part): a for name, a in arrays.items() if name.startswith(part)}
        for part in (_MODEL, _RESTART)
    )
    parameters = json.loads((folder / _PARAMETERS).read_text())
    return ObjectRollout(
        model=SpringMassModel.from_tensors(model),
        parameters=SimulationParameters.from_dict(parameters),
        control=arrays["control"],
        position=arrays["position"],
        velocity=arrays.get("velocity"),
        ready=len(arrays["position"]),
        restart=Restart.from_tensors(restart) if restart else None,
    )


Report = Callable[[int, int], None]


def make(
    order: FileRequest,
    out: Path,
    report: Report = lambda _done, _of: None,
    *,
    time_limit_s: float = math.inf,
) -> None:
    """Make a file, in one step or not at all.

    Args:
        order: What is to be made.
        out: File to write.
        report: Told how much is done, and of how much.
        time_limit_s: Time that there is; films that take longer are refused at once [s].

    Raises:
        PhysHandiError: If something that is asked for does not exist, or the object's motion runs
            away.
    """
    state = order.check()
    content, run = _open(order, state)
    state = complete_state(state, content)
    rollout = _rollout_of(order, state, content, report)
    # What draws takes as long to load as most files that are not drawn.
    if order.format in {"viser", "html"}:
        from app.exports.recording import record_scene

        as_html = order.format == "html"
        write_bytes(out, record_scene(content, rollout, state, report, as_html=as_html))
        return
    if order.is_from_recorded_view:
        from app.exports.recorded_film import film_recorded_view

        film_recorded_view(
            content,
            rollout,
            state,
            report,
            out,
            as_gif=order.format == "gif",
            view=order.view,
            beside=order.beside or "none",
            time_limit_s=time_limit_s,
        )
        return
    if order.format in {"mp4", "gif"}:
        from app.exports.movie import film_scene

        film_scene(
            content,
            rollout,
            state,
            report,
            out,
            as_gif=order.format == "gif",
            size=(order.width, order.height),
            motion=order.motion,
            time_limit_s=time_limit_s,
        )
        return
    if order.format == "splat-ply":
        write_bytes(out, _splats(order, run, rollout))
        return
    snapshot = Snapshot(
        content=content,
        frame=state.frame,
        rollout=rollout,
        rollout_frame=state.frame if rollout is None else min(state.frame, rollout.ready - 1),
        run=run,
        layers=state.layers,
        link=order.link,
    )
    if order.format in {"png", "zip"}:
        picture = _picture(order, snapshot, state)
        content_ = picture.content if order.format == "png" else bundle(snapshot, picture)
        write_bytes(out, content_)
    else:
        scene = replace(scene_data(snapshot), views=tuple(content.views))
        export_scene(scene, order.format, out, frame=order.frame, overwrite=True)


def surface_of(order: FileRequest) -> ObjectSurface | None:
    """Lay the surface of a run's object, if it is shown."""
    return _open(order, order.check())[0].surface


def carried_splats(
    splats: Mapping[str, ndarray], node: Float[ndarray, "node 3"]
) -> Float[ndarray, "splat 3"]:
    """Find where stored splats are when the nodes of their object are somewhere [m]."""
    try:
        return SplatBinding.of(Splats.from_tensors(splats)).carry(node[None])[0]
    except ValueError as error:
        raise RunError(f"The splats of the run cannot be used: {error}") from error


def _splats(order: FileRequest, run: Run | None, rollout: ObjectRollout | None) -> bytes:
    """Write splats where they were fitted, or in one frame of a rollout."""
    if run is None:
        raise UsageError("format: only a run has splats, a recording has none.")
    splats = read_splats(run)
    if order.frame is None or rollout is None:
        return splats_to_ply(splats)
    if order.frame >= rollout.ready:
        raise UsageError(f"f: there are frames 0 to {rollout.ready - 1}, not {order.frame}.")
    return splats_to_ply(splats, carried_splats(splats, np.asarray(rollout.position[order.frame])))


class _Places:
    """Finds the run or sequence of an order, and recordings by name."""

    def __init__(self, order: FileRequest) -> None:
        self._order = order

    def run(self, run_id: str, /) -> Run:
        return Run.open(Path(run_id))

    def sequence(self, sequence_id: str, /) -> Sequence:
        return Sequence.load(Path(self._order.recordings.get(sequence_id, sequence_id)))


def _open(order: FileRequest, state: SessionState) -> tuple[Content, Run | None]:
    places = _Places(order)
    if order.kind == "sequence":
        return open_sequence_content(places, order.folder), None
    content = open_run_content(places, order.folder, state.sequence_name)
    return content, places.run(order.folder)


def _rollout_of(
    order: FileRequest, state: SessionState, content: Content, report: Report
) -> ObjectRollout | None:
    """Find the rollout: one that was stored, the fitted one, or one that is simulated now."""
    fitted, parameters = content.fitted, state.parameters
    if order.rollout:
        return load_rollout(Path(order.rollout))
    if fitted is None or parameters is None:
        return None
    if parameters == fitted.parameters and not state.automatic_substeps:
        return fitted
    return _simulate(order, parameters, content, report, is_automatic=state.automatic_substeps)


def _simulate(
    order: FileRequest,
    parameters: SimulationParameters,
    content: Content,
    report: Report,
    *,
    is_automatic: bool,
) -> ObjectRollout:
    # This loads the simulator, which takes longer than most files that need none.
    from physhandi.fitted_object import FittedObject

    fitted = FittedObject.of(order.folder, content.sequence_name)
    rollout = fitted.begin(parameters, automatic_substeps=is_automatic)
    for _ in fitted.fill(rollout, order.device):
        report(rollout.ready, rollout.frame_count)
    return rollout


def _picture(order: FileRequest, snapshot: Snapshot, state: SessionState) -> Screenshot:
    from app.exports.offscreen import Offscreen

    with Offscreen(snapshot.content, snapshot.rollout, state) as scene:
        scene.draw(snapshot.frame, is_playing=False)
        pose: Pose = scene.pose
        image = scene.picture((order.width, order.height))
    is_written, content = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    if not is_written:
        raise UsageError("The picture could not be encoded; choose a smaller size.")
    return Screenshot(content=content.tobytes(), pose=pose, width=order.width, height=order.height)


_NICENESS = 5


def _work(channel: Channel) -> None:
    """Make the file that the only request describes; arguments are its path and the time limit."""
    os.nice(_NICENESS)  # Live scenes go first.
    (order,) = channel.requests()
    out, seconds = channel.arguments

    def report(done: int, of: int) -> None:
        channel.tell(done=done, of=of)

    make(FileRequest(**order), Path(out), report, time_limit_s=float(seconds))


if __name__ == "__main__":
    run_child(_work)
