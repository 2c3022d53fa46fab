"""Tests the learning of networks with a memory from sequences in a replay buffer."""

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Composite, Unbounded

from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.learners.base import LearnerContext
from emberlink.trainers.learners.nan_guard import NonFiniteGuard
from emberlink.trainers.learners.off_policy.networks import with_taken
from emberlink.trainers.learners.off_policy.sequences import MISSING, SequenceMemory
from emberlink.trainers.training.setup import TrainingSetup

UAVS = 2
SMALL = [
    *("setup=tuned", "env.horizon=12", "env.num_uavs=3", "num_envs=2", "episodes=4"),
    *("learner.hidden=[7,5]", "policy.memory=gru", "policy.units=4"),
    *("learner.batch_size=8", "learner.sequence=4", "learner.burn_in=3"),
]


def made(learner: str, *more: str, method: str = "consensus") -> TrainingSetup:
    return TrainingSetup(resolve(method, [f"learner={learner}", *SMALL, *more]))


def context(horizon: int, envs: int) -> LearnerContext:
    spec = Composite({keys.OBSERVATION: Unbounded((envs, UAVS, 3))}, shape=(envs,))
    return LearnerContext(
        observation_spec=spec,
        action_spec=spec,
        num_uavs=UAVS,
        num_envs=envs,
        seeds=(0,),
        shared_replay=False,
        total_steps=10**6,
        guard=NonFiniteGuard("cpu"),
        device="cpu",
        horizon=horizon,
    )


