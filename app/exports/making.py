"""Making the file of an order: the same for the server's child process and for the shell."""

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from app.exports.offscreen import Offscreen
from app.exports.order import SUFFIXES, Order
from app.exports.painter import paint, visible_from
from app.exports.primitives import parts_of
from app.exports.recording import record
from app.exports.scale_bar import draw_scale
from app.exports.take_store import load_take
from app.viewer.bundle import Picture, bundle
from app.viewer.content import Content, open_run, open_sequence
from app.viewer.restoring import complete_state
from app.viewer.session_state import Pose, SessionState
from app.viewer.snapshot import Snapshot, scene_data
from app.viewer.take import Take
from physhandi.data.atomic import write_bytes
from physhandi.data.exporters import export_scene
from physhandi.data.run import Run
from physhandi.data.sequence import Sequence
from physhandi.errors import UsageError
from physhandi.simulation.model import SimulationParameters

Report = Callable[[int, int], None]


def make(order: Order, out: Path, report: Report = lambda _done, _of: None) -> None:
    """Make a file, in one step or not at all.

    Args:
        order: What is to be made.
        out: File to write.
        report: Told how much is done, and of how much.

    Raises:
        PhysHandiError: If something that is asked for does not exist, or the object's motion runs
            away.
    """
    state = order.check()
    content, run = _open(order, state)
    state = complete_state(state, content)
    take = _take(order, state, content, report)
    if order.format in {"viser", "html"}:
        as_html = order.format == "html"
        write_bytes(out, record(content, take, state, report, as_html=as_html))
        return
    snapshot = Snapshot(
        content=content,
        frame=state.frame,
        take=take,
        take_frame=state.frame if take is None else min(state.frame, take.ready - 1),
        run=run,
        layers=state.layers,
        link=order.link,
    )
    if order.format in {"png", "zip"}:
        picture = _picture(order, snapshot, state)
        content_ = picture.content if order.format == "png" else bundle(snapshot, picture)
        write_bytes(out, content_)
    else:
        _write_motion(order, snapshot, out)


class _Places:
    """Finds the run or sequence of an order, and recordings by name."""

    def __init__(self, order: Order) -> None:
        self._order = order

    def run(self, run_id: str, /) -> Run:
        return Run.open(Path(run_id))

    def sequence(self, sequence_id: str, /) -> Sequence:
        return Sequence.load(Path(self._order.recordings.get(sequence_id, sequence_id)))


def _open(order: Order, state: SessionState) -> tuple[Content, Run | None]:
    places = _Places(order)
    if order.kind == "sequence":
        return open_sequence(places, order.folder), None
    content = open_run(places, order.folder, state.sequence_name)
    return content, places.run(order.folder)


def _take(order: Order, state: SessionState, content: Content, report: Report) -> Take | None:
    """Find the rollout: one that was stored, the fitted one, or one that is simulated now."""
    fitted, parameters = content.fitted, state.parameters
    if order.take:
        return load_take(Path(order.take))
    if fitted is None or parameters is None:
        return None
    if parameters == fitted.parameters and not state.automatic_substeps:
        return fitted
    return _simulate(order, parameters, content, report, is_automatic=state.automatic_substeps)


def _simulate(
    order: Order,
    parameters: SimulationParameters,
    content: Content,
    report: Report,
    *,
    is_automatic: bool,
) -> Take:
    # These load the simulator, which takes longer than most files that need none.
    from app.viewer.fitted_object import FittedObject
    from physhandi.simulation.stability import with_stable_substeps

    fitted = FittedObject(order.folder, content.sequence_name)
    control = fitted.choose_controls(None)
    model = fitted.model(parameters)
    if is_automatic:
        parameters = with_stable_substeps(parameters, model, control[0])
    take = Take.empty(model, parameters, control)
    simulator = fitted.simulator(model, parameters, order.device)
    for frame, position, velocity in simulator.frames(control):
        take.position[frame] = position
        if take.velocity is not None:
            take.velocity[frame] = velocity
        take.ready = frame + 1
        report(take.ready, take.frame_count)
    return take


def _picture(order: Order, snapshot: Snapshot, state: SessionState) -> Picture:
    with Offscreen(snapshot.content, snapshot.take, state) as scene:
        scene.draw(snapshot.frame, is_playing=False)
        pose: Pose = scene.pose
        parts = visible_from(parts_of(scene.server), pose)
        image = paint(parts, pose, order.width, order.height, is_dark=scene.is_dark)
        if scene.legend is not None:
            image = draw_scale(image, scene.legend, is_dark=scene.is_dark)
    is_written, content = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    if not is_written:
        raise UsageError("The picture could not be encoded; choose a smaller size.")
    return Picture(content=content.tobytes(), pose=pose, width=order.width, height=order.height)


def _write_motion(order: Order, snapshot: Snapshot, out: Path) -> None:
    scene = scene_data(snapshot)
    name = (
        "frames" if order.format == "ply" else f"motion.{SUFFIXES.get(order.format, order.format)}"
    )
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".export-") as folder:
        written = export_scene(scene, order.format, Path(folder) / name)
        if written.is_dir():
            written = Path(shutil.make_archive(str(written), "zip", written))
        written.replace(out)
