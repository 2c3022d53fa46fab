"""Tests that UAVs with method `maps` observe their belief maps, and nothing else."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from emberlink.comm.base import Communication
from emberlink.comm.maps import Maps, MapsConfig, steer_home
from emberlink.envs import keys
from emberlink.envs.config import MapConfig, RadioConfig, WildfireConfig
from emberlink.envs.wildfire import WildfireEnv

OBSERVED = (keys.OBSERVATION, keys.CROPS)


def environment(fire, position, *, home=True, scales=(1, 2), hold=1, **world) -> TransformedEnv:
    """Returns an environment and resets it with given positions, [envs, n, 3]."""
    envs, uavs, _ = position.shape
    grid = tuple(fire.shape[-2:])
    more = {"grid": grid, "num_uavs": uavs, "horizon": 60, "observation": "map", **world}
    shown = MapConfig(pixels=8, scales=scales)
    world = WildfireConfig(displacement=1.0, measures="all", map=shown, **more)
    env = WildfireEnv(envs, world, fire, seed=3)
    module = Maps(world, MapsConfig(home=home), envs)
    module.hold = hold
    return TransformedEnv(env, Communication(module))


def fly(env, position, actions) -> list:
    """Returns the time steps of a flight, from the reset on."""
    td = env.reset(position=position)
    steps = [td]
    for action in actions:
        td = env.step(TensorDict({keys.ACTION: action}, env.batch_size))["next"]
        steps.append(td)
    return steps


def burning(seed: int = 0, side: int = 30) -> torch.Tensor:
    """Returns a fire that spreads and burns out after 20 steps."""
    place = torch.arange(side).float()
    middle = side / 2 + seed
    arrival = torch.maximum((place[:, None] - middle).abs(), (place - middle).abs()) * 2 - 6
    return torch.stack((arrival, arrival + 20))[None]


def random_flight(steps: int, uavs: int, envs: int = 1, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(steps, envs, uavs, 3, generator=generator) * 2 - 1


def test_uavs_are_home_in_time_whatever_the_policy_does():
    """The fire burns in one cell 20 cells from the base; two radios of 10 cells reach it."""
    fire = torch.full((1, 30, 30), torch.inf)
    fire[0, 20, 15] = 1.0
    position = torch.tensor([[[20.0, 15, 3], [21, 15, 3], [20, 16, 3], [29.0, 15, 3]]])
    hop, first = 9.7, 0.97 * 84**0.5
    away = torch.tensor([1.0, 0.5, -1.0]).expand(60, 1, 4, 3)
    for home, base, heard in (
        *((True, (0.0, 15.0), 10.0), (False, (0.0, 15.0), 10.0)),
        *((True, None, 10.0), (True, (0.0, 15.0), 4.0)),  # no base, or none that hears the ceiling
    ):
        env = environment(fire, position, home=home, base=base, radio=RadioConfig(range=heard))
        end = fly(env, position, away)[-1]
        if home and base and heard == 10:
            x, y, z = end[keys.POSITION][0].unbind(-1)
            assert x[:2].tolist() == pytest.approx([first, first + hop], abs=1e-3)
            assert y[:2].tolist() == pytest.approx([15, 15], abs=1e-3)
            assert (torch.hypot(x[2:] - first - hop, y[2:] - 15) < hop).all()
            assert z.tolist() == pytest.approx([4] * 4, abs=1e-3)
            assert end[keys.BASE_SEEN].item() == end[keys.SEEN].item() == 1
        else:
            assert (end[keys.POSITION][0] == torch.tensor([29.0, 29, 1])).all()
            assert not base or end[keys.BASE_SEEN].item() == 0


def test_a_uav_leaves_at_the_last_moment_by_hand():
    world = WildfireConfig(horizon=100, displacement=0.5, altitude=(1.0, 4.0))
    home = torch.tensor([[[10.0, 10, 2.0]] * 3])
    # 12 cells along x less 2 of reach, and 0.71 for one more step, are 21.4 steps. It has to be
    # there at step 85, so it leaves at step 63. The last UAV is within its reach, in spite of
    # another step.
    position = torch.tensor([[[22.0, 10, 4], [10.0, 22, 2], [10, 11, 4]]])
    action = torch.full((1, 3, 3), 0.25)

    def steered(step: int) -> list:
        performed = steer_home(world, action, home, position, torch.full((1, 3), step))
        assert (performed.abs() < 1).all()
        return [pytest.approx(uav, abs=1e-5) for uav in performed[0].tolist()]

    assert steered(62) == action[0].tolist()
    assert steered(63) == [[-1, 0, 0.25], [0, -1, 0.25], [0.25] * 3]
    # 2 cells below the ceiling, and another one down, are 5 steps: it climbs from step 80 on. At
    # the ceiling a UAV stays there, when it could not come back otherwise.
    assert steered(79) == [[-1, 0, 0.25], [0, -1, 0.25], [0.25] * 3]
    assert steered(80) == [[-1, 0, 0.25], [0, -1, 1], [0.25] * 3]
    assert steered(84) == [[-1, 0, 0], [0, -1, 1], [0.25, 0.25, 0]]
    place = home * torch.tensor([1, 1, 0])  # no reach
    near = torch.tensor([[[10.0, 10.2, 3.9]] * 3])
    performed = steer_home(world, action, place, near, torch.full((1, 3), 99))
    torch.testing.assert_close(performed, torch.tensor([[[0.0, -0.4, 0.2]] * 3]))


def test_the_learner_learns_from_the_action_of_the_policy():
    fire = torch.full((1, 30, 30), torch.inf)
    position = torch.full((1, 2, 3), 20.0).clamp(max=torch.tensor([29.0, 29, 4]))
    env = environment(fire, position, base=(0.0, 15.0), horizon=20)
    td = env.reset(position=position).set(keys.ACTION, torch.ones(1, 2, 3))
    stepped = env.step(td)
    assert (stepped[keys.ACTION] == 1).all()
    assert (stepped["next"][keys.POSITION][..., 0] < 20).all()  # home to the base


def test_what_a_uav_sees_is_what_is_there():
    position = torch.tensor([[[15.0, 15.0, 4.0], [3.0, 4.0, 2.0]]])
    env = environment(burning(), position, failures=1.0)
    steps = fly(env, position, random_flight(59, 2))
    assert not steps[0][keys.SIGHT].any()
    assert steps[0][keys.ALIVE].all()
    assert not steps[-1][keys.ALIVE].all()
    world, scene = env.base_env, []
    for td in steps[1:]:
        now = td[keys.STEP].item()
        arrival, end = world.arrival_time[0], world.burn_out[0]
        shown = 1 + (arrival <= now).long() + (end <= now)
        for uav in range(2):
            x, y, z = td[keys.POSITION][0, uav].double().tolist()
            i, j, reach = round(x), round(y), z * 3**-0.5
            for a in range(-2, 3):
                for b in range(-2, 3):
                    cell = i + a, j + b
                    seen = abs(cell[0] - x) <= reach and abs(cell[1] - y) <= reach
                    inside = all(0 <= place < 30 for place in cell)
                    flies = td[keys.ALIVE][0, uav]
                    expected = shown[cell] if seen and inside and flies else 0
                    assert td[keys.SIGHT][0, uav, a + 2, b + 2] == expected
        scene.append(td[keys.SIGHT])
    assert set(torch.stack(scene).unique().tolist()) == {0, 1, 2, 3}


def test_environments_out_of_phase_have_pictures_of_their_own():
    """Pictures are drawn at decisions, which differ if one environment was reset between them."""
    fire = torch.cat([burning(seed, 20) for seed in range(2)])
    position = torch.tensor([[[8.0, 8, 3], [12, 12, 3]]]).repeat(2, 1, 1)
    actions, flights = random_flight(20, 2, 2), []
    for hold in (1, 5):
        env = environment(fire, position, hold=hold)
        td = fly(env, position, actions[:3])[-1]
        env.reset(td.set("_reset", torch.tensor([[True], [False]])), position=position)
        later = [TensorDict({keys.ACTION: action}, [2]) for action in actions[3:]]
        flights.append([env.step(step)["next"] for step in later])
    for step, (every, held) in enumerate(zip(*flights, strict=True)):
        due = every[keys.STEP] % 5 == 0
        assert held[keys.CROPS][due].equal(every[keys.CROPS][due])
        assert every[keys.OBSERVATION].equal(held[keys.OBSERVATION])
        if step:
            assert held[keys.CROPS][~due].equal(flights[1][step - 1][keys.CROPS][~due])
