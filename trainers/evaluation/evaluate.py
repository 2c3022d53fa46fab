"""Evaluates frozen policies on test fires and, during training, on validation fires."""

import hashlib
import inspect
import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv, step_mdp

from emberlink.comm.base import MODULES, CommModule
from emberlink.envs import keys, metrics
from emberlink.envs.fire.cache import cache_folder
from emberlink.envs.fire.generator import Split, load_scenario
from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.scenarios import ScenarioConfig, fires_of, same_tests
from emberlink.envs.utils.atomic_io import write_bytes
from emberlink.envs.utils.errors import UserError
from emberlink.envs.wildfire import WildfireEnv
from emberlink.policies.hold import Held
from emberlink.policies.scripted.base import SCRIPTED, Scripted
from emberlink.trainers.build import build_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.scores import LEARNED, Measured, Results, means

HELD_OUT_SCENARIO = "huygens"
"""the scenario of evaluations with `evaluation.huygens`, besides the training's"""
START_SEED = 20_250_923
"""seed of test episode 0, including start positions; episode i has this seed plus i"""
VALIDATION_START_SEED = 20_350_923
"""seed of validation episode 0; no validation episode shares a seed with a test episode"""
BLOCK = 50
"""environments in a batch of an evaluation, even if fewer episodes are needed"""

Policy = Callable[[TensorDictBase], TensorDictBase]
Watch = Callable[[TransformedEnv, TensorDictBase, Policy], None]
"""called at each step, from 0 to the horizon, with the environments, their output (the result of
the reset, or the "next" of the step), and the policy"""


def play(env: TransformedEnv, policy: Policy, watch: Watch | None = None) -> dict[str, Tensor]:
    """Plays one episode in each environment; returns the measures, float32 [num_envs] each.

    The policy adds no noise. A UserError if an action is NaN or infinite.
    """
    world: Any = env.base_env
    steps: list[Any] = []
    actions: list[Tensor] = []
    with torch.no_grad():
        td = env.reset()
        if watch is not None:
            watch(env, td, policy)
        for _ in range(world.max_steps):
            td = env.step(policy(td))
            actions.append(td.get(keys.ACTION))
            after = td.get("next")
            if isinstance(policy, Scripted) and after.get(keys.BYTES_SENT, None) is not None:
                sent = policy.bytes_sent(after)  # its messages, not the method's
                if sent is not None:
                    after.set(keys.BYTES_SENT, sent + after.get(keys.REPORT_BYTES, 0))
            if watch is not None:
                watch(env, after, policy)
            steps.append(metrics.measured_steps(after.unsqueeze(1)))
            td = step_mdp(td, keep_other=True)
    if not torch.stack(actions).isfinite().all():
        raise UserError("an action of the policy is NaN or infinite")
    episode: Any = torch.cat(steps, 1)
    return metrics.episode_metrics(episode)


def shown_scenario(config: RunConfig) -> str:
    """Returns the name of the scenario to draw: `huygens`, or the fires of a file or a world."""
    own = isinstance(config.fire, FileFireConfig) or not config.evaluation.huygens
    return config.fire.name if own else HELD_OUT_SCENARIO


def evaluation_scenarios(config: RunConfig) -> dict[str, ScenarioConfig]:
    """Returns the scenarios of an evaluation by name: the training's, and maybe `huygens`."""
    scenarios: dict[str, ScenarioConfig] = {}
    if config.evaluation.huygens:
        scenarios[HELD_OUT_SCENARIO] = load_scenario(HELD_OUT_SCENARIO)
    if not any(same_tests(config.fire, scenario) for scenario in scenarios.values()):
        changed = config.fire.name in scenarios
        scenarios[config.fire.name + ("_as_trained" if changed else "")] = config.fire
    return scenarios


def evaluation_fires(config: RunConfig, count: int, split: Split = "test") -> dict[str, Tensor]:
    """Returns the fires of an evaluation: scenario -> times of `count` fires.

    Times are steps, float32 [count, X, Y] or [count, 2, X, Y] (`split_times`). A scenario with a
    single fire repeats it; the start positions differ.
    """
    grid, horizon = config.env.grid, config.env.horizon
    return {
        name: fires_of(scenario).fires(split, count, grid, horizon)
        for name, scenario in evaluation_scenarios(config).items()
    }


def evaluate(
    config: RunConfig,
    actor: Policy,
    *,
    fires: int,
    report: Callable[[str, str], None] = lambda *_: None,
    watch: Watch | None = None,
) -> Results:
    """Evaluates a frozen policy and the scripted ones on test fires with the same start positions.

    Episode i does not depend on the number of fires. Its random numbers come from the seed
    `START_SEED` + i, and batches always have `BLOCK` environments, since the last bit of a matrix
    product depends on the number of rows.

    Args:
        fires: number of test fires, one episode each.
        report: called with the names of the fire and the policy before each evaluation.
        watch: watches the first batch of the frozen policy on the fires of `shown_scenario`.
    """
    results: Results = {}
    for fire, arrival in evaluation_fires(config, fires).items():
        say = partial(report, fire)
        results[fire] = {}
        say(LEARNED)
        watched = watch if fire == shown_scenario(config) else None
        results[fire][LEARNED] = play_learned(config, actor, arrival, watch=watched)
        for name in config.evaluation.scripted:
            results[fire][name] = play_scripted(config, name, arrival, report=say)
    return results


