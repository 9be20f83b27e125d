import cv2
import numpy as np
import pytest
from support.waiting import LIMIT_S

from physhandi.data.untrusted.media import MediaDecoder, media_decoder
from physhandi.errors import ImportFailedError


def write_png(path, shape=(48, 64, 3), kind=np.uint8):
    image = np.random.default_rng(0).integers(0, np.iinfo(kind).max, shape).astype(kind)
    cv2.imwrite(str(path), image)
    return image


def write_video(path, frames=6):
    """Write frames of brightness 20, 50, 80, … which begins anew at 240."""
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    for frame in range(frames):
        video.write(np.full((48, 64, 3), (20 + 30 * frame) % 240, np.uint8))
    video.release()


def test_what_is_decoded_elsewhere_is_what_is_decoded_here(tmp_path):
    decoder = media_decoder()
    color = write_png(tmp_path / "color.png")
    depth = write_png(tmp_path / "depth.png", (48, 64), np.uint16)
    first = decoder.image(tmp_path / "color.png", cv2.IMREAD_COLOR)
    found = decoder.image(tmp_path / "depth.png", cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(first, color)
    np.testing.assert_array_equal(found, depth)
    assert found.dtype == np.uint16
    found[:] = 0  # It is the caller's, not what both processes share.
    np.testing.assert_array_equal(decoder.image(tmp_path / "depth.png", -1), depth)
    (tmp_path / "text.png").write_text("no image")
    assert decoder.image(tmp_path / "text.png", cv2.IMREAD_COLOR) is None


def test_frames_of_several_videos_are_given_in_any_order(tmp_path):
    decoder = media_decoder()
    paths = [tmp_path / "a.avi", tmp_path / "b.avi"]
    for path in paths:
        write_video(path)
    assert decoder.probe(paths[0]) == (6, 64, 48, 25.0)
    for index in (0, 2, 3, 1):
        for path in paths:
            image, at = decoder.frame(path, index)
            assert at == index
            assert abs(float(image.mean()) - 20 - 30 * index) < 3
    decoder.release(paths[0])
    assert decoder.frame(paths[0], 9) == (None, 6)
    assert decoder.probe(tmp_path / "none.avi")[0] == 0


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", __file__.rpartition("/tests/")[0] + "/tests")
        decoder = MediaDecoder(worker="support.hostile.hostile_decoder", longest_s=LIMIT_S)
        folder = tmp_path_factory.mktemp("media")
        for name in ("crash", "hang", "greedy", "once", "good"):
            write_png(folder / f"{name}.png")
        write_video(folder / "second.avi")
        yield decoder, folder
        decoder.close()


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("crash.png", "crash.png: crashed what decodes it"),
        ("greedy.png", "greedy.png: decoding it needs more memory than is allowed"),
    ],
)
def test_a_file_that_ends_its_decoder_is_named_and_others_are_read(hostile, name, told):
    decoder, folder = hostile
    with pytest.raises(ImportFailedError, match=told):
        decoder.image(folder / name, cv2.IMREAD_COLOR)
    assert decoder.image(folder / "good.png", cv2.IMREAD_COLOR).shape == (48, 64, 3)


def test_a_frame_that_ends_its_decoder_is_named(hostile):
    decoder, folder = hostile
    assert decoder.frame(folder / "second.avi", 0)[0] is not None
    with pytest.raises(ImportFailedError, match=r"second\.avi, frame 1: crashed"):
        decoder.frame(folder / "second.avi", 1)


def test_a_decoder_that_was_ended_by_others_starts_again(hostile):
    decoder, folder = hostile
    assert decoder.image(folder / "once.png", cv2.IMREAD_COLOR).shape == (48, 64, 3)


def test_a_file_that_takes_too_long_is_named(hostile, monkeypatch):
    decoder, folder = hostile
    monkeypatch.setattr(decoder, "_longest_s", 0.5)
    with pytest.raises(ImportFailedError, match=r"hang\.png: decoding it took more than 0.5 s"):
        decoder.image(folder / "hang.png", cv2.IMREAD_COLOR)


def test_a_frame_far_on_is_reached_in_steps_of_which_each_has_its_time(tmp_path, monkeypatch):
    write_video(tmp_path / "long.avi", 450)
    decoder = media_decoder()
    asked = []
    ask = MediaDecoder._ask

    def listen(decoder, place, **request):
        answer, image = ask(decoder, place, **request)
        asked.append((answer["at"], image is not None))
        return answer, image

    monkeypatch.setattr(MediaDecoder, "_ask", listen)
    image, at = decoder.frame(tmp_path / "long.avi", 404)
    assert at == 404
    assert abs(float(image.mean()) - 140) < 3  # (20 + 30 * 404) % 240
    assert asked == [(200, False), (400, False), (404, True)]
    assert decoder.frame(tmp_path / "long.avi", 900) == (None, 450)


def test_a_frame_on_the_way_that_ends_its_decoder_is_told_and_not_tried_for_ever(hostile):
    decoder, folder = hostile
    write_video(folder / "later.avi", 401)
    with pytest.raises(ImportFailedError, match=r"later\.avi, frame 400: crashed"):
        decoder.frame(folder / "later.avi", 400)
