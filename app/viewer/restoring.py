"""Making a state that somebody asked for, as by a link, fit what is there."""

from dataclasses import replace

from app.viewer.content.camera_path import CameraPath
from app.viewer.content.content import Content
from app.viewer.content.layers import default_layers
from app.viewer.content.session_state import SessionState
from app.viewer.scene.framing import frame_content, pose_of_view
from physhandi.errors import UsageError


def complete_state(state: SessionState, content: Content) -> SessionState:
    """Fill in what a state leaves open: layers, fitted parameters and where a view stands.

    Args:
        state: What is asked for.
        content: What there is.

    Returns:
        The state with its layers, if there is an object its parameters, and if it looks from a
        view the pose of that.

    Raises:
        UsageError: If the content has no such frame, part, view, object or figure; names the field.
    """
    if state.sequence_name not in {None, content.sequence_name}:
        raise UsageError(f"sequence: '{content.sequence_name}' is shown, nothing else is there.")
    if not 0 <= state.frame < content.frame_count:
        raise UsageError(
            f"f: '{content.sequence_name}' has frames 0 to {content.frame_count - 1}, "
            f"not {state.frame}."
        )
    if state.part is not None and state.part[1] >= content.frame_count:
        raise UsageError(
            f"part: '{content.sequence_name}' has frames 0 to {content.frame_count - 1}, "
            f"not {state.part[1]}."
        )
    if state.camera_keys:
        CameraPath(state.camera_keys).check(content.frame_count, content.sequence_name)
    layers = state.layers or replace(default_layers(content), **state.layer_changes)
    views = [view.name for view in content.views]
    if layers.looks_from is not None and layers.looks_from not in views:
        raise UsageError(
            f"from: '{content.sequence_name}' has no view {layers.looks_from!r}. "
            f"It has: {', '.join(views) or 'none'}."
        )
    has_wish = state.is_changed or state.is_figure
    if content.fitted is None and has_wish:
        name = next(iter(state.parameter_changes), "fig" if state.is_figure else "substeps")
        raise UsageError(f"{name}: nothing is simulated here, since no object was fitted.")
    parameters = state.parameters
    if parameters is None and content.fitted is not None:
        parameters = content.fitted.parameters.replace(**state.parameter_changes)
    pose = state.pose
    if pose is None and layers.looks_from is not None:
        view = content.views[views.index(layers.looks_from)]
        pose = pose_of_view(view, frame_content(content))
    return replace(state, layers=layers, parameters=parameters, pose=pose)
