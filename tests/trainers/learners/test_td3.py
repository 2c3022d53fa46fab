"""Tests of every learner with every method, observation and sharing of weights."""

import json
from importlib.metadata import EntryPoint
from typing import Any, cast

import pytest
import torch
from tensordict.nn import TensorDictModule
from test_recipes import METHODS

from emberlink.configs import entry_points
from emberlink.envs.utils.errors import UserError
from emberlink.policies.settings import PolicyConfig
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import (
    from_values,
    resolve,
    to_values,
)
from emberlink.trainers.learners import registry
from emberlink.trainers.learners.base import Learner
from emberlink.trainers.learners.ddpg import DDPG
from emberlink.trainers.learners.ippo import IPPO
from emberlink.trainers.learners.mappo import MAPPO
from emberlink.trainers.learners.td3 import TD3
from emberlink.trainers.training.setup import TrainingSetup
from emberlink.trainers.training.trainer import Trainer

SMALL = [
    *("env.horizon=15", "env.num_uavs=3", "num_envs=2", "episodes=2"),
    *("learner.hidden=[8,8]", "evaluation.interval=0", "evaluation.episodes=1"),
]
LEARNERS = {
    "ddpg": ["learner=ddpg", "learner.batch_size=8"],
    "ippo": ["learner=ippo", "policy.memory=gru"],
    "mappo": ["learner=mappo", "policy.memory=gru"],
    "td3": ["learner=td3", "learner.batch_size=8"],
}


def made(learner: str, *more: str, method: str = "consensus") -> TrainingSetup:
    return TrainingSetup(resolve(method, [*LEARNERS[learner], *SMALL, *more]))


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("hidden", [[8], [8, 6, 4]])
def test_networks_may_have_one_hidden_layer_or_several(learner, hidden):
    setup = made(learner, f"learner.hidden={hidden}")
    setup.dry_run(steps=15)
    assert setup.learner.updates > 0
    assert not setup.guard.poll(wait=True)


def test_learners_are_the_files_on_disk():
    # test_imitation.py tests imitation, which has no critic and needs the maps of its method.
    assert registry.known() == sorted([*LEARNERS, "imitation"])
    assert [registry.find(name) for name in LEARNERS] == [DDPG, IPPO, MAPPO, TD3]
    with pytest.raises(
        UserError, match=r"'sac' is not known; known: ddpg, imitation, ippo, mappo, td3"
    ):
        registry.find("sac")


STRONG = ["setup=strong", "env.horizon=20"]


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("method", "settings"),
    [
        *((method, LEARNERS[name]) for name in ("td3", "ippo", "mappo") for method in METHODS),
        *((method, STRONG) for method in [*METHODS, "maps"]),
    ],
)
def test_a_short_run_learns_and_evaluates(method, settings, tmp_path, capsys):
    """The same for ddpg is in test_recipes and test_cli."""
    arguments = ["train", method, *SMALL, *settings, f"output={tmp_path}"]
    assert main.main(arguments) == 0
    (run,) = tmp_path.iterdir()
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert len(lines) == 2
    assert lines[-1].keys() >= {"loss_actor", "loss_critic", "coverage"}
    before = json.loads((run / "eval.json").read_text())["results"]
    assert main.main(["eval", str(run)]) == 0
    assert json.loads((run / "eval.json").read_text())["results"] == before
    capsys.readouterr()


@pytest.mark.slow
@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("more", [[], ["env.observation=window"], ["seeds=[1,2]"]])
def test_all_uavs_of_a_seed_share_their_weights(learner, more, tmp_path):
    settings = [*LEARNERS[learner], *SMALL, "learner.share_parameters=true", *more]
    config = resolve("consensus", [*settings, f"output={tmp_path}"])
    trainer = Trainer(config)
    initial = {name: w.clone() for name, w in trainer.setup.learner.weights().items()}
    trainer.start()
    assert trainer.train()
    layer = "hidden.1" if learner in ("ippo", "mappo") else "second"
    name = f"actor_network_params.module.{layer}.weight"
    weights = trainer.setup.learner.weights()
    assert weights[name].shape[0] == 1
    assert not weights[name].equal(initial[name])
    state = trainer.setup.state_dict()
    again = TrainingSetup(config)
    again.load_state_dict({key: value.clone() for key, value in state.items()}, 30)
    for key, value in again.state_dict().items():
        assert value.numpy().tobytes() == state[key].numpy().tobytes(), key


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_configuration_keeps_its_learner(learner):
    config = resolve("consensus", [f"learner={learner}", "learner.gamma=0.5"])
    assert type(config.learner) is registry.find(learner).config_type
    assert config.learner.gamma == 0.5
    assert from_values(to_values(config)) == config


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"hidden": [8, 8]}, "learner.name is missing; known: ddpg, imitation"),
        ({"name": "sac"}, "learner.name='sac' is not known; known: ddpg, imitation"),
        ({"policy_delay": 3}, "learner.policy_delay is not a setting of ddpg"),
        ({"gamma": 2.0}, "learner.gamma=2.0: should be less than 1"),
    ],
)
def test_invalid_settings_of_a_learner(values, message):
    plain = to_values(resolve("consensus"))
    learner = values if "hidden" in values else {**plain["learner"], **values}
    with pytest.raises(UserError) as error:
        from_values({**plain, "learner": learner})
    assert str(error.value).startswith(message)


