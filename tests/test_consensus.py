"""Consensus on networks made by hand."""

import math

import pytest
import torch
from moments import WORLD, communication, moment
from tensordict import TensorDict
from torch import Tensor

from emberlink.comm._agreement import choose_leader, known_discoverers
from emberlink.comm._heading import HeadingConfig
from emberlink.comm._radio import Radio, RadioConfig, neighbours
from emberlink.comm.consensus import Consensus, ConsensusConfig
from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig


def in_a_row(count: int, gap: float = 9.0) -> list[list[float]]:
    return [[gap * i, 0.0, 2.0] for i in range(count)]


def told(position, new, *, config=None, world=WORLD, **more) -> TensorDict:
    """A moment as an episode's first, rewritten by consensus."""
    now = moment(position, new, **more)
    return communication(now, config, world)._reset(now, now)


def follows(position, new, **more) -> list[int]:
    return told(position, new, **more)[keys.FOLLOWS][0].tolist()


@pytest.mark.parametrize("mirrored", [False, True])
def test_seekers_follow_the_discoverer_of_higher_rank(mirrored):
    # 1 hears both 0 and 2; 2 sees more fire from the same altitude.
    position, new = in_a_row(3), [2, 0, 3]
    if mirrored:
        new.reverse()
    assert follows(position, new) == [0, 0 if mirrored else 2, 2]


@pytest.mark.parametrize("end", [0, 6])
def test_a_rank_travels_along_a_chain_of_any_length(end):
    new = [0] * 7
    new[end] = 1
    assert follows(in_a_row(7), new) == [end] * 7


def test_the_better_discoverer_wins_the_whole_chain():
    assert follows(in_a_row(8), [1, 0, 0, 0, 0, 0, 0, 5]) == [0, *[7] * 7]


def test_nothing_crosses_a_cut():
    left, right = in_a_row(3), [[x + 40, y, z] for x, y, z in in_a_row(3)]
    assert follows(left + right, [4, 0, 0, 0, 0, 0]) == [0, 0, 0, -1, -1, -1]
    assert follows(left + right, [4, 0, 0, 0, 0, 9]) == [0, 0, 0, 5, 5, 5]


def test_a_discoverer_does_not_join_two_networks_of_others():
    # 0 - 1 - [2] - 3 - [4]: 3 hears the better 4; 1 hears only 2, and 0 only 1.
    assert follows(in_a_row(5), [0, 0, 1, 0, 5]) == [2, 2, 2, 4, 4]


def test_without_a_discoverer_all_wander():
    now = moment(in_a_row(5), [0] * 5)
    talk = communication(now)
    rewritten = talk._reset(now, now)
    assert rewritten[keys.FOLLOWS].tolist() == [[-1] * 5]
    assert rewritten[keys.TARGET].equal(talk.module.waypoint)


def test_everyone_may_discover():
    assert follows(in_a_row(4), [1, 2, 3, 4]) == [0, 1, 2, 3]


def test_ties_go_to_the_lower_index():
    assert follows(in_a_row(3), [2, 0, 2]) == [0, 0, 2]
    # Through a chain too, and whichever of the two is nearer.
    assert follows(in_a_row(6), [0, 2, 0, 0, 0, 2]) == [1, 1, 1, 1, 1, 5]


@pytest.mark.parametrize(("limit", "near"), [(10.0, False), (10.001, True), (math.inf, True)])
def test_hearing_ends_below_the_range(limit, near):
    position = torch.tensor([[0.0, 0.0, 1.0], [6.0, 8.0, 1.0]])
    assert neighbours(position, limit).tolist() == [[False, near], [near, False]]


def test_distance_is_taken_in_three_dimensions():
    position = torch.tensor([[0.0, 0.0, 1.0], [8.0, 5.0, 4.0]])  # 9.43 on the ground, 9.90 in all
    assert neighbours(position, 9.5).sum() == 0
    assert neighbours(position, 9.95).sum() == 2


def test_no_range_is_silence_and_infinite_range_is_one_network():
    position, new = in_a_row(4, gap=20), [0, 3, 0, 0]
    assert follows(position, new) == [-1, 1, -1, -1]
    assert follows(position, new, config=ConsensusConfig(range=math.inf)) == [1, 1, 1, 1]
    same = [[5.0, 5.0, 2.0]] * 3
    assert follows(same, [0, 3, 0], config=ConsensusConfig(range=0.0)) == [-1, 1, -1]


def test_the_choice_reads_the_ranks_of_discoverers_only():
    everyone = ~torch.eye(3, dtype=torch.bool)
    discovers = torch.tensor([False, True, False])
    rank = torch.tensor([math.inf, -1.0, 99.0])
    known = known_discoverers(everyone, discovers)
    assert choose_leader(known, -rank.unsqueeze(-2), discovers).tolist() == [1, 1, 1]


