"""Defines the workloads of the benchmarks, which alternate so that other load affects all.

Rates are measured over calls of the public interface: an environment's step is TorchRL's
`step_and_maybe_reset` with new random actions.
"""

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import torch
from tensordict import TensorDict

from emberlink.envs import keys
from emberlink.envs.utils.config_files import known
from emberlink.envs.wildfire import WildfireEnv
from emberlink.trainers import make_env
from emberlink.trainers.build import build_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.learners.replay import to_batch
from emberlink.trainers.training.setup import TrainingSetup

METHODS = known("method")
MATRIX = 2048


def in_turns(
    rounds: int, *works: Callable[[], object], pick: Callable[[list[float]], float] = median
) -> list[float]:
    """Returns the median seconds of each workload over alternating rounds, without the first."""
    taken: list[list[float]] = [[] for _ in works]
    for _ in range(rounds + 1):
        for work, seconds in zip(works, taken, strict=True):
            began = time.perf_counter()
            work()
            seconds.append(time.perf_counter() - began)
    return [pick(seconds[1:]) for seconds in taken]


def make(method: str | None, num_envs: int, **settings):
    """Returns a recipe's environment, or the bare one."""
    if method is None:
        config = resolve("independent", **settings).env
        return WildfireEnv(num_envs, config)
    return make_env(method, num_envs=num_envs, **settings)


def strong(method: str, num_envs: int, *options: str, hold: int = 1):
    """Returns a training environment of the setup `strong`, which may hold actions."""
    config = resolve(method, ["setup=strong", "fire.num_train_fires=16", *options])
    return build_env(config, num_envs=num_envs, fire=config.fire, seed=0, device="cpu", hold=hold)


def flying(env, steps: int) -> Callable[[], object]:
    """Returns a function that runs `steps` environment steps with random actions."""
    shape = env.full_action_spec[keys.ACTION].shape
    td = env.reset()

    def fly() -> None:
        nonlocal td
        for _ in range(steps):
            td.set(keys.ACTION, torch.rand(shape, device=env.device).mul_(2).sub_(1))
            _, td = env.step_and_maybe_reset(td)

    return fly


def steps_for(num_envs: int, uavs: int = 6) -> int:
    """Returns a number of steps that takes some tenths of a second."""
    return max(5, min(400, 1_200_000 // (num_envs * uavs)))


def vmas_flying(scenario: str, num_envs: int, steps: int) -> tuple[Callable[[], object], int]:
    """Returns a function that runs `steps` steps of a VMAS scenario, and its number of agents."""
    import vmas

    env = vmas.make_env(scenario, num_envs=num_envs, device="cpu", continuous_actions=True)
    env.reset()

    def fly() -> None:
        for _ in range(steps):
            env.step([env.get_random_action(agent) for agent in env.agents])

    return fly, env.n_agents


def jaxmarl_flying(num_envs: int, steps: int) -> tuple[Callable[[], object], int]:
    """Returns a function that runs steps of JaxMARL's `simple_spread`, and its number of agents."""
    import jax  # pyright: ignore[reportMissingImports]
    from jaxmarl import make  # pyright: ignore[reportMissingImports]

    env = make("MPE_simple_spread_v3")
    reset, step, split = jax.vmap(env.reset), jax.vmap(env.step), jax.random.split

    def one(carried, _):
        key, state = carried
        key, *keys_of = split(key, env.num_agents + 2)
        actions = {
            agent: jax.vmap(env.action_space(agent).sample)(split(own, num_envs))
            for agent, own in zip(env.agents, keys_of[1:], strict=True)
        }
        _, state, reward, _, _ = step(split(keys_of[0], num_envs), state, actions)
        return (key, state), sum(value.sum() for value in reward.values())

    many = jax.jit(lambda carried: jax.lax.scan(one, carried, None, length=steps))
    key = jax.random.PRNGKey(0)
    carried = key, reset(split(key, num_envs))[1]

    def fly() -> None:
        nonlocal carried
        carried, rewards = many(carried)
        jax.block_until_ready(rewards)

    return fly, env.num_agents


def matrix_product(device: str = "cpu") -> Callable[[], object]:
    """Returns a function with 2048^3 multiply-adds in float32, to measure the machine's peak."""
    a, b = (torch.randn(MATRIX, MATRIX, device=device) for _ in range(2))
    return lambda: a @ b


def batch_of(setup: TrainingSetup) -> TensorDict:
    """Returns a sample of a replay buffer with a few hundred steps."""
    learner: Any = setup.learner
    setup.dry_run(-(-learner.replay.needed // setup.config.num_envs) + 20)
    return to_batch(learner.replay.sample())
