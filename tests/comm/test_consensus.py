"""Tests consensus on small networks with known results."""

import dataclasses
import math

import pytest
import torch
from tensordict import TensorDict
from time_steps import WORLD, communication, time_step
from torch import Tensor

from emberlink.comm.consensus import (
    Consensus,
    ConsensusConfig,
    HeadingConfig,
    choose_leader,
    known_discoverers,
)
from emberlink.envs import keys
from emberlink.envs.config import RadioConfig, WildfireConfig
from emberlink.envs.world import radio
from emberlink.envs.world.radio import neighbours


def in_a_row(count: int, gap: float = 9.0) -> list[list[float]]:
    return [[gap * i, 0.0, 2.0] for i in range(count)]


def within(limit: float) -> WildfireConfig:
    """Returns a world with radios of a given range."""
    return dataclasses.replace(WORLD, radio=RadioConfig(range=limit))


def after_consensus(position, new, *, config=None, world=WORLD, **more) -> TensorDict:
    """Returns the first time step of an episode after consensus."""
    now = time_step(position, new, **more)
    return communication(now, config, world)._reset(now, now)


def follows(position, new, **more) -> list[int]:
    return after_consensus(position, new, **more)[keys.FOLLOWS][0].tolist()


@pytest.mark.parametrize("mirrored", [False, True])
def test_seekers_follow_the_discoverer_of_higher_rank(mirrored):
    # 1 hears both 0 and 2; 2 sees more fire from the same altitude.
    position, new = in_a_row(3), [2, 0, 3]
    if mirrored:
        new.reverse()
    assert follows(position, new) == [0, 0 if mirrored else 2, 2]


@pytest.mark.parametrize("end", [0, 6])
def test_a_rank_is_forwarded_along_a_chain_of_any_length(end):
    new = [0] * 7
    new[end] = 1
    assert follows(in_a_row(7), new) == [end] * 7


def test_the_whole_chain_follows_the_discoverer_of_higher_rank():
    assert follows(in_a_row(8), [1, 0, 0, 0, 0, 0, 0, 5]) == [0, *[7] * 7]


def test_separate_networks_do_not_exchange_messages():
    left, right = in_a_row(3), [[x + 40, y, z] for x, y, z in in_a_row(3)]
    assert follows(left + right, [4, 0, 0, 0, 0, 0]) == [0, 0, 0, -1, -1, -1]
    assert follows(left + right, [4, 0, 0, 0, 0, 9]) == [0, 0, 0, 5, 5, 5]


def test_a_discoverer_does_not_forward_messages_between_networks():
    # 0 - 1 - [2] - 3 - [4]: 3 hears the better 4; 1 hears only 2, and 0 only 1.
    assert follows(in_a_row(5), [0, 0, 1, 0, 5]) == [2, 2, 2, 4, 4]


def test_all_uavs_wander_without_a_discoverer():
    now = time_step(in_a_row(5), [0] * 5)
    talk = communication(now)
    rewritten = talk._reset(now, now)
    assert rewritten[keys.FOLLOWS].tolist() == [[-1] * 5]
    assert rewritten[keys.TARGET].equal(talk.module.waypoint)


def test_all_uavs_may_be_discoverers():
    assert follows(in_a_row(4), [1, 2, 3, 4]) == [0, 1, 2, 3]


def test_ties_go_to_the_lower_index():
    assert follows(in_a_row(3), [2, 0, 2]) == [0, 0, 2]
    # The same holds through a chain, and independent of the distances.
    assert follows(in_a_row(6), [0, 2, 0, 0, 0, 2]) == [1, 1, 1, 1, 1, 5]


@pytest.mark.parametrize(("limit", "near"), [(10.0, False), (10.001, True), (math.inf, True)])
def test_the_range_is_exclusive(limit, near):
    position = torch.tensor([[0.0, 0.0, 1.0], [6.0, 8.0, 1.0]])
    assert neighbours(position, limit).tolist() == [[False, near], [near, False]]


def test_distance_is_taken_in_three_dimensions():
    position = torch.tensor([[0.0, 0.0, 1.0], [8.0, 5.0, 4.0]])  # 9.43 on the ground, 9.90 in all
    assert neighbours(position, 9.5).sum() == 0
    assert neighbours(position, 9.95).sum() == 2


def test_range_zero_and_infinite_range():
    position, new = in_a_row(4, gap=20), [0, 3, 0, 0]
    assert follows(position, new) == [-1, 1, -1, -1]
    assert follows(position, new, world=within(math.inf)) == [1, 1, 1, 1]
    same = [[5.0, 5.0, 2.0]] * 3
    assert follows(same, [0, 3, 0], world=within(0.0)) == [-1, 1, -1]


