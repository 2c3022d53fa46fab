"""Tests imitation of map_greedy by the UAVs' maps, and trainings that begin with its actors."""

import math
from typing import Any

import pytest
import torch
from refusal import refused
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from emberlink.envs import keys
from emberlink.envs.world.sensor import search_altitude
from emberlink.policies.gaussian import MEMORY
from emberlink.policies.scripted.map_greedy import MapGreedy
from emberlink.trainers.build import build_env
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.learners.base import ACTOR
from emberlink.trainers.learners.imitation import Mixture
from emberlink.trainers.training.setup import TrainingSetup
from emberlink.trainers.training.trainer import Trainer

WORLD = [
    *("world=front", "env.num_uavs=3", "num_envs=2", "fire.num_train_fires=2"),
    "env.grid=[30,30]",
]
SHORT = [
    *("env.horizon=20", "episodes=4", "learner.hidden=[8,8]"),
    *("evaluation.interval=0", "evaluation.episodes=1", "evaluation.scripted=[]"),
    *("env.map.pixels=8", "policy.hold=2"),
]
TINY = ["learner.samples=4", "learner.buffer_size=60"]
GRU = ["policy.memory=gru", "policy.units=4", "learner.sequence=3"]
OFF_POLICY = ["learner.batch_size=4", "learner.buffer_size=60", "learner.share_parameters=true"]


def settings(learner: str, *more: str) -> list[str]:
    return ["setup=tuned", *WORLD, *SHORT, f"learner={learner}", *more]


def taught(hold: int, *more: str):
    config = resolve("maps", [*WORLD, f"policy.hold={hold}", "env.horizon=120", *more])
    fire = torch.full((30, 30), math.inf)
    fire[8:20, 9:21] = 3 * torch.rand(12, 12, generator=torch.Generator().manual_seed(0))
    times = torch.stack((fire, fire + 60))[None].repeat(2, 1, 1, 1)
    return build_env(config, num_envs=2, fire=times, seed=5, device="cpu", teacher="map_greedy")


@pytest.mark.parametrize("radio", ["env.radio.range=0", "env.radio.delay=119"])
def test_without_messages_the_teacher_is_map_greedy(radio):
    env = taught(1, radio)
    policy = MapGreedy(env.base_env)
    td = env.reset()
    for step in range(60):
        acted = policy(td.clone())
        assert td[keys.TEACHER].equal(acted[keys.ACTION]), step
        assert td[keys.TEACHER].any()
        acted = env.step(acted)
        td = acted["next"].set(policy.TARGET, acted[policy.TARGET])


def test_the_teacher_reads_the_maps_of_the_uavs_alone():
    env = taught(1)
    td = env.reset()
    for _ in range(25):
        td = env.step(td.set(keys.ACTION, td[keys.TEACHER]))["next"]
    teacher, maps = env.transform[1], env.transform[0].module.maps
    before = teacher._teach(td.clone(), None)[keys.TEACHER]
    for name, value in env.base_env.state_dict().items():
        value.zero_()
        assert name
    assert teacher._teach(td.clone(), None)[keys.TEACHER].equal(before)
    maps.known.last_seen.fill_(-1)
    due = td.clone().set(keys.STEP, torch.full((2,), 30))
    after = teacher._teach(due, None)[keys.TEACHER]
    assert not after.equal(before)


def test_held_actions_end_at_the_target():
    env = taught(10)
    height = search_altitude(env.base_env.config)
    td = env.reset()
    for _ in range(3):
        action, target = td[keys.TEACHER], env.transform[1].target.clone()
        start = td[keys.POSITION]
        for _ in range(10):
            td = env.step(td.set(keys.ACTION, action))["next"]
        moved = td[keys.POSITION] - start
        wanted = torch.cat((target - start[..., :2], height - start[..., 2:]), -1)
        near = wanted.abs().amax(-1) <= 2  # cells flown in ten steps
        torch.testing.assert_close(moved[near], wanted[near], atol=1e-4, rtol=0)
        assert (moved[~near].abs().amax(-1) - 2).abs().max() < 1e-4


def made(*more: str) -> Any:
    return TrainingSetup(resolve("maps", settings("imitation", *TINY, *more)))


def test_the_share_of_the_teacher_and_the_learning_rate_fall_to_zero():
    setup = made("learner.teacher_share=0.8", "learner.lr=0.1", "learner.sequence=3")
    learner, shares, rates = setup.learner, [], []
    for _ in range(4):
        setup.dry_run(20)
        shares.append(learner.explorer.share)
        rates.append(learner.optimizer.param_groups[0]["lr"])
    assert shares == pytest.approx([0.6, 0.4, 0.2, 0])
    assert rates == pytest.approx([0.075, 0.05, 0.025, 0])


