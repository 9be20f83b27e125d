"""Commands that make, import and check sequences."""

import shutil
from collections.abc import Sequence as Many
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from tyro.conf import Positional, arg

from app.cli.lookup import find_sequence, folder_of_sequence, open_catalog
from app.cli.output import AsJson, DataDir, Device, Several, all_values, show
from physhandi.data.files import named_fields
from physhandi.data.sequence import Sequence
from physhandi.devices import pick_device
from physhandi.errors import PhysHandiError, RunError, SequenceError, UsageError
from physhandi.fitting.checks.readiness import StageReadiness
from physhandi.fitting.config import HANDS, OBSERVATION
from physhandi.progress import watched

if TYPE_CHECKING:
    from physhandi.data.importers.recorded_view import RecordedView
    from physhandi.fitting.checks.recording_check import RecordingCheck

Hands = Annotated[Several[Literal["right", "left"]], arg(help_behavior_hint="(default: right)")]


def check(
    sequences: Positional[tuple[str, ...]], *, as_json: AsJson = False, data_dir: DataDir = None
) -> int:
    """Read every file of sequences, and say what each stage of a fit can do with them.

    With --json, one sequence gives "stages" (of each: ready, missing, state, why, remedy) and
    "problems" (level, file, frame, last_frame, field, message, remedy); several give these by name.

    Args:
        sequences: Folders or names of sequences.
    """
    from physhandi.fitting.checks.recording_check import RecordingCheck, check_recording

    if not sequences:
        raise UsageError("Name at least one sequence to check.")
    reports: dict[str, dict[str, Any]] = {}
    for name in sequences:
        result = RecordingCheck(stages={}, problems=())
        try:
            folder = folder_of_sequence(name, data_dir)
            with watched(True) as progress:
                result = check_recording(folder, progress)
            sequence = Sequence.load(folder)
        except PhysHandiError as error:
            reports[name] = {"error": str(error), **_check_report(result, as_json=as_json)}
            continue
        if result.error is not None:
            reports[name] = {"error": result.error, **_check_report(result, as_json=as_json)}
            continue
        of_hands, of_object = result.stages[HANDS], result.stages[OBSERVATION]
        reports[name] = {
            "folder": str(sequence.folder),
            "frames": sequence.frame_count,
            "frame_rate": sequence.frame_rate,
            "views": len(sequence.views),
            "hands": _use(of_hands) if sequence.hands else "not in it",
            "object": _use(of_object),
            "shape": sequence.shape or "is found by the fit",
            **_check_report(result, as_json=as_json),
        }
    only = next(iter(reports.values())) if as_json and len(reports) == 1 else {}
    show(
        reports | {key: only[key] for key in ("stages", "problems") if key in only}, as_json=as_json
    )
    return 1 if any("error" in report for report in reports.values()) else 0


def _use(stage: StageReadiness) -> str:
    return "can be reconstructed" if stage.is_ready else f"lacks {', '.join(stage.missing)}"


def _check_report(result: "RecordingCheck", *, as_json: bool) -> dict[str, Any]:
    """Write what a check found for programs, or with a line for each stage and problem."""
    if as_json:
        return result.to_dict()
    problems = [
        f"{problem.level}: {problem.message}"
        + (f" To do: {problem.remedy}." if problem.remedy and problem.level == "warning" else "")
        for problem in result.problems
        if problem.message != result.error
    ]
    stages = {name: str(stage) for name, stage in result.stages.items()}
    return {"stages": stages, "problems": problems or None}


