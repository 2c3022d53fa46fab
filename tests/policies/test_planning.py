"""Tests how scripted policies come to a meeting place in time, and the oracle's foresight."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torchrl.envs import step_mdp

from emberlink.envs import WildfireConfig, WildfireEnv, keys
from emberlink.envs.config import RadioConfig
from emberlink.envs.world import radio
from emberlink.policies.scripted.map_greedy import Courier, MapGreedy, Shuttle, ShuttleAll
from emberlink.policies.scripted.oracle import Oracle, OracleShuttle

NEVER = math.inf
BASE = torch.tensor([0.0, 30.0])


def played(env, policy, steps: int, position):
    """Returns the last time step of an episode."""
    return flown(env, policy, steps, env.reset(position=torch.tensor(position)))


def flown(env, policy, steps: int, td):
    for _ in range(steps):
        td = step_mdp(env.step(policy(td)), keep_other=True)
    return td


# Rules


def test_a_chain_by_hand():
    config = WildfireConfig(grid=(60, 60), num_uavs=6)
    centre = torch.tensor([40.0, 30.0]).expand(1, 6, 2)
    rank = torch.arange(6).unsqueeze(0)
    place, reach = radio.chain(config, BASE, centre, rank, torch.tensor(6))
    # 0.97 sqrt(10^2 - 4^2) = 8.89 cells to the base on the ground, then 9.7 each. Four reach 38.
    first = 0.97 * math.sqrt(84)
    along = [first, first + 9.7, first + 19.4, first + 29.1, first + 29.1, first + 29.1]
    assert place[0, :, 0].tolist() == pytest.approx(along)
    assert place[0, :, 1].tolist() == [30] * 6
    at_place = 0.01 * math.sqrt(84)
    assert reach[0].tolist() == pytest.approx([at_place] * 4 + [9.7] * 2)
    points = torch.cat(
        (torch.tensor([[0.0, 30, 0]]), torch.nn.functional.pad(place[0], (0, 1), value=4))
    )
    assert radio.reachable(radio.neighbours(points, 10.0)).all()
    # Two UAVs: one holds a place, the other is in its range. No fire known: within the base's.
    place, reach = radio.chain(config, BASE, centre[:, :2], rank[:, :2], torch.tensor(2))
    assert place[0, :, 0].tolist() == pytest.approx([first] * 2)
    assert reach[0].tolist() == pytest.approx([at_place, 9.7])
    place, reach = radio.chain(config, BASE, BASE.expand(1, 2, 2), rank[:, :2], torch.tensor(2))
    assert place.tolist() == [[[0, 30], [0, 30]]]
    assert reach[0].tolist() == pytest.approx([first] * 2)


@given(st.floats(1.5, 40), st.floats(0.1, 0.99), st.floats(20, 59))
def test_a_chain_holds_if_each_uav_is_within_its_reach(heard, height, along):
    top = height * heard
    world = WildfireConfig(
        grid=(60, 60), num_uavs=6, altitude=(top, top), radio=RadioConfig(range=heard)
    )
    centre = torch.tensor([along, 30.0]).expand(1, 6, 2)
    place, reach = radio.chain(world, BASE, centre, torch.arange(6)[None], torch.tensor(6))
    relays = int((reach[0] < reach[0, -1]).sum())
    along, reach = place[0, : relays + 1, 0].double(), reach[0, : relays + 1].double()
    # The greatest distances from the base on the ground, and between neighbours in the chain; the
    # last one is between a UAV without a place and the UAV at the last place.
    assert math.hypot(along[0] + reach[0], top) < heard
    assert (along.diff() + reach[1:] + reach[:-1] < heard).all()


# Policies


def base_world(**settings) -> WildfireConfig:
    given = {"grid": (40, 40), "num_uavs": 3, "displacement": 1.0, "horizon": 90}
    return WildfireConfig(**given | {"base": (0.0, 20.0)} | settings)


FAR_FIRE = torch.full((40, 40), NEVER)
FAR_FIRE[24:31, 16:25] = 0
NEAR_IT = [[26.0, 20, 4], [25.0, 22, 4], [28.0, 18, 4]]


@pytest.mark.parametrize("kind", [Courier, Oracle])
def test_what_was_seen_is_at_the_base_in_the_end(kind):
    env = WildfireEnv(1, base_world(), FAR_FIRE, seed=1)
    policy = kind(env)
    td = played(env, policy, 60, NEAR_IT)
    assert td[keys.BASE_SEEN].item() == 0
    td = flown(env, policy, 30, td)
    assert td[keys.BASE_SEEN].item() == td[keys.SEEN].item() == 63


def test_who_does_not_report_leaves_the_base_without_news():
    env = WildfireEnv(1, base_world(), FAR_FIRE, seed=1)
    assert played(env, MapGreedy(env), 90, NEAR_IT)[keys.BASE_SEEN].item() == 0


@pytest.mark.parametrize(
    ("kind", "seen"), [(Shuttle, 63), (ShuttleAll, 63), (OracleShuttle, 63), (Courier, 0)]
)
def test_shuttles_report_in_the_middle_of_an_episode(kind, seen):
    env = WildfireEnv(1, base_world(horizon=300), FAR_FIRE, seed=1)
    td = played(env, kind(env), 250, NEAR_IT)
    assert td[keys.BASE_SEEN].item() == seen
    assert td[keys.SEEN].item() == 63


def test_the_chain_closes_where_a_uav_has_failed():
    env = WildfireEnv(1, base_world(failures=1.0, horizon=230), FAR_FIRE, seed=1)
    td, courier = env.reset(position=torch.tensor(NEAR_IT)), Courier(env)
    env._fail_step.copy_(torch.tensor([[20, 231, 231]]))  # UAV 0 would be next to the base
    for _ in range(230):
        td = step_mdp(env.step(courier(td)), keep_other=True)
    assert td[keys.ALIVE].tolist() == [[False, True, True]]
    assert td[keys.BASE_SEEN].item() == td[keys.SEEN].item() == 63


def test_the_oracle_flies_to_what_still_burns_when_it_arrives():
    # (6, 20), 12 cells from a place to see it, burns out at step 8; (20, 37), 15 cells away, burns
    # on; (20, 5) ignites too late.
    fire = torch.full((1, 2, 40, 40), NEVER)
    fire[0, :, 6, 20] = torch.tensor([0.0, 8.0])
    fire[0, :, 20, 37] = torch.tensor([0.0, 50.0])
    fire[0, :, 20, 5] = torch.tensor([95.0, 99.0])
    config = base_world(num_uavs=1, base=None)
    env = WildfireEnv(1, config, fire)
    td = Oracle(env)(env.reset(position=torch.tensor([[20.0, 20, 4]])))
    assert td[Oracle.TARGET].tolist()[0][0][1] == 35


def test_the_oracle_saves_what_a_uav_has_seen_before_it_fails():
    fire = torch.full((40, 40), NEVER)
    fire[2:5, 2:5], fire[34:37, 34:37] = 0, 0
    env = WildfireEnv(1, base_world(failures=1.0, num_uavs=2), fire, seed=0)
    td = env.reset(position=torch.tensor([[3.0, 3, 4], [35.0, 35, 4]]))
    env._fail_step.copy_(torch.tensor([[91, 70]]))
    oracle = Oracle(env)
    for _ in range(69):
        td = step_mdp(env.step(oracle(td)), keep_other=True)
    assert td[keys.ALIVE].all()
    assert env.knowledge.seen_fire[0, 0].sum() == 18