def test_without_agreement_only_neighbours_are_known():
    # 0 - [1] - 2 - 3 - 4 - [5]: 3 hears neither of the two.
    alone = ConsensusConfig(agree=False)
    assert follows(in_a_row(6), [0, 1, 0, 0, 0, 9], config=alone) == [1, 1, 1, -1, 5, 5]
    assert follows(in_a_row(6), [0, 1, 0, 0, 0, 9]) == [1, 1, 5, 5, 5, 5]


def test_the_nearest_discoverer_in_place_of_the_best():
    nearest = ConsensusConfig(follow="nearest")
    # 2 to 4 learn of both from each other; 5 has found more, and 3 is as near to 1: lower index.
    assert follows(in_a_row(6), [0, 1, 0, 0, 0, 9], config=nearest) == [1, 1, 1, 1, 5, 5]


def test_without_wandering_there_is_no_target_and_no_bonus():
    still = ConsensusConfig(
        wander=False, target="relative", heading=HeadingConfig(form="approach", weight=2.0)
    )
    start = [[5.0, 5.0, 2.0], [30.0, 30.0, 2.0], [33.0, 34.0, 2.0]]
    moved = [[5.0, 6.0, 2.0], [30.0, 30.0, 2.0], [33.0, 33.0, 2.0]]
    first = moment(start, [0, 4, 0], centre=[[0.0, 0.0], [30.0, 30.0], [0.0, 0.0]])
    talk = communication(first, still)
    first = talk._reset(first, first)
    assert first[keys.FOLLOWS].tolist() == [[-1, 1, 1]]
    assert first[keys.TARGET][0, 0].tolist() == start[0]
    assert first[keys.OBSERVATION][0, 0, -3:].tolist() == [0.0, 0.0, 0.0]
    second = talk._step(first, moment(moved, [0, 0, 0], step=1))
    # The first has no target; the third came from 5 to sqrt(18) of the second.
    expected = torch.tensor([0.0, 0.0, 2 * (5 - 18**0.5)])
    torch.testing.assert_close(second[keys.REWARD].flatten(), expected)


@pytest.mark.parametrize("loss", [0.0, 0.2, 0.5, 1.0])
def test_messages_are_lost_as_often_as_they_are_said_to_be(loss):
    envs, uavs = 500, 6
    radio = Radio(RadioConfig(loss=loss, range=math.inf))
    position = torch.rand(envs, uavs, 3) * 20 + 1
    heard = torch.stack(
        [
            radio.links(moment(position, torch.zeros(envs, uavs).long(), step=step))
            for step in range(3)
        ]
    )
    assert not heard.diagonal(dim1=-2, dim2=-1).any()
    off = ~torch.eye(uavs, dtype=torch.bool)
    share = heard[..., off].float().mean().item()
    assert share == pytest.approx(1 - loss, abs=0.01)  # 45,000 links, 4 standard deviations
    if 0 < loss < 1:
        both = (heard & heard.mT)[..., off].float().mean().item()
        assert both == pytest.approx((1 - loss) ** 2, abs=0.015)  # each way for itself
        assert not heard[0].equal(heard[1])


def walk(*moments: TensorDict) -> tuple[Consensus, TensorDict]:
    """The module and the last of an episode's moments, each rewritten as on an environment."""
    talk = communication(moments[0])
    now = talk._reset(moments[0], moments[0])
    for following in moments[1:]:
        now = talk._step(now, following)
    return talk.module, now


def test_streak_score_and_altitude_add_up_and_start_anew():
    def at(z: float, new: int) -> TensorDict:
        return moment([[5.0, 5.0, z]], [new])

    def record(*moments: TensorDict) -> tuple[float, ...]:
        module, _ = walk(*(now.clone() for now in moments))
        return module.streak.item(), module.fire_score.item(), module.altitude_sum.item()

    first, second, third = at(1.5, 3), at(2.0, 4), at(4.0, 1)
    assert record(at(3.0, 0)) == (0, 0, 0)
    assert record(at(3.0, 0), first) == (1, 3, 1.5)
    assert record(at(3.0, 0), first, second) == (2, 7, 3.5)
    assert record(at(3.0, 0), first, second, third) == (3, 8, 7.5)
    assert record(at(3.0, 0), first, second, at(4.0, 0)) == (0, 0, 0)
    assert record(first, second, at(4.0, 0), third) == (1, 1, 4.0)