def synthesize(
    *,
    object_: Annotated[str, arg(name="object")],
    action: str,
    out: Path,
    seed: int = 0,
    preset: str = "default",
    change: Several[str] = (),
    cameras: int = 3,
    frames: int = 90,
    set_out: float = -1.5,
    release: float | None = None,
    hold: Literal["friction", "attachment"] = "friction",
    images: Literal["all", "none"] = "all",
    image_size: Literal["full", "half", "quarter"] = "full",
    held_out_view: bool = False,
    resolution: Literal["fine", "tiny"] = "fine",
    overwrite: bool = False,
) -> None:
    """Make a sequence: hands handle a soft body in MuJoCo, and made-up cameras film it.

    Args:
        object_: What is handled: cloth, towel, rope, plush or pouch.
        action: What is done with it: lift, fold, stretch, squeeze, wipe or push.
        out: Sequence folder to write.
        seed: Decides size and material, motion, cameras and errors; from 1000 on for verification
            only.
        preset: How imperfect sensors and detectors are: clean, default, hard or paper.
        change: Levels that differ from the preset's, like depth_noise=0.1 (docs/synthhdi.md lists
            them).
        cameras: Number of cameras, 1 to 4.
        frames: Number of frames, 30 a second.
        set_out: When hands set out for it [s]; they hold it 1.5 s later, by default in frame 0.
        release: When hands begin to let go [s], which takes 0.8 s; none is never.
        hold: Hands hold by friction alone, or what they have touched for 0.1 s sticks to them.
        images: none writes lifted tracks instead of color, depth and masks: small, and made in
            seconds.
        image_size: Pictures 848, 424 or 212 px wide; detectors' errors stay as large in the world.
        held_out_view: One more camera films without errors into `truth/`, for scoring alone.
        resolution: How many nodes the simulated body has.
        overwrite: Replace a sequence that is there.
    """
    from physhandi.synthetic.synthesize import synthesize as make

    with watched(True) as progress:
        sequence = make(
            object_,
            action=action,
            out=out,
            seed=seed,
            preset=preset,
            changes=dict(_level(text) for text in all_values(change)),
            cameras=cameras,
            frames=frames,
            set_out=set_out,
            release=release,
            hold=hold,
            images=images,
            image_size=image_size,
            held_out_view=held_out_view,
            resolution=resolution,
            overwrite=overwrite,
            progress=progress,
        )
    show({"sequence": str(sequence.folder), "description": sequence.description})


def annotate(
    sequence: Positional[str],
    *,
    click: Several[str] = (),
    mask_model: Path | None = None,
    track_model: Path | None = None,
    trust_model_code: bool = False,
    overwrite: bool = False,
    data_dir: DataDir = None,
) -> None:
    """Find the object that you click on, and hands, in all images, and follow points of it.

    Writes masks and tracks into the sequence; masks that it made before are replaced.

    Args:
        sequence: Folder or name of a sequence with color and depth.
        click: Places on the object as view,frame,x,y, frames from 0 and x and y in pixels, or boxes
            around it, as view,frame,x,y,width,height with the middle first; one is mostly enough,
            without any hands alone are found.
        mask_model: Folder of SAM 2 or EdgeTAM that you have (docs/your-data.md), which finds object
            and hands in the place of what is built in.
        track_model: Folder of CoTracker3 or TAPNext that you have, which follows the points.
        trust_model_code: Let the Python code in the tracker's folder be executed.
        overwrite: Replace masks and tracks that come from elsewhere.
    """
    from app.jobs.scheduler import require_unread
    from physhandi.perception.annotation import annotate as find

    folder = find_sequence(sequence, data_dir).folder
    require_unread(open_catalog(data_dir), folder)
    clicks = [_click(text) for text in all_values(click)]
    _check_tracker(track_model, trusts_code=trust_model_code, has_clicks=bool(clicks))
    with watched(True) as progress:
        done = find(
            folder,
            clicks,
            progress,
            overwrite=overwrite,
            mask_model=mask_model,
            track_model=track_model,
            trusts_model_code=trust_model_code,
        )
    show(
        {
            "sequence": str(done.folder),
            "masks": _mask_counts(done),
            **_method(done),
            **_doubts(done),
        }
    )