def test_only_ranks_of_discoverers_are_compared():
    all_links = ~torch.eye(3, dtype=torch.bool)
    discovers = torch.tensor([False, True, False])
    rank = torch.tensor([math.inf, -1.0, 99.0])
    known = known_discoverers(all_links, discovers)
    assert choose_leader(known, -rank.unsqueeze(-2), discovers).tolist() == [1, 1, 1]


def test_without_agreement_only_neighbours_are_heard():
    # 0 - [1] - 2 - 3 - 4 - [5]: 3 hears neither discoverer.
    alone = ConsensusConfig(agree=False)
    assert follows(in_a_row(6), [0, 1, 0, 0, 0, 9], config=alone) == [1, 1, 1, -1, 5, 5]
    assert follows(in_a_row(6), [0, 1, 0, 0, 0, 9]) == [1, 1, 5, 5, 5, 5]


def test_the_nearest_discoverer_instead_of_the_best():
    nearest = ConsensusConfig(follow="nearest")
    # 2 to 4 receive both ranks. 5 has the higher rank. 3 is equally near to 1 and 5: lower index.
    assert follows(in_a_row(6), [0, 1, 0, 0, 0, 9], config=nearest) == [1, 1, 1, 1, 5, 5]


def test_without_wandering_there_is_no_target_and_no_bonus():
    still = ConsensusConfig(
        wander=False, target="relative", heading=HeadingConfig(form="approach", weight=2.0)
    )
    start = [[5.0, 5.0, 2.0], [30.0, 30.0, 2.0], [33.0, 34.0, 2.0]]
    moved = [[5.0, 6.0, 2.0], [30.0, 30.0, 2.0], [33.0, 33.0, 2.0]]
    first = time_step(start, [0, 4, 0], centre=[[0.0, 0.0], [30.0, 30.0], [0.0, 0.0]])
    talk = communication(first, still)
    first = talk._reset(first, first)
    assert first[keys.FOLLOWS].tolist() == [[-1, 1, 1]]
    assert first[keys.TARGET][0, 0].tolist() == start[0]
    assert first[keys.OBSERVATION][0, 0, -3:].tolist() == [0.0, 0.0, 0.0]
    second = talk._step(first, time_step(moved, [0, 0, 0], step=1))
    # UAV 0 has no target. UAV 2 moved from a distance of 5 to one of sqrt(18) to UAV 1.
    expected = torch.tensor([0.0, 0.0, 2 * (5 - 18**0.5)])
    torch.testing.assert_close(second[keys.REWARD].flatten(), expected)


@pytest.mark.parametrize("loss", [0.0, 0.2, 0.5, 1.0])
def test_the_share_of_lost_messages(loss):
    envs, uavs = 500, 6
    config = RadioConfig(loss=loss, range=math.inf)
    position = torch.rand(envs, uavs, 3) * 20 + 1
    key = torch.arange(envs)
    heard = torch.stack(
        [radio.links(config, position, key, torch.full((envs,), step)) for step in range(3)]
    )
    assert not heard.diagonal(dim1=-2, dim2=-1).any()
    off = ~torch.eye(uavs, dtype=torch.bool)
    share = heard[..., off].float().mean().item()
    assert share == pytest.approx(1 - loss, abs=0.01)  # 45,000 links, 4 standard deviations
    if 0 < loss < 1:
        both = (heard & heard.mT)[..., off].float().mean().item()
        assert both == pytest.approx((1 - loss) ** 2, abs=0.015)  # independent in both directions
        assert not heard[0].equal(heard[1])


def walk(*steps: TensorDict) -> tuple[Consensus, TensorDict]:
    """Returns the module and the last time step after consensus on all steps of an episode."""
    talk = communication(steps[0])
    now = talk._reset(steps[0], steps[0])
    for following in steps[1:]:
        now = talk._step(now, following)
    return talk.module, now


def test_streak_score_and_altitude_accumulate_and_reset():
    def at(z: float, new: int) -> TensorDict:
        return time_step([[5.0, 5.0, z]], [new])

    def record(*steps: TensorDict) -> tuple[float, ...]:
        module, _ = walk(*(now.clone() for now in steps))
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
    # By the latest step alone 2 would rank first: 2 / 3 < 4 / 3.5.
    before = [[0.0, 0.0, 1.0], [9.0, 0.0, 2.0], [18.0, 0.0, 3.5]]
    after = [[0.0, 0.0, 3.0], [9.0, 0.0, 2.0], [18.0, 0.0, 3.5]]
    _, now = walk(time_step(before, [6, 0, 0]), time_step(after, [2, 0, 4]))
    assert now[keys.FOLLOWS].tolist() == [[0, 0, 2]]
    now = time_step(after, [2, 0, 4])
    rank = communication(now).module._update_track_record(now, torch.tensor([True] * 3))
    torch.testing.assert_close(rank[0, [0, 2]], torch.tensor([4 / 9, 16 / 3.5**2]).double())


