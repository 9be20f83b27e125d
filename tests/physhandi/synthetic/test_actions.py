from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physhandi.data.sequence_meta import Side
from physhandi.errors import UsageError
from physhandi.synthetic.bodies.bodies import Body, make_body
from physhandi.synthetic.hands.actions import ACTIONS, script_action
from physhandi.synthetic.hands.grasp import INDEX, THUMB, fingertip
from physhandi.synthetic.hands.handling import SET_OUT
from physhandi.synthetic.hands.script import HandScript
from physhandi.synthetic.hands.true_hand import TrueHand, load_true_hand

HANDS: dict[Side, TrueHand] = {
    "right": load_true_hand("right", seed=0),
    "left": load_true_hand("left", seed=0),
}
BODIES = ("cloth", "towel", "rope", "plush", "pouch")


def body(name) -> Body:
    return make_body(name, np.random.default_rng(5), resolution="tiny")


@cache
def script(name: str, action: str, seed: int = 0) -> tuple[HandScript, ...]:
    return script_action(action, body(name), np.random.default_rng(seed), hands=HANDS)


def solids(one: HandScript, time: float) -> list[tuple[np.ndarray, np.ndarray, float]]:
    hand = HANDS[one.side]
    transform = hand.bone_transforms(one.at(time))
    return [
        (transform[c.bone, :3] @ [*c.start, 1], transform[c.bone, :3] @ [*c.end, 1], c.radius)
        for c in hand.capsules
    ]


def gap(one: HandScript, time: float, node: np.ndarray, radius: float) -> float:
    """Distance from the skin of a hand to the nearest skin of an object [m]."""
    gaps = []
    for start, end, thick in solids(one, time):
        line = end - start
        share = np.clip((node - start) @ line / (line @ line), 0, 1)
        away = np.linalg.norm(node - start - share[:, None] * line, axis=1)
        gaps.append(away.min() - thick - radius)
    return min(gaps)


def grip(one: HandScript, time: float) -> np.ndarray:
    """Middle between the tips of thumb and index finger."""
    hand = HANDS[one.side]
    transform = hand.bone_transforms(one.at(time))
    tips = [fingertip(hand, finger) for finger in (THUMB, INDEX)]
    return np.mean([transform[tip.bone, :3] @ [*tip.end, 1] for tip in tips], axis=0)


def lowest(scripts: Sequence[HandScript], time: float) -> float:
    return min(
        min(start[2], end[2]) - radius
        for one in scripts
        for start, end, radius in solids(one, time)
    )


@pytest.mark.parametrize(
    ("name", "action"),
    [
        *(("plush", action) for action in ACTIONS if action != "stretch"),
        *(("cloth", action) for action in ACTIONS if action not in {"squeeze", "stretch"}),
        ("rope", "push"),
        ("pouch", "squeeze"),
        ("towel", "fold"),
        ("towel", "stretch"),
    ],
)
def test_every_action_fits_every_body(name: str, action: str):
    scripts = script(name, action)
    assert [one.side for one in scripts] == (
        ["right", "left"] if action == "stretch" else ["right"]
    )
    lying = body(name)
    for one in scripts:
        assert one.begin < -0.5
        assert one.end == pytest.approx(3.0)
        assert gap(one, one.begin, lying.node, lying.radius) > 0.001
        # Nothing jumps between one frame and the next.
        times = np.arange(one.begin, 3.0, 1 / 30)
        places = np.array([grip(one, float(time)) for time in times])
        assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() * 30 < 1.0
        # The last third still moves, so the future cannot be guessed from a hand at rest.
        late = np.array([grip(one, time) for time in (2.1, 2.5, 3.0)])
        assert np.linalg.norm(np.diff(late, axis=0), axis=1).sum() > 0.005
    assert min(lowest(scripts, time) for time in (0.0, 1.0, 2.0, 3.0)) > -0.004