def validate(config: RunConfig, actor: Policy) -> dict[str, float]:
    """Returns "fire/measure" -> mean of a frozen policy on validation fires.

    `evaluation.interval_episodes` episodes are played, on other fires and from other starts than
    in tests. A batch has one environment per episode, at most `BLOCK`.
    """
    count = config.evaluation.interval_episodes
    seed, block = VALIDATION_START_SEED, min(count, BLOCK)
    result: dict[str, float] = {}
    for name, arrival in evaluation_fires(config, count, "validation").items():
        measured = play_learned(config, actor, arrival, start_seed=seed, block=block)
        result |= {f"{name}/{measure}": value for measure, value in means(measured).items()}
    return result


def play_learned(
    config: RunConfig, actor: Policy, arrival: Tensor, *, watch: Watch | None = None, **more: Any
) -> Measured:
    """Returns the measures of a frozen policy; arguments as for `play_blocks`.

    Where nobody watches, the steps of a held action are computed at once.
    """
    if watch is None and isinstance(actor, Held):
        inner, hold = actor.policy, actor.steps
        return play_blocks(config, lambda _: inner, arrival, hold=hold, **more)
    return play_blocks(config, lambda _: actor, arrival, watch=watch, **more)


def play_scripted(
    config: RunConfig,
    name: str,
    arrival: Tensor,
    *,
    start_seed: int = START_SEED,
    block: int = BLOCK,
    report: Callable[[str], None] = lambda _: None,
) -> Measured:
    """Returns the measures of a scripted policy; arguments as for `play_blocks`.

    They are the same for all runs in an environment, so they are kept in a file.
    """
    world, policy = scripted_config(config, name), SCRIPTED.find(name)
    fires = hashlib.sha256(arrival.cpu().contiguous().numpy().tobytes()).hexdigest()
    settings = asdict(world.env), world.comm, world.policy.hold, world.device, start_seed, block
    parts = name, settings, fires, torch.__version__, source_digest()
    key = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:32]
    file, own = cache_folder() / f"scripted-{key}.json", policy.__module__.startswith("emberlink.")
    if own and file.exists():
        with suppress(OSError, ValueError):
            return json.loads(file.read_text())
    report(name)
    measured = play_blocks(world, policy, arrival, start_seed=start_seed, block=block)
    if own:
        with suppress(OSError):  # the next evaluation plays it again
            file.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(file, json.dumps(measured).encode())
    return measured


@cache
def source_digest() -> str:
    """Returns a hash of the source files on which an episode of a scripted policy depends."""
    digest = hashlib.sha256()
    environment, comm = (Path(inspect.getfile(one)).parent for one in (WildfireEnv, CommModule))
    policies = Path(inspect.getfile(Scripted)).parents[1]
    for folder in (environment, comm, policies):
        for file in sorted(folder.rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()


def scripted_config(config: RunConfig, name: str) -> RunConfig:
    """Returns the configuration of the environment of a scripted policy.

    It is the run's, with three exceptions. A policy that needs the communication of another
    method has its settings in the run's setup. Where the run's communication would replace actions
    of the policy, there is none. Nobody says the messages that the run's policy has learned.
    """
    config = replace(config, policy=replace(config.policy, message="none"))
    recipe = SCRIPTED.find(name).recipe
    if recipe is None:
        steers = MODULES.find(config.comm["name"]).steer is not CommModule.steer
        world = replace(config.env, observation="vector")  # no pictures, which nobody looks at
        return replace(config, comm={"name": "no_comm"}, env=world) if steers else config
    if recipe == config.method:
        return config
    choices = [f"setup={config.setup}", f"world={config.world}", "fire=paper"]
    try:
        usual, other = (resolve(method, choices) for method in (config.method, recipe))
    except UserError as error:
        raise UserError(
            f"{name} flies with the communication of {recipe}: {error}; evaluation.scripted=[] "
            "leaves scripted policies out"
        ) from None
    if other.comm["name"] == config.comm["name"]:
        return config
    usually = asdict(usual.env.radio)
    changed = {k: v for k, v in asdict(config.env.radio).items() if v != usually[k]}
    radio = replace(other.env.radio, **changed)
    return replace(config, comm=other.comm, env=replace(config.env, radio=radio))


def play_blocks(
    config: RunConfig,
    policy: Callable[[WildfireEnv], Policy],
    arrival: Tensor,
    *,
    start_seed: int = START_SEED,
    block: int = BLOCK,
    hold: int = 1,
    watch: Watch | None = None,
) -> Measured:
    """Plays one episode on each fire, in batches; returns the measures, one number per fire.

    Args:
        policy: returns the policy for an environment.
        arrival: times of the fires in steps, float32 [fires, X, Y] or [fires, 2, X, Y].
        start_seed: seed of episode 0; episode i has this seed plus i.
        block: environments per batch. The last batch is padded with episodes that are not counted.
        hold: steps for which the environment holds each action.
        watch: watches the first batch.
    """
    count = len(arrival)
    measured: Measured = {name: [] for name in metrics.names(config.env)}
    for start in range(0, count, block):
        episodes = torch.arange(start, start + block)
        env = build_env(
            config,
            num_envs=block,
            fire=arrival[episodes.clamp(max=count - 1)],
            seed=(start_seed + episodes).tolist(),
            device=config.device,
            hold=hold,
        )
        world: Any = env.base_env
        played = play(env, policy(world), None if start else watch)
        for name, values in played.items():
            measured[name] += values[: count - start].tolist()
    return measured