def _check_tracker(track_model: Path | None, *, trusts_code: bool, has_clicks: bool) -> None:
    """Refuse what would be ignored without a word.

    Raises:
        UsageError: If there is nothing to follow, or no code to trust.
    """
    if track_model is not None and not has_clicks:
        raise UsageError("--track-model follows what --click names; give that too.")
    if trusts_code and track_model is None:
        raise UsageError(
            "--trust-model-code is for the code of a --track-model; give its folder too."
        )


def _method(sequence: Sequence) -> dict[str, Any]:
    """Tell how points of a thin object were followed."""
    about = named_fields(sequence.provenance.get("tracks")) or {}
    return {"tracks": about["method"]} if "method" in about else {}


def _doubts(sequence: Sequence) -> dict[str, Any]:
    """Tell what hands say of the scale of depth, if they doubt it."""
    from physhandi.fitting.checks.recording_check import depth_scale_problems

    problems = depth_scale_problems(sequence)
    return (
        {"problems": [f"{one.message} To do: {one.remedy}." for one in problems]}
        if problems
        else {}
    )


def _mask_counts(sequence: Sequence) -> dict[str, Any]:
    """Count, for each view with masks, the frames in which things and tracks were found."""
    counts: dict[str, Any] = {}
    for view in sequence.views:
        if not view.has_mask:
            continue
        masks = [view.mask(frame) for frame in range(sequence.frame_count)]
        alive = None if view.track_visible is None else view.track_visible.sum(axis=1)
        counts[view.name] = {
            "frames with object": sum(bool((mask == 1).any()) for mask in masks),
            "frames with hands": sum(bool((mask > 1).any()) for mask in masks),
            "least tracks in a frame": None if alive is None else int(alive.min()),
        }
    return counts


def _click(text: str) -> Any:
    from physhandi.perception.segmentation import Click

    try:
        view, frame, *place = (part.strip() for part in text.split(","))
        x, y, width, height = map(float, place if len(place) == 4 else [*place, "0", "0"])
        return Click(view, int(frame), x, y, width, height)
    except ValueError:
        raise UsageError(
            f"--click {text!r} does not name a place; write view,frame,x,y, like camera0,0,320,240."
        ) from None


def shape(
    sequence: Positional[str],
    mesh: Positional[Path],
    *,
    scale: str = "auto",
    pose: str | None = None,
    data_dir: DataDir = None,
) -> None:
    """Complete the object in the first frame by a mesh of the whole of it.

    The mesh is laid onto what all views see of the object, colored by them and stored with the
    sequence; fits then give nodes to the sides that were not seen.

    Args:
        sequence: Folder or name of a sequence with depth and masks.
        mesh: GLB, glTF, PLY, OBJ or STL file, in about the shape that the object has in frame 0.
        scale: Metres for one unit of the file, such as 0.001, or auto.
        pose: About how it lies, if it is not found: turns about the world's x, y and z axes in
            degrees, in this order, like 90,0,-30, and, if wanted, the place of the mesh's middle
            [m], like 90,0,-30,0.1,0,0.05.
    """
    from physhandi.perception.mesh_completion import RoughPose, complete_shape

    folder = find_sequence(sequence, data_dir).folder
    try:
        metres = None if scale == "auto" else float(scale)
    except ValueError:
        raise UsageError(f"--scale {scale!r} is neither a number nor auto.") from None
    completion = complete_shape(
        folder, mesh, scale=metres, pose=None if pose is None else RoughPose.parse(pose)
    )
    show(
        {
            "sequence": str(folder),
            "scale": f"{completion.scale:.6g} m for one unit",
            "median distance": f"{1e3 * completion.residual:.1f} mm from the cloud to the mesh",
            "coverage": f"{100 * completion.coverage:.0f} % of the cloud within "
            f"{1e3 * completion.tolerance:.0f} mm of it",
            "outside": f"{100 * completion.outside:.0f} % of its surface where views see nothing",
        }
    )


def _level(text: str) -> tuple[str, float]:
    name, equals, value = text.partition("=")
    try:
        return name.strip(), float(value if equals else "")
    except ValueError:
        raise UsageError(
            f"--change {text!r} does not set a level; write it like depth_noise=0.1."
        ) from None