@pytest.mark.parametrize("name", BODIES)
def test_a_lift_grips_the_object_and_raises_it_by_a_hand(name: str):
    (one,) = script(name, "lift")
    lying = body(name)
    raised = grip(one, 3.0) - grip(one, 0.0)
    assert 0.11 < raised[2] < 0.19
    # It has the object between thumb and index finger when it has closed, before it is raised.
    closed = -0.6 if name != "plush" else 0.0
    assert gap(one, closed, lying.node, lying.radius) < 0.002
    between = np.linalg.norm(lying.node - grip(one, closed), axis=1).min()
    assert between < (0.03 if name == "plush" else 0.02)
    assert grip(one, 0.0)[2] >= grip(one, closed)[2] - 1e-3


def test_a_fold_goes_up_and_over_the_middle():
    (one,) = script("cloth", "fold")
    ways = np.array([grip(one, time) for time in np.linspace(0, 3, 13)])
    begin, top, end = ways[0, 2], ways[:, 2].max(), ways[-1, 2]
    assert top > begin + 0.05
    # It goes round by 2.45 to 2.8 rad, whose sines are 0.64 and 0.33.
    assert 0.3 < (top - end) / (top - begin) < 0.7
    assert ways[0, :2] @ ways[-1, :2] < 0.2 * np.linalg.norm(ways[0, :2]) ** 2


def test_a_stretch_gathers_then_parts():
    right, left = script("towel", "stretch")
    apart = [np.linalg.norm(grip(right, t) - grip(left, t)) for t in (0.0, 1.1, 3.0)]
    assert apart[1] < apart[0] - 0.03
    assert apart[2] > apart[0] + 0.005


def test_a_squeeze_closes_eases_and_closes_again():
    (one,) = script("plush", "squeeze")
    hand = HANDS["right"]
    tips = (fingertip(hand, THUMB), fingertip(hand, 2))

    def width(time: float) -> float:
        transform = hand.bone_transforms(one.at(time))
        a, b = (transform[tip.bone, :3] @ [*tip.end, 1] for tip in tips)
        return float(np.linalg.norm(a - b))

    begun, closed, eased, again = (width(time) for time in (0.0, 1.2, 1.8, 3.0))
    assert closed < begun - 0.005
    assert eased > closed + 0.005
    assert again == pytest.approx(closed, abs=0.003)


def test_a_wipe_turns_round_and_keeps_its_height():
    (one,) = script("cloth", "wipe")
    places = np.array([one.at(time).position for time in (0.0, 0.9, 2.1, 3.0)])
    first, second = places[1] - places[0], places[2] - places[1]
    assert first @ second < -0.5 * np.linalg.norm(first) * np.linalg.norm(second)
    assert np.ptp(places[:, 2]) < 0.003
    lying = body("cloth")
    assert -0.008 < gap(one, 0.0, lying.node, lying.radius) < 0.002
    assert lowest([one], 0.0) == pytest.approx(0.002, abs=0.002)  # just under the cloth's top


def test_a_push_touches_first_and_then_goes_on_past_where_the_object_lay():
    (one,) = script("plush", "push")
    lying = body("plush")
    assert gap(one, -1.1, lying.node, lying.radius) > gap(one, 0.0, lying.node, lying.radius)
    assert gap(one, 0.0, lying.node, lying.radius) < 0.004
    moved = one.at(3.0).position - one.at(0.0).position
    assert 0.07 < np.linalg.norm(moved[:2]) < 0.13
    assert abs(moved[2]) < 0.003


def test_the_seed_decides_everything():
    # The second is made anew, past the cache.
    first, other = (script("cloth", "lift", seed)[0] for seed in (0, 4))
    same = script.__wrapped__("cloth", "lift", 0)[0]
    assert same is not first
    for time in (-1.0, 0.5, 2.0):
        assert np.array_equal(first.at(time).position, same.at(time).position)
    assert np.linalg.norm(first.at(0.0).position - other.at(0.0).position) > 0.01


