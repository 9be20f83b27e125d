"""A small stage for tests of made-up recordings: a sheet that is lifted by one side, by hand."""

import numpy as np
from numpy import ndarray

from physhandi.synthetic.bodies.bodies import Body
from physhandi.synthetic.bodies.sheets import make_sheet
from physhandi.synthetic.engines.truth import PhysicalTruth
from physhandi.synthetic.hands.true_hand import BONE_COUNT, TrueHandPose, load_true_hand

SPEED = 0.30
"""Speed at which the hands and the sheet's far edge rise [m/s]."""


def sheet_body() -> Body:
    sheet = make_sheet(0.20, 0.15, 0.02, np.random.default_rng(0), height=0.002)
    return Body(
        name="cloth",
        node=sheet.node,
        elements=sheet.faces,
        faces=sheet.faces,
        surface_node_count=len(sheet.node),
        size=(0.20, 0.15, 0.0),
        stiffness=1e5,
        element_stiffness=np.ones(len(sheet.faces)),
        poisson=0.25,
        thickness=0.001,
        radius=0.002,
        mass=0.01,
    )


def lifted_sheet(frame_count: int, sides: tuple[str, ...] = ("right",)) -> PhysicalTruth:
    """Tilt a sheet about its near edge, under hands that rise beside its far edge."""
    body = sheet_body()
    rise = SPEED * np.arange(frame_count) / 30.0
    position = np.repeat(body.node[None], frame_count, axis=0)
    share = np.clip((body.node[:, 0] + 0.1) / 0.2, 0, 1)
    position[:, :, 2] += rise[:, None] * share
    hands = {
        side: np.stack([load_true_hand(side).bone_transforms(pose) for pose in poses])
        for side, poses in (
            (side, [hand_pose(0.10 if side == "right" else -0.10, height) for height in rise])
            for side in sides
        )
    }
    return PhysicalTruth(
        body=body,
        position=position.astype(np.float32),
        contact=np.tile(body.node[:, 0] > 0.09, (frame_count, 1)),
        hold="friction",
        hands=hands,
    )


def hand_pose(across: float, height: float) -> TrueHandPose:
    return TrueHandPose(
        orientation=np.array([0.0, 0.0, np.pi]),
        position=np.array([0.26, across, 0.06 + height]),
        bend=np.zeros((BONE_COUNT, 3)),
    )


def bare_hands(truth: PhysicalTruth) -> dict:
    return {side: load_true_hand(side) for side in truth.hands}


def distance_to_sheet(truth: PhysicalTruth, frame: float, point: ndarray) -> ndarray:
    """Measure how far points are above or below the tilted sheet, in closed form [m]."""
    height = 0.002 + SPEED * frame / 30.0 * np.clip((point[:, 0] + 0.1) / 0.2, 0, 1)
    return point[:, 2] - height