def import_stereo(
    source: Positional[Path],
    *,
    out: Path,
    hands: Hands = (),
    origin: str = "",
    licence: str = "",
    overwrite: bool = False,
) -> None:
    """Two calibrated videos of a hand (cam0_test.mp4, c0.dat, rot_trans_c0.dat, …).

    Args:
        source: Folder of the recording.
        out: Sequence folder to write.
        hands: Hands that the recording shows: right, left or both.
        origin: Who recorded it and where it was published; kept with the sequence.
        licence: Licence of the recording; kept with the sequence.
        overwrite: Replace a sequence that is there.
    """
    from physhandi.data.importers.stereo import import_stereo as convert

    with watched(True) as progress:
        sequence = convert(
            source,
            out,
            progress,
            hands=all_values(hands, ("right",)),
            origin=origin,
            licence=licence,
            overwrite=overwrite,
        )
    show({"sequence": str(sequence.folder)})


def import_mocap(
    source: Positional[Path],
    *,
    out: Path,
    controlled_markers: Annotated[
        Several[int], arg(help_behavior_hint="(default: 0 1 11 12)")
    ] = (),
    recording_rate: float = 100.0,
    frame_rate: float = 30.0,
    nodes_per_segment: int = 1,
    node_spacing: float | None = None,
    rest_shape: Literal["straight", "first_frame"] = "straight",
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z",
    unit: Literal["m", "cm", "mm", "in"] = "m",
    overwrite: bool = False,
) -> None:
    """Motion capture of a rope held by two grippers (one .npy per trajectory).

    Args:
        source: A trajectory (frame, marker, 3), markers in order along the rope; or a folder of
            them.
        out: Folder to write one sequence per trajectory into.
        controlled_markers: Markers that sit on the grippers, counted from 0.
        recording_rate: Frames per second of the recording.
        frame_rate: Frames per second of the sequences.
        nodes_per_segment: Object nodes from one marker to the next; ropes bend as elastic rods
            with 1.
        node_spacing: Distance between nodes [m], in the place of --nodes-per-segment.
        rest_shape: Shape without tension: straight with median segment lengths, or as in the first
            frame.
        up: Axis of the recording that points up.
        unit: Length unit of the recording.
        overwrite: Replace sequences that are there.
    """
    from physhandi.data.importers.mocap import import_mocap as convert

    with watched(True) as progress:
        sequences = convert(
            source,
            out,
            progress,
            controlled_markers=all_values(controlled_markers, (0, 1, 11, 12)),
            recording_rate=recording_rate,
            frame_rate=frame_rate,
            nodes_per_segment=nodes_per_segment,
            node_spacing=node_spacing,
            rest_shape=rest_shape,
            up=up,
            unit=unit,
            overwrite=overwrite,
        )
    show({"sequences": [str(sequence.folder) for sequence in sequences]})


def import_phystwin(
    source: Positional[Path],
    *,
    out: Path,
    optimal_params: Path | None = None,
    checkpoint: Path | None = None,
    inference: Path | None = None,
    keep_decimals: bool = False,
    run: Path | None = None,
    device: Device = "auto",
) -> None:
    """A case of the PhysTwin data set, and what PhysTwin made of it.

    Args:
        source: Case folder (calibrate.pkl, metadata.json, final_data.pkl, color/, depth/, mask/,
            …).
        out: Sequence folder to write.
        optimal_params: optimal_params.pkl of PhysTwin's search; makes a run of it.
        checkpoint: best_*.pth of PhysTwin's training, with per-spring stiffness; needs
            --optimal-params.
        inference: inference.pkl, PhysTwin's own rollout; the report says how far ours is from it.
        keep_decimals: Keep the decimals of dashpot and drag, which PhysTwin drops after its search.
        run: Run folder to write; none takes the sequence folder's name with _phystwin after it.
    """
    from physhandi.data.importers.phystwin import import_phystwin as convert
    from physhandi.fitting.phystwin_run import import_phystwin_run

    if optimal_params is None and (checkpoint or inference or run):
        raise UsageError(
            "--checkpoint, --inference and --run need --optimal-params: a checkpoint holds no "
            "topology, which is built again from optimal_params.pkl."
        )
    with watched(True) as progress:
        folder = convert(source, out, progress)
        if optimal_params is None:
            show({"sequence": str(folder)})
            return
        try:
            filled = import_phystwin_run(
                Sequence.load(folder),
                optimal_params,
                checkpoint,
                run or folder.with_name(f"{folder.name}_phystwin"),
                device=pick_device(device),
                inference=inference,
                truncates_damping=False if keep_decimals else None,
                progress=progress,
            )
        except BaseException:
            shutil.rmtree(folder)  # All or nothing, so that the same command can be given again.
            raise
    show({"sequence": str(folder), "run": str(filled.folder), **filled.json("import.json")})


