"""Tests the learners from whole episodes: IPPO and MAPPO."""

import math
from itertools import combinations
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import check_env_specs
from torchrl.modules import PopArtValueNorm
from torchrl.objectives.value import MultiAgentGAE

from emberlink.envs import keys
from emberlink.policies.gaussian import LOG_PROB
from emberlink.trainers import make_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.learners.ppo import ADVANTAGE, RETURN, VALUE
from emberlink.trainers.training.setup import TrainingSetup

LEARNERS = ["ippo", "mappo"]
SMALL = [
    *("env.horizon=12", "env.num_uavs=3", "num_envs=4", "episodes=4", "learner.hidden=[8]"),
    *("policy.memory=gru", "policy.units=6", "policy.hold=2", "fire.num_train_fires=2"),
]


def made(learner: str, *more: str, method: str = "consensus") -> TrainingSetup:
    return TrainingSetup(resolve(method, ["setup=tuned", f"learner={learner}", *SMALL, *more]))


def estimating(gamma: float, lam: float, *more: str) -> Any:
    """Returns a learner whose advantages have a discount and a lambda."""
    return made("ippo", f"learner.gamma={gamma}", f"learner.gae_lambda={lam}", *more).learner


def column(*values: float) -> Tensor:
    """Returns one environment and one UAV, float32 [1, decisions, 1, 1]."""
    return torch.tensor(values)[None, :, None, None]


def test_values_are_in_units_of_the_earlier_spread():
    # Temporal differences: 1 + 0.5 * 4 - 2 = 1, and 3 + 0.5 * 8 - 4 = 3. Advantages: 1 + 0.25 * 3
    # and 3. Returns: 3.75 and 7, whose deviation is 1.625.
    estimator = estimating(0.5, 0.5)
    estimator.spread.fill_(2.0)
    _, returns = estimator.advantages(column(1, 2, 4), column(1, 3), None)
    spread = 0.9 * 2 + 0.1 * 1.625
    assert estimator.spread.item() == pytest.approx(spread)
    assert returns.flatten().tolist() == pytest.approx([3.75 / spread, 7 / spread])


def first_batches(setup: TrainingSetup) -> list[Any]:
    """Returns the batches of the first iteration and makes no update."""
    learner: Any = setup.learner
    batches: list[Any] = []
    learner.update = lambda batch: batches.append(batch) or {}
    setup.dry_run(12)
    return batches


@pytest.mark.parametrize("learner", LEARNERS)
def test_returns_do_not_depend_on_the_number_of_minibatches(learner):
    whole, parts = (
        torch.cat([batch[RETURN] for batch in first_batches(made(learner, "num_envs=5", *more))])
        for more in (["learner.minibatches=1"], ["learner.minibatches=3"])
    )
    assert whole.shape[0] == 5 * 4  # a row for each environment and epoch
    torch.testing.assert_close(parts[:5], whole[:5])


@pytest.mark.parametrize("learner", LEARNERS)
def test_the_learning_rate_falls_to_zero(learner):
    setup = made(learner, "learner.lr=0.5")
    (entry,) = setup.learner.optimizer.param_groups  # pyright: ignore[reportAttributeAccessIssue]
    rates = []
    for _ in range(4):
        setup.dry_run(12)
        rates.append(entry["lr"])
    assert rates == pytest.approx([0.5, 0.375, 0.25, 0.125])