def memory(horizon: int, envs: int, decisions: int, **more: Any) -> SequenceMemory:
    """Returns a memory after some decisions; values are decision, environment and UAV."""
    buffer = SequenceMemory(context(horizon, envs), **more)
    for decision in range(decisions):
        where = torch.tensor([[(decision, env, uav) for uav in range(UAVS)] for env in range(envs)])
        agents = {"observation": where[:, None].float(), "action": where[:, None].float()}
        after = {
            "observation": agents["observation"].clone(),
            "reward": torch.ones(envs, 1, UAVS, 1),
        }
        after["observation"][..., 0] += 1
        done = torch.zeros(envs, 1, 1, dtype=torch.bool)
        following = {keys.AGENTS: after, "done": done, "terminated": done.clone()}
        buffer.extend(TensorDict({keys.AGENTS: agents, "next": following}, batch_size=[envs, 1]))
    return buffer


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_sequence_never_crosses_an_episode(data):
    horizon, envs = data.draw(st.integers(1, 9)), data.draw(st.integers(1, 3))
    sequence, burn_in = data.draw(st.integers(1, horizon)), data.draw(st.integers(0, 5))
    least = burn_in + 2 * sequence - 1
    size = data.draw(st.integers(least * envs, (least + 12) * envs))
    decisions = data.draw(st.integers(sequence, 40))
    lengths = {"sequence": sequence, "burn_in": burn_in}
    buffer = memory(horizon, envs, decisions, batch_size=20, buffer_size=size, **lengths)
    sample = buffer.sample()
    assert len(sample) == -(-20 // sequence)
    oldest = decisions - size // envs
    for row in sample:
        for uav in range(UAVS):
            agents, following = row[keys.AGENTS][uav], row["next", keys.AGENTS][uav]
            observed = agents["observation"].long().tolist()
            first, env, _ = observed[burn_in]
            begin, missing = first // horizon * horizon, int(agents["missing"])
            end = min(begin + horizon, decisions)
            learnt = [[min(first + k, end - 1), env, uav] for k in range(sequence)]
            assert observed[burn_in:] == agents["action"].long().tolist() == learnt
            assert max(oldest, 0) <= first < end
            alive = agents["alive"].tolist()
            assert alive == sorted(alive, reverse=True)
            assert 0 < sum(alive) <= end - first
            after = following["observation"].long().tolist()
            assert after[burn_in:] == [learnt[0], *([k + 1, env, uav] for k, *_ in learnt)]
            assert missing == max(0, begin + burn_in - first)
            before = [[max(begin, first - burn_in + k), env, uav] for k in range(burn_in)]
            assert observed[:burn_in] == after[:burn_in] == before
            assert first - burn_in + missing >= oldest


def shares(agents: TensorDict, uav: int, decisions: int) -> Tensor:
    """Returns how often each decision is learnt from, as a share of the sum."""
    learnt = agents["action"][:, uav, :, 0].long()[agents["alive"][:, uav]]
    return learnt.bincount(minlength=decisions) / len(learnt)


def test_every_decision_is_learnt_from_equally_often():
    """Episodes of 6 decisions; the buffer holds decisions 3 to 13 of two environments.

    The beginning of the first episode is lost, so decision 3 is the burn-in of decision 4. The
    third episode is not finished. The first decisions of episodes, 6 and 12, have no burn-in.
    """
    lengths = {"sequence": 3, "burn_in": 1}
    buffer = memory(6, 2, 14, batch_size=60_000, buffer_size=22, **lengths)
    agents = buffer.sample()[keys.AGENTS]
    for uav in range(UAVS):
        assert (agents["action"][:, uav, :, 2] == uav).all()
        share = shares(agents, uav, 14)
        assert not share[:4].any()
        torch.testing.assert_close(share[4:], torch.full((10,), 0.1), atol=0.006, rtol=0)
        env = agents["action"][:, uav, 0, 1]
        assert 0.49 < env.mean() < 0.51
        first = agents["action"][:, uav, 0, 0]
        assert (agents["missing"][:, uav] == 1).equal((first == 6) | (first == 12))


@pytest.mark.parametrize("burn_in", [0, 1, 3, 5])
def test_a_burn_in_is_shorter_at_the_beginning(burn_in):
    """Episodes of 6 decisions, and sequences of 2; a sequence may begin before its episode."""
    lengths = {"sequence": 2, "burn_in": burn_in}
    buffer = memory(6, 1, 6, batch_size=40_000, buffer_size=20, **lengths)
    agents = buffer.sample()[keys.AGENTS]
    torch.testing.assert_close(shares(agents, 0, 6), torch.full((6,), 1 / 6), atol=0.01, rtol=0)
    first = agents["observation"][:, 0, burn_in, 0].long()
    assert agents["missing"][:, 0].equal((burn_in - first).clamp(min=0))
    assert first.unique().tolist() == [0, 1, 2, 3, 4, 5]
    assert (agents["alive"][:, 0].sum(1) == 1)[first == 5].all()


@pytest.mark.parametrize("learner", ["ddpg", "imitation"])
def test_no_burn_in_is_longer_than_an_episode(learner):
    """Decisions before the beginning of an episode of 12 decisions are not computed."""
    method = "maps" if learner == "imitation" else "consensus"
    more = ["learner.samples=8", "policy.hold=1"] if method == "maps" else []
    given = [text for text in SMALL if method != "maps" or "batch_size" not in text]
    settings = [f"learner={learner}", *given, "learner.burn_in=1000000", *more]
    setup = TrainingSetup(resolve(method, settings))
    setup.dry_run(24)
    assert setup.learner.updates > 0
    assert setup.learner.replay.burn_in == setup.learner.config.burn_in == 11


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["learner.sequence=13"], "learner.sequence=13: an episode has 12 decisions"),
        (["policy.hold=4"], "learner.sequence=4: an episode has 3 decisions"),
        (
            ["learner.buffer_size=19"],
            "learner.buffer_size=19: shared by 3 UAVs, holds 3 decisions of 2 environments",
        ),
        (["learner.critic=both"], "learner.critic=both: should be 'own' or 'team'"),
    ],
)
def test_what_does_not_fit_is_refused(given, message):
    with pytest.raises(UserError) as error:
        made("ddpg", *given)
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


# --- a reference: one UAV, one sequence and one decision after another


def remembered(weights: dict[str, Tensor], uav: int, inputs: list[Tensor]) -> list[Tensor]:
    """Returns the states of a GRU (Cho et al. 2014) after each input, from an empty one."""
    w = {name.removeprefix("memory."): value[uav] for name, value in weights.items()}
    state, states = torch.zeros(w["state_weight"].shape[1]), []
    for x in inputs:
        x = torch.tanh(x @ w["input.weight"] + w["input.bias"][0])
        from_input = (w["input_weight"] @ x + w["input_bias"]).chunk(3)
        from_state = (w["state_weight"] @ state + w["state_bias"]).chunk(3)
        reset, keep = (torch.sigmoid(from_input[k] + from_state[k]) for k in (0, 1))
        new = torch.tanh(from_input[2] + reset * from_state[2])
        state = (1 - keep) * new + keep * state
        states.append(state)
    return states


def layer(weights: dict[str, Tensor], name: str, uav: int, x: Tensor) -> Tensor:
    return x @ weights[f"{name}.weight"][uav] + weights[f"{name}.bias"][uav, 0]


