"""Names of everything that a run's outputs hold; docs/formats.md says what is in them."""

from dataclasses import dataclass

METRICS_FILE = "metrics.json"
"""Measures of each sequence."""
LOSSES_FILE = "losses.json"
"""Losses of each stage."""
PARAMETERS_FILE = "object/parameters.yaml"
"""Global parameters of the object."""
SEARCH_FILE = "object/search.yaml"
"""Interval in which each global parameter was searched at last, which were widened, and the next
best parameters."""
STEADINESS_FILE = "object/steadiness.yaml"
"""How far a little more or less stiffness moves the fitted motion."""
MATERIAL_FILE = "object/material.safetensors"
"""The object by itself: rest shape, springs, stiffness and damping."""
SPLATS_FILE = "object/splats.safetensors"
"""Appearance of the object: splats bound to its nodes, if they were fitted."""
SHAPE_FILE = "object/shape.yaml"
"""Kind of object that was found, and what was removed from the cloud that its nodes come from."""
REST_NODE_FILE = "object/rest_node.npy"
"""The object's rest shape, before its springs are fitted."""


@dataclass(frozen=True)
class SequenceFiles:
    """Names of what a run holds of one of its sequences."""

    name: str
    """Name of the sequence."""

    @property
    def folder(self) -> str:
        """Folder of all others."""
        return f"sequences/{self.name}"

    @property
    def meta(self) -> str:
        """Metadata of the recording that a viewer needs."""
        return f"{self.folder}/meta.yaml"

    @property
    def rollout(self) -> str:
        """Object nodes in every frame."""
        return f"{self.folder}/rollout.npy"

    @property
    def control(self) -> str:
        """Control nodes in every frame."""
        return f"{self.folder}/control.npy"

    @property
    def attachment(self) -> str:
        """Where the control nodes were when the virtual springs were laid, if they have moved."""
        return f"{self.folder}/attachment.npy"

    @property
    def contacts(self) -> str:
        """Contacts of the hands over time, if springs are attached over time."""
        return f"{self.folder}/contacts.safetensors"

    @property
    def start(self) -> str:
        """Positions and velocities of the nodes in frame 0, if they are not those of the model."""
        return f"{self.folder}/start.safetensors"

    @property
    def restart(self) -> str:
        """The observed state from which the predicted frames were simulated, if they were."""
        return f"{self.folder}/restart.safetensors"

    @property
    def object_node(self) -> str:
        """Object nodes at frame 0."""
        return f"{self.folder}/object_node.npy"

    @property
    def model(self) -> str:
        """Springs, with stiffness and damping of each."""
        return f"{self.folder}/model.safetensors"

    @property
    def edits(self) -> str:
        """Edits of single springs and nodes, if there are any."""
        return f"{self.folder}/edits.json"

    @property
    def unedited(self) -> str:
        """The springs without those edits."""
        return f"{self.folder}/unedited.safetensors"

    @property
    def keypoint(self) -> str:
        """Keypoints that the hands were fitted to."""
        return f"{self.folder}/keypoint.npy"

    @property
    def frame_errors(self) -> str:
        """Every metric frame by frame."""
        return f"{self.folder}/frame_errors.json"

    def observation(self, part: str) -> str:
        """Part of the observation of the object.

        Args:
            part: ``point``, ``is_visible``, ``is_motion_valid``, ``node_of_track``, ``cloud``,
                ``cloud_end``, ``hand_point`` or ``hand_point_end``.
        """
        return f"{self.folder}/observation/{part}.npy"

    def hand_motion(self, side: str, *, is_initial: bool = False) -> str:
        """Motion of a hand; the initial one is that before refinement."""
        return f"{self.folder}/hand_{side}{'_initial' if is_initial else ''}.safetensors"

    def hand_vertex(self, side: str) -> str:
        """Surface of a hand in every frame."""
        return f"{self.folder}/hand_{side}_vertex.npy"

    def hand_face(self, side: str) -> str:
        """Triangles of a hand."""
        return f"{self.folder}/hand_{side}_face.npy"

    def hand_keypoint(self, side: str) -> str:
        """The 21 joints of a hand in every frame."""
        return f"{self.folder}/hand_{side}_keypoint.npy"

    def hand_skin(self, side: str) -> str:
        """Bones and weights of a hand."""
        return f"{self.folder}/hand_{side}_skin.safetensors"