def test_rank_by_hand():
    # UAV 0: 6 then 2 points at altitudes 1 and 3: 8 / (2 * 2) * 2 / 3 = 1.3333
    # UAV 2: 0 then 4 points at altitude 3.5: 4 / (3.5 * 1) * 4 / 3.5 = 1.3061
    # The latest step alone would put 2 first: 2 / 3 < 4 / 3.5.
    before = [[0.0, 0.0, 1.0], [9.0, 0.0, 2.0], [18.0, 0.0, 3.5]]
    after = [[0.0, 0.0, 3.0], [9.0, 0.0, 2.0], [18.0, 0.0, 3.5]]
    _, now = walk(moment(before, [6, 0, 0]), moment(after, [2, 0, 4]))
    assert now[keys.FOLLOWS].tolist() == [[0, 0, 2]]
    now = moment(after, [2, 0, 4])
    rank = communication(now).module._update_track_record(now, torch.tensor([True] * 3))
    torch.testing.assert_close(rank[0, [0, 2]], torch.tensor([4 / 9, 16 / 3.5**2]).double())


def test_targets_by_role():
    position = [[3.0, 4.0, 2.5], [8.0, 4.0, 1.5], [40.0, 40.0, 3.0]]
    now = moment(position, [2, 0, 0], centre=[[3.25, 4.5], [0, 0], [0, 0]])
    talk = communication(now)
    rewritten = talk._reset(now, now)
    target = rewritten[keys.TARGET][0]
    assert target[0].tolist() == [3.25, 4.5, 2.5]  # the mean of the new fire, at its own z
    assert target[1].tolist() == position[0]  # where the discoverer is, not where it goes
    assert target[2].equal(talk.module.waypoint[0, 2])
    observed = rewritten[keys.OBSERVATION]
    assert observed.shape == (1, 3, 9)
    assert observed[..., 6:].equal(rewritten[keys.TARGET])


def test_relative_targets_are_the_way_there():
    config = ConsensusConfig(target="relative")
    position = [[3.0, 4.0, 2.5], [8.0, 4.0, 1.5]]
    centre = [[3.25, 4.5], [0.0, 0.0]]
    raw = told(position, [2, 0], centre=centre, config=config)
    assert raw[keys.OBSERVATION][0, :, 6:].tolist() == [[0.25, 0.5, 0], [-5, 0, 1]]
    world = WildfireConfig(grid=(21, 11), observation_scale="box")
    scaled = told(position, [2, 0], centre=centre, config=config, world=world)
    expected = torch.tensor([[0.25 / 10, 0.5 / 5, 0], [-5 / 10, 0, 1 / 1.5]])
    torch.testing.assert_close(scaled[keys.OBSERVATION][0, :, 6:], expected)
    assert scaled[keys.TARGET].equal(raw[keys.TARGET])


@pytest.mark.parametrize("target", ["absolute", "relative"])
def test_a_box_without_height_leaves_no_nan(target):
    world = WildfireConfig(grid=(21, 11), altitude=(2.0, 2.0), observation_scale="box")
    config = ConsensusConfig(target=target)
    rewritten = told([[3.0, 4.0, 2.0], [8.0, 4.0, 2.0]], [2, 0], config=config, world=world)
    assert rewritten[keys.OBSERVATION].isfinite().all()


def test_a_waypoint_is_redrawn_only_by_a_wanderer_closer_than_one():
    # 0 and 1 wander, 2 discovers, 3 seeks it; all but 1 are at their waypoint.
    position = [[5.0, 5.0, 2.0], [30.0, 5.0, 2.0], [50.0, 50.0, 2.0], [55.0, 50.0, 2.0]]
    waypoint = torch.tensor(
        [[[5.0, 5.9, 2.0], [30.0, 6.0, 2.0], [50.0, 50.5, 2.0], [55.0, 50.0, 2.5]]]
    )
    now = moment(position, [0, 0, 1, 0], step=3)
    talk = communication(now)
    talk.module.waypoint.copy_(waypoint)
    now = talk._step(now, now)
    assert now[keys.FOLLOWS].tolist() == [[-1, -1, 2, 2]]
    kept = (talk.module.waypoint == waypoint).all(-1)
    assert kept.tolist() == [[False, True, True, True]]
    assert now[keys.TARGET][0, :2].equal(talk.module.waypoint[0, :2])


def test_a_first_waypoint_closer_than_one_is_drawn_again():
    # At each UAV's first waypoint, as the module draws it for an episode of this random stream.
    first = moment([[32.0, 32.0, 2.0]] * 6, [0] * 6)
    module = communication(first).module
    module.reset(first, torch.tensor([True]))
    points = module.waypoint.clone()
    now = moment(points[0], [0] * 6)
    target = communication(now)._reset(now, now)[keys.TARGET]
    assert (torch.linalg.vector_norm(target - points, dim=-1) >= 1).all()