def test_another_package_can_add_a_learner(monkeypatch):
    group = "emberlink.learners"
    point = EntryPoint("mine", "emberlink.trainers.learners.td3:TD3", group)
    monkeypatch.setattr(entry_points, "read", lambda of: (point,) if of == group else ())
    assert registry.known() == ["ddpg", "imitation", "ippo", "mappo", "mine", "td3"]
    assert registry.find("mine") is TD3


def test_networks_of_seeds_that_cannot_be_told_apart_are_refused():
    class Own:
        actor = TensorDictModule(torch.nn.Linear(2, 2), in_keys=["a"], out_keys=["b"])

    assert Learner.team_actor(cast(Any, Own()), 0, 1) is Own.actor
    with pytest.raises(UserError, match="Own trains one seed at a time"):
        Learner.team_actor(cast(Any, Own()), 0, 2)


def test_a_learner_without_a_memory_refuses_one():
    config: Any = resolve("consensus")
    spec: Any = None
    with pytest.raises(UserError, match=r"the networks of learner=ddpg have none"):
        Learner.make_actor(config.learner, spec, spec, policy=PolicyConfig(memory="gru"))


def test_td3_delays_the_actors_and_all_targets():
    setup = made("td3", "learner.policy_delay=3")
    learner = setup.learner
    rollouts = iter(setup.collector)
    moved = []
    while learner.updates < 7:
        before = {name: value.clone() for name, value in learner.weights().items()}
        updates = learner.updates
        setup.learn(next(rollouts))
        if learner.updates > updates:
            after = learner.weights()
            changed = {name for name, value in after.items() if not value.equal(before[name])}
            assert any(name.startswith("qvalue") for name in changed)
            moved.append({name.partition("_network")[0] for name in changed})
    critics = {"qvalue"}
    every = {"actor", "qvalue", "target_actor", "target_qvalue"}
    assert moved == [critics, critics, every, critics, critics, every, critics]


def test_td3s_target_noise_is_clipped_and_seeded():
    """The noise of a seed is the same in a stack and alone, for any global generator."""
    options = "learner.target_noise=0.4", "learner.target_noise_clip=0.5", "learner.batch_size=512"
    key = "next", "agents", "target_noise"
    noise = {}
    for seeds in ("seeds=[3,4]", "seeds=[4]"):
        torch.manual_seed(len(seeds))
        setup = made("td3", *options, seeds)
        setup.learner.replay.extend(next(iter(setup.collector)))
        noise[seeds] = setup.learner.sample()[key]
    stacked, alone = noise["seeds=[3,4]"], noise["seeds=[4]"]
    assert stacked.shape == (512, 6, 3)
    assert stacked[:, 3:].equal(alone)
    assert stacked.abs().max() == 0.5
    inner = stacked[stacked.abs() < 0.5]
    assert inner.std().item() == pytest.approx(0.27, abs=0.02)  # share of N(0, 0.4) within 0.5
    assert not stacked[:, :3].equal(alone)


def test_td3s_target_is_the_lower_of_two_critics_at_the_smoothed_action():
    setup = made("td3", "learner.gamma=0.5")
    learner = setup.learner
    setup.dry_run(12)
    batch = learner.sample()
    rows, loss = len(batch), learner.loss
    following = batch["next", "agents"]
    with torch.no_grad():
        with loss.target_actor_network_params.to_module(loss.actor_network):
            network = loss.actor_network.actor.module
            action = (network(following["observation"]) + following["target_noise"]).clamp(-1, 1)
        values = []
        for params in (loss.target_qvalue_network_params, loss.qvalue_network_params):
            for k in range(2):
                with params[k].to_module(loss.qvalue_network):
                    critic = loss.qvalue_network.module
                    agents = batch["agents"]
                    given = (following["observation"], action)
                    if params is loss.qvalue_network_params:
                        given = agents["observation"], agents["action"]
                    values.append(critic(*given))
        target = following["reward"] + 0.5 * torch.minimum(values[0], values[1])
        wanted = sum((value - target).square() for value in values[2:])
    computed = learner.losses(batch)["critic"].detach()
    assert rows == 8
    torch.testing.assert_close(computed, wanted.mean(0)[:, 0], rtol=1e-4, atol=1e-4)


def test_td3s_actors_follow_the_value_of_their_actions():
    setup = made("td3", "learner.gamma=0.5")
    setup.dry_run(12)
    learner: Any = setup.learner
    batch, loss = learner.sample(), learner.loss
    observation = batch["agents", "observation"]
    with torch.no_grad():
        with loss.actor_network_params.to_module(loss.actor_network):
            action = loss.actor_network.actor.module(observation)
        with loss.qvalue_network_params[0].to_module(loss.qvalue_network):
            value = loss.qvalue_network.module(observation, action)
    actual = learner.losses(batch)["actor"].detach()
    torch.testing.assert_close(actual, -value.mean(0)[:, 0], rtol=1e-4, atol=1e-4)