def first_iteration(setup: TrainingSetup) -> tuple[Any, Any]:
    """Returns an episode as it was flown, with advantages, and the batch of the first update."""
    learner: Any = setup.learner
    estimate, episodes = learner._estimate, []

    def estimated(episode: Any, last: Any) -> Tensor:
        states = estimate(episode, last)
        episodes.append(episode.clone())
        return states

    learner._estimate = estimated
    batch = first_batches(setup)[0]
    return episodes[0], batch


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("shared", ["true", "false"])
@pytest.mark.parametrize("failures", [0, 3])
@pytest.mark.parametrize("chunk", [2, 4, 6])
def test_losses_and_gradients_of_chunks_equal_a_loop(learner, shared, failures, chunk):
    """Of six decisions, from states without gradients; chunks of four divide them into 4 and 2."""
    more = f"learner.share_parameters={shared}", f"env.failures={failures}"
    setup = made(learner, *more, f"learner.chunk={chunk}", "learner.minibatches=1")
    episode, batch = first_iteration(setup)
    trained: Any = setup.learner
    actor, critic = trained.actor.module, trained.critic.module
    assert len(batch) == 4 * -(-6 // chunk)
    errors, ratios, alive = [], [], []
    actor_state, critic_state = None, critic.empty_state(4)
    for k in range(6):
        if k % chunk == 0:
            actor_state = None if actor_state is None else actor_state.detach()
            critic_state = critic_state.detach()
        now = episode[:, k]
        mean, actor_state = actor.step([now[key] for key in trained.actor.observed], actor_state)
        observed = [now[key][:, None] for key in trained.critic.in_keys[1:]]
        value, critic_state = critic(critic_state, *observed)
        drawn = torch.distributions.Normal(mean, actor.std(mean.shape[:-1]))
        ratio = (drawn.log_prob(now[keys.ACTION]).sum(-1) - now[LOG_PROB]).exp()
        ratios.append(ratio * now[ADVANTAGE][..., 0])
        errors.append((value[:, 0, :, 0] - now[RETURN][..., 0]).square())
        alive.append(now.get(keys.ALIVE, torch.ones(4, 3, dtype=torch.bool)))
    flew = torch.stack(alive, 1).float()
    mean_of = [(torch.stack(x, 1) * flew).sum((0, 1)) / flew.sum((0, 1)) for x in (ratios, errors)]
    losses = trained.losses(batch)
    torch.testing.assert_close(losses["actor"], -mean_of[0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(losses["critic"], mean_of[1], rtol=1e-4, atol=1e-5)
    weights = [*actor.parameters(), *critic.parameters()]
    ours, theirs = (
        torch.autograd.grad(total, weights)
        for total in (
            losses["actor"].sum() + losses["critic"].sum(),
            mean_of[1].sum() - mean_of[0].sum(),
        )
    )
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5)


def test_uavs_without_shared_weights_learn_alone():
    setup = made("ippo", "learner.share_parameters=false")
    batch = first_batches(setup)[0]
    learner: Any = setup.learner
    learner.losses(batch)["actor"][1].backward()
    gradient = learner.actor.module.memory.state_weight.grad
    assert gradient[1].any()
    assert not gradient[[0, 2]].any()


def test_only_mappos_critic_reads_the_true_map():
    """The map is the environment's before each decision; evaluations do not have it."""
    setup = made("mappo", "learner.critic_map=true", "env.grid=[12,9]")
    first, rollout = setup.env.base_env.fire_map.clone(), next(iter(setup.collector))
    maps, after = rollout[keys.TRUE_MAP], rollout["next", keys.TRUE_MAP]
    assert maps.shape == (4, setup.learner.rollout_steps, 12, 9)
    assert maps[:, 0].equal(first)
    assert maps[:, 1:].equal(after[:, :-1])
    assert after[:, -1].any()
    learner: Any = setup.learner
    assert keys.TRUE_MAP in set(learner.critic.in_keys) - set(learner.explorer.in_keys)
    assert keys.TRUE_MAP not in make_env(setup.config).reset()
    check_env_specs(setup.env)
    learner = made("mappo", "learner.critic_map=true", method="maps").learner
    assert keys.CROPS in set(learner.actor.in_keys) - set(learner.critic.in_keys)
    batch = first_batches(made("mappo", "learner.critic_map=true"))[0]
    changed = batch.clone()
    changed[keys.TRUE_MAP][:, 2] = 2 - changed[keys.TRUE_MAP][:, 2]
    learner = made("mappo", "learner.critic_map=true").learner
    before, after = (learner.critic(x)[VALUE] for x in (batch, changed))
    assert before[:, :2].equal(after[:, :2])
    assert not before[:, 2:].isclose(after[:, 2:]).any()
    assert learner.losses(batch)["actor"].equal(learner.losses(changed)["actor"])
    values = []
    for kind in range(3):  # no, seen and unseen fire everywhere
        changed[keys.TRUE_MAP].fill_(kind)
        values.append(learner.critic(changed.copy())[VALUE].clone())
    assert not any(one.isclose(other).any() for one, other in combinations(values, 2))


def test_updates_with_16_bits_have_nearly_the_losses_of_32():
    batch = first_batches(made("mappo", method="maps"))[0]
    setups = (made("mappo", f"learner.bfloat16={x}", method="maps") for x in (False, True))
    exact, near = (setup.learner.update(batch.clone()) for setup in setups)
    assert not exact["critic"].equal(near["critic"])
    torch.testing.assert_close(exact, near, rtol=0.05, atol=0.01)


@pytest.mark.parametrize("learner", LEARNERS)
def test_the_losses_are_those_of_ppo(learner):
    setup = made(learner, "learner.clip=0.1", "learner.entropy=0.01")
    batch, trained = first_batches(setup)[0], setup.learner
    draw = torch.Generator().manual_seed(0)
    shift = 0.6 * torch.rand(batch[LOG_PROB].shape, generator=draw) - 0.3
    batch[LOG_PROB] += shift
    losses, ratio, gain = trained.losses(batch), (-shift).exp(), batch[ADVANTAGE][..., 0]
    surrogate = torch.minimum(ratio * gain, ratio.clamp(0.9, 1.1) * gain)
    torch.testing.assert_close(losses["actor"], -surrogate.mean((0, 1)), rtol=1e-3, atol=1e-3)
    error = (trained.critic(batch.copy())[VALUE] - batch[RETURN]).square()
    torch.testing.assert_close(losses["critic"], error.mean((0, 1))[:, 0])
    entropy = 3 * (0.5 * math.log(2 * math.pi * math.e) - 0.5)  # log_std = -0.5
    assert losses["entropy"].tolist() == pytest.approx([-0.01 * entropy] * 3, rel=1e-4)


@pytest.mark.parametrize("learner", LEARNERS)
def test_the_gradients_of_an_update_have_a_largest_norm(learner, monkeypatch):
    setup = made(learner, "learner.gradient_norm=0.001")
    (batch, *_), trained, seen = first_batches(setup), setup.learner, []

    def step() -> None:
        seen.extend([value.grad.clone() for value in part] for part in trained.parts)

    monkeypatch.setattr(trained.optimizer, "step", step)
    type(trained).update(trained, batch)  # `first_batches` replaces the object's
    for gradients in seen:
        norms = [torch.linalg.vector_norm(value.flatten(1), dim=1) for value in gradients]
        total = torch.stack(norms).square().sum(0).sqrt()
        torch.testing.assert_close(total, torch.full_like(total, 0.001), rtol=1e-2, atol=0)


@pytest.mark.parametrize(("shared", "networks"), [("true", 1), ("false", 3)])
def test_advantages_equal_loops(shared, networks):
    """Rewards of UAVs pass through; each network has its own scale; failures mask decisions."""
    learner = estimating(0.9, 0.8, f"learner.share_parameters={shared}")
    generator = torch.Generator().manual_seed(0)
    value, reward = (torch.randn(4, n, 3, 1, generator=generator) for n in (7, 6))
    reward[:, :, 1] *= 10
    last = torch.randint(1, 9, (4, 1, 3), generator=generator)  # decisions before a failure
    alive = torch.arange(6)[None, :, None] < last
    advantage, returns = learner.advantages(value, reward, alive)
    assert learner.spread.shape == (networks,)
    for network in range(networks):
        raw, places = [], []
        for env in range(4):
            for uav in range(3) if networks == 1 else [network]:
                decisions, following = min(6, int(last[env, 0, uav])), 0.0
                for k in reversed(range(decisions)):
                    v, after = value[env, k, uav, 0].item(), value[env, k + 1, uav, 0].item()
                    delta = reward[env, k, uav, 0].item() + 0.9 * after - v
                    following = delta + 0.9 * 0.8 * following
                    raw.append((following, following + v))
                    places.append((env, k, uav))
        gains, sums = torch.tensor(raw).T
        expected = (gains - gains.mean()) / gains.std(correction=0)
        scale = sums.std(correction=0)
        torch.testing.assert_close(learner.spread[network], scale, rtol=1e-4, atol=1e-5)
        for place, gain, total in zip(places, expected, sums / scale, strict=True):
            torch.testing.assert_close(advantage[place][0], gain, rtol=1e-3, atol=1e-4)
            torch.testing.assert_close(returns[place][0], total, rtol=1e-3, atol=1e-4)


def test_torchrls_standardisation_and_value_norm_count_what_follows_a_failure():
    """Why they are not used: with a UAV that failed, its later rewards change the others'."""
    alive = torch.tensor([True, True, False, False])[None, :, None]
    ours, theirs, norms = [], [], []
    for after in (0.0, 100.0):
        value, reward = column(2, 4, 8, after, after), column(1, 3, after, after)
        ours.append(estimating(0.5, 0.5).advantages(value, reward, alive)[0][:, :2])
        gae = MultiAgentGAE(gamma=0.5, lmbda=0.5, value_network=None, average_gae=True)
        ends = torch.tensor([False, True, True, True])[None, :, None, None]
        episode = TensorDict(
            {
                "state_value": value[:, :-1],
                "next": {
                    "state_value": value[:, 1:],
                    "reward": reward,
                    "done": ends,
                    "terminated": torch.zeros_like(ends),
                },
            },
            [1, 4],
        )
        theirs.append(gae(episode)["advantage"][:, :2])
        norm = PopArtValueNorm(shape=1)
        norm.update(episode["value_target"])
        norms.append(norm.scale())
    assert ours[0].equal(ours[1])
    assert not theirs[0].isclose(theirs[1]).any()
    assert not norms[0].isclose(norms[1]).any()


def test_a_pass_uses_every_episode_once_in_an_order_of_the_seed():
    settings = ["num_envs=6", "learner.minibatches=4", "learner.epochs=2", "seed=4"]
    batches = []
    for seed in (1, 2):
        torch.manual_seed(seed)  # no effect
        batches.append(first_batches(made("ippo", *settings)))
    assert [len(batch) for batch in batches[0]] == [2, 2, 1, 1] * 2
    for one, other in zip(*batches, strict=True):
        assert one[RETURN].equal(other[RETURN])
    returns = [torch.cat([x[RETURN] for x in batches[0][k : k + 4]]) for k in (0, 4)]
    orders = [r.flatten(1).sum(1) for r in returns]
    assert orders[0].sort().values.equal(orders[1].sort().values)