def test_waypoints_are_uniform_in_the_box_and_differ():
    here = torch.full((500, 4, 3), 2.0)

    def drawn(step: int) -> Tensor:
        now = moment(here, [0] * 4, step=step)
        module = communication(now).module
        module.reset(now, torch.ones(500, dtype=torch.bool))
        return module.waypoint

    points = drawn(0)
    low, high = torch.tensor(WORLD.low), torch.tensor(WORLD.high)
    assert (points >= low).all()
    assert (points <= high).all()
    unit = ((points - low) / (high - low)).flatten(0, 1)
    torch.testing.assert_close(unit.mean(0), torch.full((3,), 0.5), atol=0.03, rtol=0)
    torch.testing.assert_close(unit.std(0), torch.full((3,), 12**-0.5), atol=0.02, rtol=0)
    assert len(unit.unique(dim=0)) == len(unit)
    assert not (drawn(1) == points).all(-1).any()


RELEASED = ConsensusConfig(discoverer="any_fire", jitter=0.75)


def test_any_fire_makes_a_discoverer_in_released():
    position = in_a_row(2)
    assert follows(position, [0, 0], old=[5, 0]) == [-1, -1]
    assert follows(position, [0, 0], old=[5, 0], config=RELEASED) == [0, 0]
    calm = ConsensusConfig(discoverer="any_fire")
    where = {"centre": [[3.0, 1.0], [0.0, 0.0]], "old_centre": [[7.0, 2.0], [0.0, 0.0]]}
    old_only = told(position, [0, 0], old=[5, 0], config=calm, **where)
    assert old_only[keys.TARGET][0, 0].tolist() == [7.0, 2.0, 2.0]
    both = told(position, [1, 0], old=[5, 0], config=calm, **where)
    assert both[keys.TARGET][0, 0].tolist() == [3.0, 1.0, 2.0]


def test_jitter_moves_x_and_y_of_near_targets_only():
    # 0 discovers 0.5 cells away, 1 discovers 1 cell away, 2 seeks 0 from 3 cells away.
    position = torch.tensor([[20.0, 20.0, 2.0], [40.0, 40.0, 3.0], [20.0, 23.0, 2.0]])
    more = {
        "position": position.expand(4000, 3, 3),
        "new": [9, 9, 0],
        "centre": [[20.0, 20.5], [41.0, 40.0], [0.0, 0.0]],
    }
    calm = told(**more)[keys.TARGET]
    noise = told(config=ConsensusConfig(jitter=0.75), **more)[keys.TARGET] - calm
    assert noise[:, 1:].abs().max() == 0
    assert noise[..., 2].abs().max() == 0
    near = noise[:, 0, :2]
    # 0.396 is the variance of N(0, 0.75) clipped to +-1, 0.182 the share of it that is clipped.
    assert near.abs().max() <= 1 + 1e-5
    assert near.mean().abs() < 0.03
    assert near.var().item() == pytest.approx(0.396, abs=0.02)
    assert (near.abs() > 1 - 1e-5).float().mean().item() == pytest.approx(0.182, abs=0.02)
    assert abs(torch.corrcoef(near.T)[0, 1]) < 0.05
    later = told(config=ConsensusConfig(jitter=0.75), step=1, **more)[keys.TARGET] - calm
    assert abs(torch.corrcoef(torch.stack((near[:, 0], later[:, 0, 0])))[0, 1]) < 0.05


def test_the_result_does_not_depend_on_the_order_of_uavs():
    generator = torch.Generator().manual_seed(0)
    position = torch.rand(200, 9, 3, generator=generator) * torch.tensor([45.0, 45.0, 3.0])
    position[..., 2] += 1
    new = torch.randint(0, 30, (200, 9), generator=generator) * (
        torch.rand(200, 9, generator=generator) < 0.3
    )
    order = torch.randperm(9, generator=generator)
    centre = position[..., :2] + 0.5
    waypoint = torch.full((200, 9, 3), 60.0)  # far from everyone: nobody draws another

    def run(order: Tensor) -> tuple[dict[str, Tensor], TensorDict]:
        now = moment(position[:, order], new[:, order], centre=centre[:, order], step=1)
        talk = communication(now)
        talk.module.waypoint.copy_(waypoint)
        return dict(talk.module.named_buffers()), talk._step(now, now)

    (state, plain), (permuted_state, permuted) = run(torch.arange(9)), run(order)
    for key in (keys.TARGET, keys.OBSERVATION):
        assert permuted[key].equal(plain[key][:, order]), key
    for name in ("streak", "fire_score", "altitude_sum"):
        assert permuted_state[name].equal(state[name][:, order]), name
    chosen = permuted[keys.FOLLOWS]
    named = torch.where(chosen < 0, -1, order[chosen.clamp(min=0)])
    assert named.equal(plain[keys.FOLLOWS][:, order])
    roles = plain[keys.FOLLOWS]
    assert (roles < 0).any()
    assert ((roles >= 0) & (roles != torch.arange(9))).any()
