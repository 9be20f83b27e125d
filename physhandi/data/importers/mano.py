"""Converts the user's own MANO files to plain arrays without pickles.

MANO's licence requires registration, so the project neither ships nor downloads its files.
"""

import hashlib
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.files import named_fields, write_atomically
from physhandi.data.untrusted.pickles import read_untrusted
from physhandi.errors import ImportFailedError

MANO_FORMAT = "physhandi-mano-1"
SHAPES: dict[str, tuple[int, ...]] = {
    "v_template": (778, 3),
    "shapedirs": (778, 3, 10),
    "posedirs": (778, 3, 135),
    "J_regressor": (16, 778),
    "weights": (778, 16),
    "kintree_table": (2, 16),
    "f": (1538, 3),
    "hands_mean": (45,),
    "hands_components": (45, 45),
}
"""Arrays of a MANO file that are stored, and their shapes."""
_PARENT = [-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14]
_LENGTH = (0.1, 0.4)
"""Plausible extent of a hand [m]; beyond it the file has other units."""


def import_mano(source: Path | str, out: Path | str) -> Path:
    """Convert ``MANO_LEFT.pkl`` or ``MANO_RIGHT.pkl`` to ``out/mano_<side>.npz``.

    The official left hand's shape directions are those of the right hand along x (they pull its
    fingers in where they should stretch); they are mirrored then, and the file says so.

    Args:
        source: The file as its publisher released it; its name tells the side.
        out: Folder of the imported hand models.

    Returns:
        The file written; an older one is replaced.

    Raises:
        ImportFailedError: If the file is refused, or lacks a field of the right shape; names both.
            Nothing is written then.
    """
    path = Path(source)
    side = _side(path)
    arrays = _checked(path, read_untrusted(path))
    mirrored = side == "left" and _shrinks_along_x(arrays)
    if mirrored:
        arrays["shapedirs"][:, 0] *= -1
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    notes = {"format": MANO_FORMAT, "side": side, "source_sha256": digest}
    texts = {name: np.array(value) for name, value in notes.items()}
    target = Path(out) / f"mano_{side}.npz"
    target.parent.mkdir(parents=True, exist_ok=True)
    content: dict[str, Any] = {**texts, "is_shape_mirrored": np.array(mirrored), **arrays}
    write_atomically(target, lambda stream: np.savez(stream, allow_pickle=False, **content))
    return target


def _side(path: Path) -> Literal["right", "left"]:
    named = [side for side in ("right", "left") if side in path.stem.lower()]
    if len(named) != 1:
        raise ImportFailedError(
            f"{path}: its name does not tell the side; keep MANO's names, MANO_RIGHT.pkl and "
            "MANO_LEFT.pkl."
        )
    return cast("Literal['right', 'left']", named[0])


def _checked(path: Path, tree: Any) -> dict[str, ndarray]:
    fields = named_fields(tree)
    if fields is None:
        raise ImportFailedError(f"{path}: it holds no dictionary of fields, so it is no MANO file.")
    arrays: dict[str, ndarray] = {}
    for name, shape in SHAPES.items():
        if name not in fields:
            raise ImportFailedError(
                f"{path}: the field '{name}' is missing; MANO_RIGHT.pkl and MANO_LEFT.pkl have it."
            )
        arrays[name] = _array(path, name, fields[name], shape)
    if fields.get("bs_type", "lrotmin") != "lrotmin":
        raise ImportFailedError(
            f"{path}: the field 'bs_type' is {fields['bs_type']!r}; MANO has 'lrotmin'."
        )
    _check_meaning(path, arrays)
    whole = {name: arrays[name].astype(np.int64) for name in ("f", "kintree_table")}
    return {**arrays, **whole}


def _array(path: Path, name: str, value: Any, shape: tuple[int, ...]) -> ndarray:
    array = cast("Any", value) if isinstance(value, ndarray) else None
    if array is None or array.shape != shape or array.dtype.kind not in "iuf":
        actual = "no array" if array is None else f"{array.dtype} of shape {array.shape}"
        raise ImportFailedError(
            f"{path}: the field '{name}' is {actual}; MANO has numbers of shape {shape}."
        )
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        where = [int(index) for index in np.argwhere(~np.isfinite(array))[0]]
        raise ImportFailedError(f"{path}: the field '{name}' is not finite at {where}.")
    return array


def _check_meaning(path: Path, arrays: dict[str, ndarray]) -> None:
    extent = float(np.ptp(arrays["v_template"], axis=0).max())
    if not _LENGTH[0] < extent < _LENGTH[1]:
        raise ImportFailedError(
            f"{path}: the hand of the field 'v_template' is {extent:.4g} m long; MANO is in metres."
        )
    for name in ("weights", "J_regressor"):
        off = float(np.abs(arrays[name].sum(axis=1) - 1).max())
        if off > 0.01:
            raise ImportFailedError(
                f"{path}: a row of the field '{name}' sums to {1 + off:.3g} or {1 - off:.3g}, "
                "not to 1."
            )
    faces, vertex_count = arrays["f"], len(arrays["v_template"])
    if (faces != np.round(faces)).any() or faces.min() < 0 or faces.max() >= vertex_count:
        raise ImportFailedError(
            f"{path}: the field 'f' has vertices from {faces.min():g} to {faces.max():g}; there "
            f"are {vertex_count}."
        )
    # The root's parent is written as 2**32 - 1.
    parents = arrays["kintree_table"][0][1:].astype(np.int64).tolist()
    if parents != _PARENT[1:]:
        raise ImportFailedError(
            f"{path}: the field 'kintree_table' joins {parents}; MANO joins {_PARENT[1:]}."
        )


def _shrinks_along_x(arrays: dict[str, Float[ndarray, "..."]]) -> bool:
    """Whether the first shape direction, a hand's size, shrinks along x what grows along y, z."""
    vertex = arrays["v_template"] - arrays["v_template"].mean(axis=0)
    change = arrays["shapedirs"][:, :, 0]
    change = change - change.mean(axis=0)
    grows = (vertex * change).sum(axis=0)
    return bool(grows[0] * (grows[1] + grows[2]) < 0)
