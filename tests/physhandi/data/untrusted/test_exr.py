"""Headers of OpenEXR images, whether they are whole, and depth out of them."""

import tracemalloc
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from support.hostile.header_bombs import exr

from physhandi.data.untrusted.exr import (
    depth_channels,
    depth_of_picture,
    is_whole_exr,
    read_exr_header,
)
from physhandi.data.untrusted.image_header import announced_image
from physhandi.data.untrusted.media import media_decoder

HEIGHT, WIDTH = 300, 40  # More rows than the largest chunk has.


def written(
    path: Path, compression: OpenEXR.Compression, name: str = "Z", **header: object
) -> np.ndarray:
    image = np.random.default_rng(0).random((HEIGHT, WIDTH)).astype(np.float32)
    OpenEXR.File({"compression": compression, **header}, {name: image}).write(str(path))
    return image


COMPRESSIONS = [
    getattr(OpenEXR, name)
    for name in sorted(dir(OpenEXR))
    if name.endswith("_COMPRESSION") and not name.startswith("NUM")
]


@pytest.mark.parametrize("compression", COMPRESSIONS, ids=lambda one: one.name)
@pytest.mark.parametrize("kind", ["rows", "tiles"])
def test_what_is_whole_and_what_is_cut_is_told_apart(tmp_path, compression, kind):
    path = tmp_path / "depth.exr"
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    image = written(path, compression, **(tiles if kind == "tiles" else {}))
    announced = announced_image(path)
    assert (announced.form, announced.size) == ("EXR", (WIDTH, HEIGHT))
    assert (announced.number, announced.channel_count) == (np.float32, 1)
    assert is_whole_exr(path)
    found = media_decoder().exr(path, ["Z"])
    is_lossless = not compression.name.startswith(("DWA", "B44", "PXR24"))
    np.testing.assert_allclose(found, image, atol=0 if is_lossless else 0.05)
    content = path.read_bytes()
    for end in (len(content) - 1, len(content) // 2, 400):
        path.write_bytes(content[:end])
        assert not is_whole_exr(path)


def test_an_image_whose_writer_was_killed_is_not_whole(tmp_path):
    path = tmp_path / "depth.exr"
    written(path, OpenEXR.ZIP_COMPRESSION)
    content = path.read_bytes()
    with path.open("rb") as stream:
        header = read_exr_header(stream)
    table = 8 * header.chunk_count  # It is written last.
    path.write_bytes(content[: header.table_at] + bytes(table) + content[header.table_at + table :])
    assert not is_whole_exr(path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (exr(100_000, 100_000), "announces 100000x100000 px in a file of"),
        (exr(-5, 10), "announces -5x10 px"),
        (exr(7_000, 7_000, names=("a.Z", "b", "c")), "3 channels of 7000x7000 px; at most"),
        (exr(9, 9, flags=0x1000), "several parts"),
        (exr(9, 9, flags=0x800), "deep pixels"),
        (exr(9, 9, displayWindow=bytes(16)), "dataWindow and displayWindow"),
        (exr(9, 9, sampling=2), "several resolutions"),
        (exr(9, 9, names=()), "no channels"),
        (exr(9, 9, names=tuple(f"c{n}" for n in range(65))), "more than 64"),
        (exr(9, 9, channels=b"Z\0\x07\0\0\0" + bytes(12)), "damaged list of channels"),
        (exr(9, 9, channels=bytes(1 << 17)), "damaged OpenEXR header"),
        (exr(9, 9, compression=b"\x63"), "compressed in a way that is not read"),
        (exr(9, 9, flags=0x200, tiles=bytes(9)), "damaged OpenEXR header"),
        (exr(9, 9, flags=0x200, tiles=b"\x20\0\0\0\x20\0\0\0\x01"), "several sizes"),
        (exr(9, 9, flags=0x200), "cut off"),
        (exr(9, 9, names=("u", "v")), "channels u, v, and none is called Z, depth, Y or R"),
        (exr(9, 9, names=("A", "distance")), "A, distance, and none"),  # Along the ray, mostly.
        (exr(9, 9, names=("a.Z", "b.Z")), "channels a.Z, b.Z, several of which may be depth"),
        (exr(9, 9, names=("x" * 255, *"abcdefgh")), "f, g and 1 more, and none"),
        (exr(9, 9, names=("\x1b[2JZ", "u")), "damaged list of channels"),
        (exr(9, 9, names=("x" * 256, "u")), "damaged list of channels"),
        (exr(9, 9, names=("u",)).replace(b"u\0\x02", b"\xff\0\x02"), "damaged list of channels"),
        (exr(9, 9)[:60], "cut off"),
        (exr(9, 9).replace(b"dataWindow", b"dataMirror"), "no size"),
        (exr(9, 9).replace(b"comments", b"x" * 300), "damaged OpenEXR header"),
    ],
)
def test_what_no_depth_can_be_is_told_by_its_header(tmp_path, content, words):
    path = tmp_path / "depth.exr"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=words):
        announced_image(path)


def test_a_layer_may_have_a_name_of_any_alphabet(tmp_path):
    path = tmp_path / "depth.exr"
    image = written(path, OpenEXR.ZIP_COMPRESSION, "Ebène 深度.Z")
    with path.open("rb") as stream:
        names = [*read_exr_header(stream).channels]
    assert names == ["Ebène 深度.Z"]
    np.testing.assert_array_equal(media_decoder().exr(path, names), image)


def test_a_table_as_long_as_the_picture_takes_no_memory(tmp_path):
    path = tmp_path / "depth.exr"
    count = 2_000_000
    content = exr(1, count, compression=b"\0")
    places = np.full(count, len(content), "<u8")
    places[-1] = len(content) + 8 * count - 4  # Only the last one tells that the end is missing.
    with path.open("wb") as stream:
        stream.write(content)
        places.tofile(stream)
    del places
    tracemalloc.start()
    try:
        assert not is_whole_exr(path)
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
        with path.open("ab") as stream:
            stream.write(bytes(8))
        assert is_whole_exr(path)
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("names", "chosen"),
    [
        (["anything"], ["anything"]),
        (["A", "B", "G", "R", "Z"], ["Z"]),
        (["A", "Depth"], ["Depth"]),
        (["layer.R", "layer.Depth.Z"], ["layer.Depth.Z"]),
        (["B", "G", "R"], ["R", "G", "B"]),
        (["A", "Y"], ["Y"]),
        (["A", "R"], ["R"]),
    ],
)
def test_the_channel_of_depth_is_found_by_its_name(names, chosen):
    assert depth_channels(names) == chosen


def test_three_channels_are_depth_if_they_say_the_same():
    depth = np.array([[0.5, np.nan], [np.inf, 0.7]], np.float32)
    for others in (depth, np.zeros_like(depth)):
        found = depth_of_picture(np.stack([depth, others, others], axis=-1))
        np.testing.assert_array_equal(found, depth)
    assert depth_of_picture(np.stack([depth, depth + 1, depth], axis=-1)) is None


def test_what_cannot_be_decoded_is_told(tmp_path):
    path = tmp_path / "depth.exr"
    written(path, OpenEXR.ZIP_COMPRESSION)
    content = bytearray(path.read_bytes())
    content[600:-20] = bytes(len(content) - 620)
    path.write_bytes(content)
    assert media_decoder().exr(path, ["Z"]) is None
    path.write_text("no image")
    assert media_decoder().exr(path, ["Z"]) is None