def test_a_left_hand_and_a_shorter_recording_can_be_asked_for():
    def lift(duration: float) -> HandScript:
        random = np.random.default_rng(1)
        return script_action("lift", body("rope"), random, duration=duration, side="left")[0]

    short, long = lift(0.5), lift(2.0)
    assert (short.side, short.end) == ("left", 0.5)
    rise = [grip(one, one.end)[2] - grip(one, 0.0)[2] for one in (short, long)]
    assert rise[0] == pytest.approx(rise[1] / 4, abs=0.002)


def timed(
    name: str, action: str, duration: float, set_out: float, release: float | None = None
) -> HandScript:
    (one,) = script_action(
        action,
        body(name),
        np.random.default_rng(3),
        duration=duration,
        set_out=set_out,
        release=release,
        hands=HANDS,
    )
    return one


@pytest.mark.parametrize(
    ("name", "action"),
    [("rope", "push"), ("cloth", "wipe"), ("towel", "lift")],
)
def test_a_late_hand_touches_nothing_before_it_sets_out_and_then_does_the_same(name, action):
    late, lying = timed(name, action, 3.0, 0.0), body(name)
    assert late.begin == 0.0
    assert late.end == pytest.approx(3.0)
    assert min(gap(late, t, lying.node, lying.radius) for t in (-0.5, 0.0)) > 0.0005
    assert min(gap(late, t, lying.node, lying.radius) for t in (0.9, 1.4)) < 0.002
    # It holds the object after 1.5 s, and does what it would in a recording that begins then.
    soon = timed(name, action, 1.5, SET_OUT)
    for time in (-1.5, -1.0, 0.0, 0.7, 1.5):
        # Only their tremor differs.
        np.testing.assert_allclose(
            late.at(time + 1.5).position, soon.at(time).position, atol=0.003, rtol=0
        )
        np.testing.assert_allclose(late.at(time + 1.5).bend, soon.at(time).bend, atol=0.04, rtol=0)


@pytest.mark.parametrize(
    ("name", "action"),
    [
        ("rope", "lift"),
        ("cloth", "fold"),
        ("towel", "wipe"),
    ],
)
def test_a_hand_that_lets_go_does_the_same_until_then_and_goes_away(name, action):
    one, plain = timed(name, action, 3.0, SET_OUT, 1.0), timed(name, action, 1.0, SET_OUT)
    for time in (-1.0, 0.0, 0.6, 1.0):
        np.testing.assert_array_equal(one.at(time).position, plain.at(time).position)
        np.testing.assert_array_equal(one.at(time).bend, plain.at(time).bend)
    assert one.end == pytest.approx(1.8)
    times = np.arange(1.0, 1.9, 1 / 30)
    places = np.array([grip(one, float(time)) for time in times])
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() * 30 < 1.0
    # It is as far from where it let go as it was from the object before it came.
    away = np.linalg.norm(one.at(1.8).position - one.at(1.0).position)
    came = np.linalg.norm(plain.at(-1.5).position - plain.at(-0.6).position)
    assert away > 0.8 * came > 0.03
    turn = [Rotation.from_rotvec(one.at(time).orientation) for time in (1.0, 1.8)]
    grasped = [Rotation.from_rotvec(one.at(time).orientation) for time in (-0.15, -1.5)]
    # The way out is that of the way in, turned as the wrist has been.
    difference = (turn[1] * turn[0].inv()).magnitude() - (grasped[1] * grasped[0].inv()).magnitude()
    assert abs(difference) < 0.03


@pytest.mark.parametrize(
    ("set_out", "release"), [(-1.6, None), (-1.5, 2.1), (0.3, 2.2), (0.3, None), (-1.5, 0.2)]
)
def test_a_time_that_leaves_nothing_for_an_action_is_refused(set_out, release):
    with pytest.raises(UsageError, match=r"Hands that set out at .* s have hold"):
        timed("rope", "push", 2.0, set_out, release)


def test_an_unknown_action_is_refused_by_name():
    with pytest.raises(UsageError, match=r"no action 'juggle'.*lift, fold, stretch"):
        script("cloth", "juggle")