def test_a_memory_learns_from_sequences_that_begin_with_its_state():
    """Ten decisions of an episode are stored as 3 + 3 + 3 + 1; none is stored twice."""
    setup = made(*GRU, "env.failures=2", "learner.buffer_size=600")
    learner, rollouts, rows = setup.learner, [], []
    learn, extend = learner.learn, learner.replay.extend
    learner.learn = lambda rollout: rollouts.append(rollout.clone()) or learn(rollout)
    learner.replay.extend = lambda new: rows.append(new.clone()) or extend(new)
    setup.dry_run(20)
    flight = torch.cat(rollouts, 1)[keys.AGENTS]
    assert [row["alive"].shape for row in rows] == [(2, 3, 3)] * 4
    for number, row in enumerate(rows):
        first, count = 3 * number, min(3, 10 - 3 * number)
        for k in range(count):
            for name in ("observation", "crops", "teacher", "alive"):
                assert row[name][:, :, k].equal(flight[name][:, first + k]), name
        assert not row["alive"][:, :, count:].any()
        assert row["memory"].equal(flight["memory"][:, first])
    assert rows[1]["memory"].any()
    assert not rows[0]["memory"].any()
    for _ in range(3):
        setup.dry_run(20)
    assert len(learner.replay) == learner.replay.written == 4 * 4 * 2
    batch = learner.replay.sample()
    total, weight = torch.zeros(3), torch.zeros(3)
    for entry in range(len(batch)):
        state = batch["memory"][[entry]]
        for k in range(3):
            now = [batch[name][[entry], :, k] for name in ("observation", "crops")]
            mean, state = learner.actor.module.step(now, state)
            taught, flew = batch["teacher"][entry, :, k], batch["alive"][entry, :, k].float()
            loss = torch.nn.functional.smooth_l1_loss(mean[0], taught, reduction="none").mean(-1)
            total, weight = total + loss * flew, weight + flew
    expected = total / weight.clamp(min=1)
    torch.testing.assert_close(learner.losses(batch)["imitation"], expected)
    assert MEMORY in learner.explorer.in_keys


class Still(TensorDictModuleBase):
    """A student that does not move."""

    in_keys, out_keys = [keys.TEACHER], [keys.ACTION]

    def forward(self, tensordict):
        return tensordict.set(keys.ACTION, torch.zeros_like(tensordict[keys.TEACHER]))


def test_each_uav_takes_the_action_of_the_teacher_with_the_same_probability():
    mixture, envs = Mixture(Still(), torch.Generator().manual_seed(0)), 8000
    mixture.share = 0.3
    taken = mixture(TensorDict({keys.TEACHER: torch.ones(envs, 3, 3)}, [envs]))
    taken = taken[keys.ACTION].mean(-1)
    assert taken.unique().tolist() == [0, 1]
    assert taken.mean().item() == pytest.approx(0.3, abs=0.02)
    assert (torch.corrcoef(taken.T) - torch.eye(3)).abs().max() < 0.05


@pytest.fixture(scope="module")
def imitated(tmp_path_factory):
    """Trains actors for each kind of learner and returns the run folders."""
    runs = {}
    for name in ("ippo", "ddpg"):
        folder = tmp_path_factory.mktemp(name)
        more = [*TINY, f"learner.actor_of={name}", f"output={folder}"]
        assert main.main(["train", "maps", *settings("imitation", *more)]) == 0
        (runs[name],) = folder.iterdir()
    return runs


def started(config) -> Trainer:
    trainer = Trainer(config)
    trainer.start()
    trainer.close()
    return trainer


@pytest.mark.slow
@pytest.mark.parametrize(
    ("learner", "more"), [("ippo", ["learner.log_std=-1.5"]), ("ddpg", OFF_POLICY)]
)
def test_a_run_begins_with_the_actors_of_another(learner, more, imitated, tmp_path):
    start = [f"learner.warm_start={imitated[learner]}", f"output={tmp_path / 'runs'}"]
    config = resolve("maps", settings(learner, *more, *start))
    mine, others = (started(config).setup.learner.weights() for _ in range(2))
    fresh = TrainingSetup(resolve("maps", settings(learner, *more))).learner.weights()
    for name, value in others.items():
        assert mine[name].equal(value), name
        if name != ACTOR + "log_std" and value.ndim > 2:
            assert not mine[name].equal(fresh[name]), name
    if learner == "ippo":
        assert (mine[ACTOR + "log_std"] == -1.5).all()


@pytest.mark.slow
@pytest.mark.parametrize("change", ["learner.hidden=[8]", "env.map.pixels=24", "policy.memory=gru"])
def test_actors_that_do_not_fit_are_refused(change, imitated, tmp_path, capsys):
    start = f"learner.warm_start={imitated['ippo']}", change, f"output={tmp_path}"
    refused(["train", "maps", *settings("ippo", *start)], capsys, "learner.warm_start=")
    assert not list(tmp_path.iterdir())
