import json

import numpy as np
import pytest
import torch
from support.inputs.clicked_disc import FRAMES, HEIGHT, WIDTH, disc_click, write_disc
from support.inputs.made_models import SIDE, write_edgetam, write_sam2

from physhandi.errors import UsageError
from physhandi.perception.annotation import annotate
from physhandi.perception.mask_model import MaskModel, Prompt
from physhandi.perception.segmentation import Click, segment


@pytest.fixture(scope="module")
def sam2(tmp_path_factory):
    return write_sam2(tmp_path_factory.mktemp("models") / "sam2")


@pytest.fixture(autouse=True)
def one_thread():
    """Tiny networks are slower with several threads, much slower beside other tests."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def of_transformers(source, folder, view, frame, pixel):
    """Run the whole video as Transformers' own loop does."""
    import transformers
    from transformers.models.edgetam_video import modeling_edgetam_video as edgetam
    from transformers.models.sam2_video import modeling_sam2_video as sam2

    if source == "sam2":
        kind, session = transformers.Sam2VideoModel, sam2.Sam2VideoInferenceSession
    else:
        kind, session = transformers.EdgeTamVideoModel, edgetam.EdgeTamVideoInferenceSession
    model = kind.from_pretrained(folder)
    video = torch.from_numpy(np.stack([view.color(at) for at in range(FRAMES)])).permute(0, 3, 1, 2)
    video = torch.nn.functional.interpolate(video / 255, (SIDE, SIDE), mode="bilinear")
    mean, deviation = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    video = (video - mean[:, None, None]) / deviation[:, None, None]
    session = session(video=video, video_height=HEIGHT, video_width=WIDTH, dtype=torch.float32)
    place = torch.tensor([[[[pixel[0] * SIDE / WIDTH, pixel[1] * SIDE / HEIGHT]]]])
    label = torch.ones(1, 1, 1, dtype=torch.int32)
    session.add_point_inputs(
        session.obj_id_to_idx(1), frame, {"point_coords": place, "point_labels": label}
    )
    session.obj_with_new_inputs = [1]
    found = {}
    for is_back in (False, True):
        for out in model.propagate_in_video_iterator(session, frame, reverse=is_back):
            found.setdefault(out.frame_idx, out.pred_masks)
    logit = torch.cat([found[at] for at in range(FRAMES)])
    return torch.nn.functional.interpolate(logit, (HEIGHT, WIDTH), mode="bilinear")[:, 0].numpy()


@pytest.mark.parametrize(("write", "source"), [(write_sam2, "sam2"), (write_edgetam, "edgetam")])
def test_a_click_is_followed_as_the_models_own_library_does(tmp_path, write, source):
    folder = write(tmp_path / "model")
    sequence, _ = write_disc(tmp_path / "disc")
    view = sequence.views[0]
    _, _, x, y = disc_click()
    told = {1: [Prompt(4, np.array([[x, y]]), np.zeros((0, 2)))]}
    model = MaskModel(folder)
    assert model.provenance()["source"] == source
    found = dict(model.follow(view, told))
    assert list(found) == [4, 5, 6, 7, 8, 3, 2, 1, 0]
    logit = np.stack([found[at][1] for at in range(FRAMES)])
    expected = of_transformers(source, folder, view, 4, (x, y))
    assert expected.std() > 0.01
    np.testing.assert_allclose(logit, expected, atol=2e-3 * expected.std())


def test_things_that_are_told_in_different_frames_share_a_pass(tmp_path, sam2):
    view = write_disc(tmp_path / "disc", frames=5)[0].views[0]
    one = Prompt(1, np.array([[30.0, 40.0]]), np.array([[5.0, 5.0]]))
    two = Prompt(3, np.array([[80.0, 60.0]]), np.zeros((0, 2)))
    model = MaskModel(sam2)
    both = dict(model.follow(view, {1: [one], 2: [two]}))
    assert sorted(both) == list(range(5))
    for thing, prompt in ((1, one), (2, two)):
        for frame, logits in model.follow(view, {thing: [prompt]}):
            np.testing.assert_allclose(both[frame][thing], logits[thing], atol=1e-4)


