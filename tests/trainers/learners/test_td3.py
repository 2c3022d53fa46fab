"""Tests TD3's delayed actors, target smoothing and losses."""

from typing import Any

import torch

from emberlink.trainers.config.compose import resolve
from emberlink.trainers.learners.replay import to_batch
from emberlink.trainers.learners.td3 import TD3
from emberlink.trainers.training.setup import TrainingSetup

SMALL = [
    *("env.horizon=15", "env.num_uavs=3", "num_envs=2", "episodes=2", "learner=td3"),
    *("learner.hidden=[8,8]", "learner.batch_size=8", "learner.gamma=0.5"),
]


def made(*more: str) -> TrainingSetup:
    return TrainingSetup(resolve("consensus", [*SMALL, *more]))


def smoothed(monkeypatch, *more: str) -> tuple[TD3, Any]:
    """Returns a learner after some updates, and the batch of the last one, with its noise."""
    seen, losses = [], TD3.losses
    monkeypatch.setattr(TD3, "losses", lambda self, b, **k: seen.append(b) or losses(self, b, **k))
    setup = made(*more)
    setup.dry_run(12)
    learner: Any = setup.learner
    learner.update(to_batch(learner.replay.sample()))
    return learner, seen[-1]


def test_actors_and_all_targets_are_delayed():
    setup = made("learner.policy_delay=3")
    learner, moved = setup.learner, []
    rollouts = iter(setup.collector)
    while learner.updates < 7:
        before = {name: value.clone() for name, value in learner.loss.state_dict().items()}
        updates = learner.updates
        setup.learn(next(rollouts))
        if learner.updates > updates:
            after = learner.loss.state_dict()
            changed = {name for name, value in after.items() if not value.equal(before[name])}
            moved.append({name.partition("_network")[0] for name in changed})
    critics, every = {"qvalue"}, {"actor", "qvalue", "target_actor", "target_qvalue"}
    assert moved == [critics, critics, every, critics, critics, every, critics]


def test_the_target_noise_is_clipped_and_seeded(monkeypatch):
    options = "learner.target_noise=0.4", "learner.target_noise_clip=0.5", "learner.batch_size=16"
    noise = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        noise.append(smoothed(monkeypatch, *options)[1]["next", "agents", "target_noise"])
    assert noise[0].equal(noise[1])
    assert noise[0].abs().max() == 0.5
    assert 0.1 < noise[0].std() < 0.4


def test_the_target_is_the_lower_of_two_critics_at_the_smoothed_action(monkeypatch):
    learner, batch = smoothed(monkeypatch)
    loss, following, agents = learner.loss, batch["next", "agents"], batch["agents"]
    with torch.no_grad():
        with loss.target_actor_network_params.to_module(loss.actor_network):
            network = loss.actor_network.actor.module
            action = (network(following["observation"]) + following["target_noise"]).clamp(-1, 1)
        values = []
        for params in (loss.target_qvalue_network_params, loss.qvalue_network_params):
            for k in range(2):
                with params[k].to_module(loss.qvalue_network):
                    critic = loss.qvalue_network.module
                    given = (action, None, following["observation"])
                    if params is loss.qvalue_network_params:
                        given = agents["action"], None, agents["observation"]
                    values.append(critic(*given))
        target = following["reward"] + 0.5 * torch.minimum(values[0], values[1])
        wanted = sum((value - target).square() for value in values[2:])
    computed = learner.losses(batch)["critic"].detach()
    torch.testing.assert_close(computed, wanted.mean(0)[:, 0], rtol=1e-4, atol=1e-4)


def test_actors_follow_the_value_of_their_actions(monkeypatch):
    learner, batch = smoothed(monkeypatch)
    loss, observation = learner.loss, batch["agents", "observation"]
    with torch.no_grad():
        with loss.actor_network_params.to_module(loss.actor_network):
            action = loss.actor_network.actor.module(observation)
        with loss.qvalue_network_params[0].to_module(loss.qvalue_network):
            value = loss.qvalue_network.module(action, None, observation)
    actual = learner.losses(batch)["actor"].detach()
    torch.testing.assert_close(actual, -value.mean(0)[:, 0], rtol=1e-4, atol=1e-4)
