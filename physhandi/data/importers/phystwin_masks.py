"""Composes the labels of a PhysTwin case's pixels from its masks, one frame at a time."""

from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from numpy import ndarray

from physhandi.data.importers.phystwin_fields import fail, flags, named, read_json
from physhandi.data.importers.phystwin_images import CaseImages, read_image
from physhandi.data.untrusted import read_untrusted

CONTROLLER = "hand"
"""Label of the masks that move the object; there may be several."""
OBJECT_MASK, FIRST_HAND_MASK, OTHER_HAND_MASK = 1, 2, 3


class MaskSource:
    """Labels of one camera's pixels, from per-object masks or from PhysTwin's cleaned ones."""

    def __init__(self, images: CaseImages, cleaned: Any | None) -> None:
        """Find out which mask is which.

        Args:
            images: The camera.
            cleaned: Content of ``processed_masks.pkl``, used where there are no masks per object.

        Raises:
            ImportFailedError: If the labels do not name exactly one object.
        """
        self._images = images
        self._cleaned = cleaned
        self._labels: list[tuple[Path, int]] = []
        if images.mask is not None:
            self._labels = _read_labels(images)

    def label(self, frame: int) -> UInt8[ndarray, "row column"]:
        """Compose the labels of a frame; a hand covers the object where both claim a pixel."""
        label = np.zeros((self._images.height, self._images.width), np.uint8)
        for folder, value in self._labels:
            label[self._read(folder, frame)] = value
        if self._cleaned is not None:
            for field, value in (("object", OBJECT_MASK), ("controller", FIRST_HAND_MASK)):
                label[self._read_cleaned(field, frame)] = value
        return label

    def _read(self, folder: Path, frame: int) -> Bool[ndarray, "row column"]:
        path = self._images.frame(folder, frame, ".png")
        image = read_image(path, cv2.IMREAD_UNCHANGED)
        if image.dtype != np.uint8 or image.ndim != 2:
            fail(path, f"is {image.dtype}{image.shape}; expected an 8-bit grey mask, 0 or 255")
        self._images.check_size(path, image)
        is_set = np.asarray(image == 255)
        if not (is_set | (image == 0)).all():
            fail(path, "has other values than 0 and 255. Threshold the mask")
        return is_set

    def _read_cleaned(self, field: str, frame: int) -> Bool[ndarray, "row column"]:
        path = self._images.case / "mask/processed_masks.pkl"
        where = f"frame {frame}, camera {self._images.camera}"
        masks = _entry(_entry(self._cleaned, frame), self._images.camera)
        if not isinstance(masks, dict):
            fail(path, f"{where} is missing; expected a mask for every frame and camera")
        shape = (self._images.height, self._images.width)
        table = {f"{where}, {key}": value for key, value in named(path, masks).items()}
        return flags(path, table, f"{where}, {field}", shape)


def read_cleaned_masks(case: Path) -> Any | None:
    """Read ``processed_masks.pkl``, or None if there is none."""
    path = case / "mask/processed_masks.pkl"
    return read_untrusted(path) if path.is_file() else None


def _read_labels(images: CaseImages) -> list[tuple[Path, int]]:
    """List the mask folders with their labels, the object's first, then the hands' by number."""
    path = images.case / f"mask/mask_info_{images.camera}.json"
    names = read_json(path)
    wrong = [
        key for key, label in names.items() if not (key.isdecimal() and isinstance(label, str))
    ]
    if wrong:
        fail(path, f"field {wrong[0]!r} is {names[wrong[0]]!r}; expected labels by mask number")
    order = sorted(names, key=int)
    objects = [number for number in order if names[number] != CONTROLLER]
    if len(objects) != 1:
        found = ", ".join(f"{number}: {names[number]!r}" for number in objects) or "none"
        fail(
            path,
            f"must label exactly one mask with the object's name beside '{CONTROLLER}', found "
            f"{found}. Merge or remove masks",
        )
    hands = [number for number in order if number not in objects]
    labels = [OBJECT_MASK, FIRST_HAND_MASK, *[OTHER_HAND_MASK] * len(hands)]
    folder = images.case / f"mask/{images.camera}"
    return [
        (folder / number, label) for number, label in zip(objects + hands, labels, strict=False)
    ]


def _entry(container: Any, index: int) -> Any:
    """Look up a frame or camera in a list or in a dict, whose keys may be numbers or text."""
    if isinstance(container, list | tuple):
        items = cast("list[Any]", container)
        return items[index] if index < len(items) else None
    if isinstance(container, dict):
        table = cast("dict[Any, Any]", container)
        return table.get(index, table.get(str(index)))
    return None