def test_masks_of_sam2_are_stored_like_built_in_ones(tmp_path, sam2):
    sequence, _ = write_disc(tmp_path / "disc", hand=True, frames=3)
    click = Click(*disc_click())
    done = annotate(sequence.folder, [click], mask_model=sam2)
    done.validate()
    about = done.provenance["masks"]
    assert about["source"] == "sam2"
    assert len(about["model_sha256"]) == 64
    assert about["clicks"] == [{"view": "top", "frame": 0, "x": click.x, "y": click.y}]
    assert str(tmp_path) not in (sequence.folder / "sequence.yaml").read_text()
    assert done.provenance.get("tracks", {"source": "built-in"})["source"] == "built-in"
    annotate(sequence.folder, [click])  # They were made here, so they are replaced.


class Told:
    """A model in whose place the truth is, and which keeps what it was told."""

    def __init__(self, true):
        self.true, self.prompts = true, {}

    def follow(self, view, prompts):
        self.prompts[view.name] = prompts
        for frame in range(view.frame_count):
            label = self.true[view.name][frame]
            yield frame, {thing: np.where(self.claim(label, thing), 1.0, -1.0) for thing in prompts}

    @staticmethod
    def claim(label, thing):
        claimed = label == thing
        if thing == 2:
            claimed = claimed.copy()
            claimed[:, :6] = True  # An arm, far from the hand.
        return claimed


def test_a_model_is_told_places_on_object_and_hand_in_every_view(tmp_path):
    sequence, true = write_disc(tmp_path / "disc", hand=True)
    model = Told(true)
    view, frame, x, y = disc_click()
    masks = segment(sequence, [Click(view, frame, x, y)], model=model)
    for name, prompts in model.prompts.items():
        assert set(prompts) == {1, 2}
        for thing, known in prompts.items():
            for prompt in known:
                for pixel, is_inside in ((prompt.inside, True), (prompt.outside, False)):
                    column, row = pixel.round().astype(int).T
                    hit = true[name][prompt.frame, row, column] == thing
                    assert hit.mean() > 0.6 if is_inside else not hit.any()
        assert [len(prompt.inside) for prompt in prompts[1]] == [1 if name == view else 3]
        here = masks[name] > 0
        assert np.array_equal(masks[name][here], true[name][here])
        assert (masks[name] == 2).sum() > 0.95 * (true[name] == 2).sum()
    (start,) = model.prompts[view][1]
    assert start.inside.tolist() == [[x, y]]
    assert len(start.outside) >= 3


def test_a_model_that_finds_nothing_at_a_click_says_so(tmp_path):
    sequence, true = write_disc(tmp_path / "disc", frames=2)
    nothing = {name: np.zeros_like(label) for name, label in true.items()}
    with pytest.raises(UsageError, match=r"top,0,.*finds nothing there.*without --mask-model"):
        segment(sequence, [Click(*disc_click())], model=Told(nothing))


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (lambda folder: (folder / "config.json").unlink(), "has a config.json with a model_type"),
        (lambda folder: (folder / "model.safetensors").unlink(), "has no model.safetensors"),
        (lambda folder: (folder / "model.safetensors").write_bytes(b"x"), "cannot be read"),
        (
            lambda folder: (folder / "config.json").write_text(json.dumps({"model_type": "bert"})),
            "holds a 'bert'",
        ),
    ],
)
def test_a_folder_that_is_no_mask_model_is_refused_by_name(tmp_path, sam2, damage, told):
    folder = tmp_path / "copy"
    folder.mkdir()
    for path in sam2.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    damage(folder)
    with pytest.raises(UsageError, match=told):
        MaskModel(folder)


def test_missing_weights_are_never_made_up(tmp_path, sam2):
    from safetensors.torch import load_file, save_file

    folder = tmp_path / "copy"
    folder.mkdir()
    (folder / "config.json").write_bytes((sam2 / "config.json").read_bytes())
    kept = load_file(sam2 / "model.safetensors")
    kept.pop("no_memory_embedding")
    save_file(kept, folder / "model.safetensors", {"format": "pt"})
    with pytest.raises(UsageError, match=r"1 weights are missing.*no_memory_embedding"):
        MaskModel(folder)