def test_targets_by_role():
    position = [[3.0, 4.0, 2.5], [8.0, 4.0, 1.5], [40.0, 40.0, 3.0]]
    now = time_step(position, [2, 0, 0], centre=[[3.25, 4.5], [0, 0], [0, 0]])
    talk = communication(now)
    rewritten = talk._reset(now, now)
    target = rewritten[keys.TARGET][0]
    assert target[0].tolist() == [3.25, 4.5, 2.5]  # the centre of the new fire, at the UAV's own z
    assert target[1].tolist() == position[0]  # the discoverer's position, not its target
    assert target[2].equal(talk.module.waypoint[0, 2])
    observed = rewritten[keys.OBSERVATION]
    assert observed.shape == (1, 3, 9)
    assert observed[..., 6:].equal(rewritten[keys.TARGET])


def test_relative_targets_are_displacements():
    config = ConsensusConfig(target="relative")
    position = [[3.0, 4.0, 2.5], [8.0, 4.0, 1.5]]
    centre = [[3.25, 4.5], [0.0, 0.0]]
    raw = after_consensus(position, [2, 0], centre=centre, config=config)
    assert raw[keys.OBSERVATION][0, :, 6:].tolist() == [[0.25, 0.5, 0], [-5, 0, 1]]
    world = WildfireConfig(grid=(21, 11), observation_scale="box")
    scaled = after_consensus(position, [2, 0], centre=centre, config=config, world=world)
    expected = torch.tensor([[0.25 / 10, 0.5 / 5, 0], [-5 / 10, 0, 1 / 1.5]])
    torch.testing.assert_close(scaled[keys.OBSERVATION][0, :, 6:], expected)
    assert scaled[keys.TARGET].equal(raw[keys.TARGET])


@pytest.mark.parametrize("target", ["absolute", "relative"])
def test_a_box_without_height_gives_no_nan(target):
    world = WildfireConfig(grid=(21, 11), altitude=(2.0, 2.0), observation_scale="box")
    config = ConsensusConfig(target=target)
    rewritten = after_consensus(
        [[3.0, 4.0, 2.0], [8.0, 4.0, 2.0]], [2, 0], config=config, world=world
    )
    assert rewritten[keys.OBSERVATION].isfinite().all()


def test_a_waypoint_is_redrawn_only_by_a_wanderer_closer_than_one():
    # 0 and 1 wander, 2 is a discoverer, 3 follows it. All but 1 are at their waypoint.
    position = [[5.0, 5.0, 2.0], [30.0, 5.0, 2.0], [50.0, 50.0, 2.0], [55.0, 50.0, 2.0]]
    waypoint = torch.tensor(
        [[[5.0, 5.9, 2.0], [30.0, 6.0, 2.0], [50.0, 50.5, 2.0], [55.0, 50.0, 2.5]]]
    )
    now = time_step(position, [0, 0, 1, 0], step=3)
    talk = communication(now)
    talk.module.waypoint.copy_(waypoint)
    now = talk._step(now, now)
    assert now[keys.FOLLOWS].tolist() == [[-1, -1, 2, 2]]
    kept = (talk.module.waypoint == waypoint).all(-1)
    assert kept.tolist() == [[False, True, True, True]]
    assert now[keys.TARGET][0, :2].equal(talk.module.waypoint[0, :2])


@pytest.mark.parametrize(("step", "redrawn"), [(1, False), (49, False), (50, True), (100, True)])
def test_waypoints_that_are_not_reached_are_drawn_again_in_time(step, redrawn):
    # 0 and 1 wander far from their waypoints, 2 is a discoverer.
    position = [[5.0, 5.0, 2.0], [30.0, 5.0, 2.0], [50.0, 50.0, 2.0]]
    waypoint = torch.tensor([[[5.0, 40.0, 2.0], [30.0, 40.0, 2.0], [50.0, 5.0, 2.0]]])
    now = time_step(position, [0, 0, 1], step=step)
    talk = communication(now, ConsensusConfig(redraw=50))
    talk.module.waypoint.copy_(waypoint)
    now = talk._step(now, now)
    changed = (talk.module.waypoint != waypoint).any(-1)
    assert changed.tolist() == [[redrawn, redrawn, False]]
    assert now[keys.TARGET][0, :2].equal(talk.module.waypoint[0, :2])