def normed(weights: dict[str, Tensor], name: str, uav: int, x: Tensor) -> Tensor:
    x = (x - x.mean()) / (x.var(unbiased=False) + 1e-5).sqrt()
    return x * weights[f"{name}_norm.weight"][uav, 0] + weights[f"{name}_norm.bias"][uav, 0]


def act(weights: dict[str, Tensor], uav: int, state: Tensor) -> Tensor:
    x = torch.relu(normed(weights, "first", uav, layer(weights, "first", uav, state)))
    x = torch.relu(normed(weights, "second", uav, layer(weights, "second", uav, x)))
    return torch.tanh(layer(weights, "action", uav, x))


def value(weights: dict[str, Tensor], uav: int, state: Tensor, action: Tensor) -> Tensor:
    x = torch.relu(normed(weights, "first", uav, layer(weights, "first", uav, state)))
    x = normed(weights, "second", uav, layer(weights, "second", uav, x))
    return layer(weights, "value", uav, torch.relu(x + layer(weights, "action", uav, action)))


def team_of(x: Tensor, uav: int) -> Tensor:
    """Returns the vectors of all UAVs, [uavs, features], beginning with that of one UAV."""
    return torch.cat([x[(uav + k) % len(x)] for k in range(len(x))])


@pytest.mark.parametrize("team", [False, True])
def test_the_losses_equal_those_computed_decision_by_decision(team):
    """DDPG with a GRU, in a world with failures."""
    critic = f"learner.critic={'team' if team else 'own'}"
    setup = made("ddpg", critic, "env.failures=3", "learner.gamma=0.5", "learner.batch_size=48")
    setup.dry_run(36)
    learner: Any = setup.learner
    batch, gamma, past, size = learner.sample(), 0.5, 3, 4
    weights: dict[str, dict[str, Tensor]] = {}
    for name, weight in learner.networks().items():
        kind, _, rest = name.partition("_network_params.module.")
        weights.setdefault(kind, {})[rest] = weight
    alive, missing = batch[keys.ALIVE], batch[MISSING]
    assert 0 < alive.float().mean() < 1
    assert 0 < ((missing > 0) & (missing < past)).float().mean() < 1, missing
    total = {name: [0.0] * 3 for name in ("actor", "critic")}
    for row in range(len(batch)):
        seen, after = batch[keys.OBSERVATION][row], batch["next", *keys.OBSERVATION][row]
        taken, reward = batch[keys.ACTION][row], batch["next", *keys.REWARD][row]
        first = missing[row].tolist()

        def states(kind: str, uav: int, x: Tensor, whole: bool, first: int) -> list[Tensor]:
            inputs = [team_of(x[:, t], uav) if whole else x[uav, t] for t in range(x.shape[1])]
            return remembered(weights[kind], uav, inputs[first:])[-size:]

        actor = [states("actor", uav, seen, False, first[uav]) for uav in range(3)]
        target_actor = [states("target_actor", uav, after, False, first[uav]) for uav in range(3)]
        for uav in range(3):
            valued = states("value", uav, seen, team, first[uav])
            beyond = states("target_value", uav, after, team, first[uav])
            for t in range(size):
                if not alive[row, uav, t]:
                    continue
                later = [act(weights["target_actor"], j, target_actor[j][t]) for j in range(3)]
                own = act(weights["actor"], uav, actor[uav][t])
                done, chosen, next_action = taken[uav, t], own, later[uav]
                if team:
                    done = team_of(taken[:, t], uav)
                    chosen = torch.cat((own, done[3:]))
                    next_action = team_of(torch.stack(later), uav)
                target = reward[uav, t, 0] + gamma * value(
                    weights["target_value"], uav, beyond[t], next_action
                )
                error = value(weights["value"], uav, valued[t], done) - target
                total["critic"][uav] += error.item() ** 2
                total["actor"][uav] -= value(weights["value"], uav, valued[t], chosen).item()
    given = batch if not team else with_taken(batch)
    losses = learner.losses(given)
    counts = alive.sum((0, 2))
    for name, sums in total.items():
        wanted = torch.tensor(sums) / counts
        torch.testing.assert_close(losses[name].detach(), wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("learner", ["ddpg", "td3"])
def test_a_burn_in_has_no_gradient_and_does_not_matter_where_it_is_missing(learner):
    setup = made(learner, "learner.share_parameters=true")
    setup.dry_run(24)
    batch = setup.learner.sample()  # pyright: ignore[reportAttributeAccessIssue]
    missing, changed = batch[MISSING], batch.clone()
    for place in ((), ("next",)):
        changed[(*place, *keys.OBSERVATION)][:, :, :3] += 1
    for uav in range(3):
        for row in range(len(batch)):
            losses = [setup.learner.losses(x[row : row + 1]) for x in (batch, changed)]  # pyright: ignore[reportAttributeAccessIssue]
            for name, loss in losses[0].items():
                assert loss[uav].equal(losses[1][name][uav]) == bool(missing[row, uav] == 3)
    network: Any = setup.learner.actor.module
    observed = batch[keys.OBSERVATION].clone().requires_grad_()
    network([observed], missing, 3, 4).sum().backward()
    assert not observed.grad[:, :, :3].any()
    assert observed.grad[:, :, 3:].all()


@pytest.mark.parametrize("method", ["consensus", "shared_memory"])
def test_a_failed_uav_is_not_learnt_from(method):
    setup = made("ddpg", "env.failures=3", method=method)
    setup.dry_run(36)
    learner: Any = setup.learner
    batch = learner.sample()
    dead = ~batch[keys.ALIVE]
    assert 0 < dead.float().mean() < 1
    changed = batch.clone()
    changed[keys.ACTION][dead] *= -1
    changed["next", *keys.REWARD][dead] += 5
    for name, loss in learner.losses(batch).items():
        assert loss.equal(learner.losses(changed)[name])


@pytest.mark.parametrize("kind", ["gru", "stack"])
@pytest.mark.parametrize("more", [[], ["learner.share_parameters=true", "env.observation=window"]])
def test_decision_by_decision_equals_the_whole_sequence(kind, more):
    setup = made("ddpg", f"policy.memory={kind}", "policy.agent_index=true", *more)
    network: Any = setup.learner.actor.module
    td = setup.env.rollout(9, break_when_any_done=False)
    observed = [
        td[key].transpose(1, 2) for key in keys.observation_keys(setup.env.observation_spec)
    ]
    missing = torch.zeros(2, 3, dtype=torch.int64)
    whole = network(observed, missing, 0, 9)
    state = None
    for k in range(9):
        action, state = network.step([x[:, :, k] for x in observed], state)
        torch.testing.assert_close(action, whole[:, :, k], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(network(observed, missing, 4, 5), whole[:, :, 4:])


@pytest.mark.heavy
@pytest.mark.parametrize(("kind", "learnt"), [("none", False), ("stack", True), ("gru", True)])
def test_what_needs_a_memory_is_learnt_with_one(kind, learnt):
    """The best action is 0.8 times the observation before, which is random."""
    more = ["env.num_uavs=2", "num_envs=8", "learner.gamma=0.0", "learner.batch_size=64"]
    rates = ["learner.actor_lr=0.003", "learner.critic_lr=0.01", "policy.units=16"]
    hidden = ["learner.hidden=[32]", f"policy.memory={kind}", "episodes=20", "env.horizon=20"]
    learner: Any = made("ddpg", *more, *rates, *hidden, method="independent").learner
    generator = torch.Generator().manual_seed(1)

    def drawn(*shape: int) -> Tensor:
        return 2 * torch.rand(*shape, generator=generator) - 1

    done = torch.zeros(8, 1, 1, dtype=torch.bool)
    for _ in range(10):
        seen, action = drawn(8, 21, 2, 6), drawn(8, 20, 2, 3)
        before = torch.cat((torch.zeros(8, 1, 2, 3), seen[:, :19, :, :3]), 1)
        reward = -(action - 0.8 * before).square().sum(-1, keepdim=True)
        for k in range(20):
            now = {"observation": seen[:, k, None], "action": action[:, k, None]}
            after = {"observation": seen[:, k + 1, None], "reward": reward[:, k, None]}
            following = {keys.AGENTS: after, "done": done, "terminated": done.clone()}
            step = TensorDict({keys.AGENTS: now, "next": following}, batch_size=[8, 1])
            learner.replay.extend(step)
    for _ in range(400):
        learner.update(learner.sample())
    seen, state, errors = drawn(8, 20, 2, 6), None, []
    with torch.no_grad():
        for k in range(1, 20):
            if kind == "none":
                action = learner.actor.module(seen[:, k])
            else:
                action, state = learner.actor.module.step([seen[:, k]], state)
            errors.append((action - 0.8 * seen[:, k - 1, :, :3]).square().mean())
    error = torch.stack(errors[1:]).mean().item()  # 0.21 for actions of 0
    assert error < 0.06 if learnt else error > 0.15
