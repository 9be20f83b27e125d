"""The real recording that ships with the project: a hand before two cameras, shortened.

It is made of the download of TemugeB/handpose3d (two videos and their calibration, MIT licence):

    PYTHONPATH=.:tests python -m bundled_recording DOWNLOAD sequences/stereo_hand
"""

import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.data.importers.stereo import import_stereo
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.synthetic.film.filming import save_video

ORIGIN = "TemugeB/handpose3d on GitHub"
FRAMES = range(212, 272)
"""Frames that are kept: the hand opens and closes."""
SIZE = 432
"""Width and height of the images that are kept [px]."""


def shorten(source: Path | str, folder: Path | str, *, overwrite: bool = False) -> Sequence:
    """Cut the recording, make its images smaller and keep its licence beside it.

    Args:
        source: The download: ``cam{0,1}_test.mp4``, their calibration and ``LICENSE``.
        folder: Where the sequence shall appear; the folder's name becomes its name.
        overwrite: Whether to replace a sequence that is there.

    Raises:
        ImportFailedError: If a file of the download is missing or malformed.
        SequenceError: If the folder exists and `overwrite` is false.
    """
    with TemporaryDirectory() as beside:
        whole = import_stereo(
            source, Path(beside) / "whole", origin=ORIGIN, licence="MIT, see LICENSE"
        )
        with SequenceWriter(folder, overwrite=overwrite) as writer:
            for view, described in zip(whole.views, whole.meta.views, strict=True):
                rel = f"views/{described.name}/color.mp4"
                kept = (shrink(view.color(frame)) for frame in FRAMES)
                save_video(writer, rel, kept, whole.frame_rate)
            writer.copy("LICENSE", Path(source) / "LICENSE")
            return writer.finish(
                replace(
                    whole.meta,
                    name=writer.folder.name,
                    description="A right hand opens and closes before two calibrated cameras. "
                    "Filmed, not simulated.",
                    label="real",
                    frame_count=len(FRAMES),
                    reconstruction=None,
                    views=tuple(
                        ViewMeta(name=view.name, camera=smaller(view.camera))
                        for view in whole.meta.views
                    ),
                    provenance={
                        **whole.meta.provenance,
                        "note": f"Frames {FRAMES[0]} to {FRAMES[-1]}, "
                        f"from {whole.meta.views[0].camera.width} to {SIZE} px.",
                    },
                )
            )


def shrink(image: UInt8[ndarray, "row column 3"]) -> UInt8[ndarray, "row column 3"]:
    """Make an image as large as those that are kept."""
    return np.asarray(cv2.resize(image, (SIZE, SIZE), interpolation=cv2.INTER_AREA))


def smaller(camera: PinholeCamera) -> PinholeCamera:
    """Scale a camera with its image; whole numbers are the middles of pixels."""
    scale = SIZE / camera.width
    K = camera.K.copy()
    K[:2, 2] += 0.5
    K[:2] *= scale
    K[:2, 2] -= 0.5
    return replace(camera, K=np.asarray(K), width=SIZE, height=SIZE)


if __name__ == "__main__":
    shorten(sys.argv[1], sys.argv[2])