def import_capture(
    source: Positional[Path | None] = None,
    *,
    out: Path | None = None,
    example: Path | None = None,
    depth_scale: float | None = None,
    intrinsics: Path | None = None,
    charuco: str | None = None,
    april_grid: str | None = None,
    by_table: bool = False,
    start: int = 0,
    stop: int | None = None,
    every: int = 1,
    frame_rate: float | None = None,
    hands: Hands = (),
    click: Several[str] = (),
    mask_model: Path | None = None,
    track_model: Path | None = None,
    trust_model_code: bool = False,
    overwrite: bool = False,
) -> None:
    """Your own recording by one or several RGB-D or color cameras.

    Args:
        source: Folder with a folder for each camera (color/, depth/, intrinsics.json), such a
            folder itself, what PhysTwin's recorder writes, ROS or RealSense bags, or Record3D's
            .r3d.
        out: Sequence folder to write.
        example: Write a small raw capture into this folder, to try the import on; nothing else is
            given then.
        depth_scale: Metres per unit of depth, such as 0.001; above 1, units per metre.
        intrinsics: File with the intrinsics of all cameras, instead of those in the folder.
        charuco: Board in the pictures of calibration/CAMERA/, or in the first frames: squares
            across and down, and the side of a square [m], like 7x5,0.04. Else
            calibration/board.json may tell.
        april_grid: The same with AprilTags 36h11: tags across and down, the side of a tag and the
            gap between tags [m], like 6x6,0.03,0.009.
        by_table: Find where cameras are by the table's own pattern, such as wood or print, which
            all must see; boards and poses in the recording do not count then.
        start: First frame to import.
        stop: Frame before which to end.
        every: Import only every n-th frame.
        frame_rate: Frames per second, if neither timestamps nor a video tell it.
        hands: Hands that the recording shows: right, left or both.
        click: Places on the object as view,frame,x,y in the imported images; masks and tracks are
            then found too, as by `physhandi annotate`.
        mask_model: As for `physhandi annotate`, like the next two.
        track_model: Folder of a tracker.
        trust_model_code: Let the Python code in the tracker's folder be executed.
        overwrite: Replace a sequence that is there.
    """
    if example is not None:
        if source is not None or out is not None:
            raise UsageError("--example makes a capture and imports none; give it alone.")
        _write_example(example)
        return
    if source is None or out is None:
        raise UsageError("Give the folder of a recording and --out, or --example DIR alone.")
    from physhandi.data.importers.board_calibration import parse_board
    from physhandi.data.importers.capture import CaptureOptions
    from physhandi.data.importers.capture import import_capture as convert

    options = CaptureOptions(
        depth_scale=depth_scale,
        intrinsics=intrinsics,
        board=parse_board(charuco or "", april_grid or ""),
        by_table=by_table,
        start=start,
        stop=stop,
        every=every,
        frame_rate=frame_rate,
        hands=all_values(hands, ("right",)),
    )
    clicks = [_click(text) for text in all_values(click)]
    if mask_model is not None and not clicks:
        raise UsageError("--mask-model finds what --click names; give that too.")
    _check_tracker(track_model, trusts_code=trust_model_code, has_clicks=bool(clicks))

    def check(cameras: "Many[RecordedView]", frame_count: int) -> None:
        """Refuse clicks before minutes are spent on images."""
        from physhandi.perception.segmentation import ShownView, check_clicks

        views = {
            camera.name: ShownView(camera.size, camera.color is not None, camera.depth is not None)
            for camera in cameras
        }
        check_clicks(clicks, views, frame_count)

    with watched(True) as progress:
        sequence = convert(
            source,
            out,
            progress,
            options=options,
            overwrite=overwrite,
            keeps_same=bool(clicks) and _awaits_masks(out),
            check=check,
        )
        if clicks:
            from physhandi.perception.annotation import annotate as find

            try:
                sequence = find(
                    sequence.folder,
                    clicks,
                    progress,
                    mask_model=mask_model,
                    track_model=track_model,
                    trusts_model_code=trust_model_code,
                )
            except (UsageError, RunError) as error:
                raise type(error)(
                    f"{error} The recording is imported as {sequence.folder}; click again with "
                    "physhandi annotate."
                ) from None
    shown_fields = ("depth_scale", "pairing", "calibration", "notes")
    show(
        {
            "sequence": str(sequence.folder),
            "frames": sequence.frame_count,
            "frame_rate": sequence.frame_rate,
            "masks": _mask_counts(sequence) if clicks else None,
            **_method(sequence),
            **_doubts(sequence),
            **{
                name: sequence.provenance[name]
                for name in shown_fields
                if sequence.provenance[name]
            },
        }
    )