def test_a_first_waypoint_closer_than_one_is_drawn_again():
    # Each UAV starts at its first waypoint, drawn as the module draws it from this key.
    first = time_step([[32.0, 32.0, 2.0]] * 6, [0] * 6)
    module = communication(first).module
    module.reset(first, torch.tensor([True]))
    points = module.waypoint.clone()
    now = time_step(points[0], [0] * 6)
    target = communication(now)._reset(now, now)[keys.TARGET]
    assert (torch.linalg.vector_norm(target - points, dim=-1) >= 1).all()


def test_waypoints_are_uniform_in_the_box_and_differ():
    here = torch.full((500, 4, 3), 2.0)

    def drawn(step: int) -> Tensor:
        now = time_step(here, [0] * 4, step=step)
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
    old_only = after_consensus(position, [0, 0], old=[5, 0], config=calm, **where)
    assert old_only[keys.TARGET][0, 0].tolist() == [7.0, 2.0, 2.0]
    both = after_consensus(position, [1, 0], old=[5, 0], config=calm, **where)
    assert both[keys.TARGET][0, 0].tolist() == [3.0, 1.0, 2.0]


def test_jitter_changes_x_and_y_of_near_targets_only():
    # 0 sees fire 0.5 cells away, 1 sees fire 1 cell away, 2 follows 0 from 3 cells away.
    position = torch.tensor([[20.0, 20.0, 2.0], [40.0, 40.0, 3.0], [20.0, 23.0, 2.0]])
    more = {
        "position": position.expand(4000, 3, 3),
        "new": [9, 9, 0],
        "centre": [[20.0, 20.5], [41.0, 40.0], [0.0, 0.0]],
    }
    calm = after_consensus(**more)[keys.TARGET]
    noise = after_consensus(config=ConsensusConfig(jitter=0.75), **more)[keys.TARGET] - calm
    assert noise[:, 1:].abs().max() == 0
    assert noise[..., 2].abs().max() == 0
    near = noise[:, 0, :2]
    # N(0, 0.75) clipped to +-1 has the variance 0.396; a share of 0.182 is clipped.
    assert near.abs().max() <= 1 + 1e-5
    assert near.mean().abs() < 0.03
    assert near.var().item() == pytest.approx(0.396, abs=0.02)
    assert (near.abs() > 1 - 1e-5).float().mean().item() == pytest.approx(0.182, abs=0.02)
    assert abs(torch.corrcoef(near.T)[0, 1]) < 0.05
    later = after_consensus(config=ConsensusConfig(jitter=0.75), step=1, **more)[keys.TARGET] - calm
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
    waypoint = torch.full((200, 9, 3), 60.0)  # far from all UAVs: no UAV draws another one

    def run(order: Tensor) -> tuple[dict[str, Tensor], TensorDict]:
        now = time_step(position[:, order], new[:, order], centre=centre[:, order], step=1)
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


@pytest.mark.parametrize(
    ("more", "limit", "sent"),
    [
        ({}, 10.0, [16, 16, 32, 0, 32, 16]),
        ({"agree": False}, 10.0, [0, 16, 0, 0, 0, 16]),
        ({}, 0.0, [0] * 6),
    ],
)
def test_bytes_by_hand(more, limit, sent):
    """UAVs 1 and 5 discover. UAV 3 has failed, so 2 and 4 pass on what both sides say."""
    world = dataclasses.replace(WORLD, measures="all", radio=RadioConfig(range=limit))
    now = time_step(in_a_row(6), [0, 1, 0, 0, 0, 9])
    now[keys.ALIVE] = torch.tensor([[True, True, True, False, True, True]])
    after = communication(now, ConsensusConfig(**more), world)._reset(now, now)
    assert after[keys.BYTES_SENT][0].tolist() == sent


def test_absolute_targets_are_scaled_to_the_box():
    world = WildfireConfig(grid=(21, 11), observation_scale="box")
    where = [[3.0, 4.0, 2.5], [8.0, 4.0, 1.5]]
    seen = after_consensus(where, [2, 0], centre=[[3.25, 4.5], [0.0, 0.0]], world=world)
    expected = torch.tensor([[-0.675, -0.1, 0.0], [-0.7, -0.2, 0.0]])
    torch.testing.assert_close(seen[keys.OBSERVATION][0, :, 6:], expected)


def test_targets_with_noise_stay_in_the_box():
    near = torch.tensor([[0.2, 0.2, 2.0]]).expand(500, 1, 3)
    about = {"position": near, "new": [9], "centre": [[0.3, 0.3]]}
    target = after_consensus(config=ConsensusConfig(jitter=0.75), **about)[keys.TARGET]
    assert target.min() == 0