def _awaits_masks(folder: Path) -> bool:
    """Tell whether a sequence is there whose masks the same command was still finding."""
    from physhandi.perception.annotation import lacks_masks

    try:
        return lacks_masks(folder)
    except SequenceError:  # There is none, or it is broken; the import says so.
        return False


def _write_example(folder: Path) -> None:
    from physhandi.synthetic.raw_capture import write_example_capture

    with watched(True) as progress:
        written = write_example_capture(folder, progress)
    show({"capture": str(written), "next": f"see {written / 'README.txt'}"})


def import_mano(sources: Positional[tuple[Path, ...]], *, out: Path | None = None) -> None:
    """MANO hand models that you have downloaded under their own licence.

    Args:
        sources: MANO_LEFT.pkl, MANO_RIGHT.pkl or both.
        out: Folder of hand models (PHYSHANDI_HANDS, else ~/.local/share/physhandi/hands).
    """
    from physhandi.data.importers.mano import import_mano as convert
    from physhandi.hand.mano import hands_folder

    folder = out or hands_folder()
    show({"hands": [str(convert(path, folder)) for path in sources]})


def import_hands(
    sequence: Positional[str],
    results: Positional[Path],
    *,
    fill_gaps: bool = False,
    overwrite: bool = False,
    data_dir: DataDir = None,
) -> None:
    """Keypoints of hands that WiLoR, HaMeR or another method found in the images of a sequence.

    Args:
        sequence: Folder or name of a sequence.
        results: File of keypoints, joints or MANO's parameters, .json or .npz (docs/formats.md).
        fill_gaps: Let the built-in networks look for hands where the file has none.
        overwrite: Replace keypoints that did not come from such a file.
    """
    from physhandi.perception.hand_results import import_hands as convert

    folder = find_sequence(sequence, data_dir).folder
    with watched(True) as progress:
        done = convert(folder, results, progress, fills_gaps=fill_gaps, overwrite=overwrite)
    seen = {
        view.name: {
            side: int(np.isfinite(view.keypoint[:, hand]).all(axis=(1, 2)).sum())
            for hand, side in enumerate(done.hands)
        }
        for view in done.views
        if view.keypoint is not None
    }
    show({"sequence": str(done.folder), "frames with keypoints": seen})
