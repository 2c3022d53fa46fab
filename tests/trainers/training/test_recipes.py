"""Tests all recipes under all three setups: a short training and its files."""

import json
import math

import pytest
import torch

from emberlink.envs import keys, metrics
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.evaluation.policy import load_actor
from emberlink.trainers.runs.checkpoint import read_header
from emberlink.trainers.runs.run_folder import BEST, RunFolder
from emberlink.trainers.training.trainer import Trainer

METHODS = ["independent", "shared_memory", "positional", "consensus"]
SETUPS = ["paper", "released", "tuned"]
EPISODES, HORIZON, ENVS, BATCH = 2, 20, 2, 24


def short(method: str, output, *more: str, setup: str = "paper", seed: int = 0):
    return resolve(
        method,
        [
            *(f"setup={setup}", f"seed={seed}", f"output={output}"),
            *(f"episodes={EPISODES}", f"env.horizon={HORIZON}", f"num_envs={ENVS}"),
            *(f"learner.batch_size={BATCH}", "learner.hidden=[32,32]", "evaluation.interval=0"),
            *more,
        ],
    )


def trained(config) -> Trainer:
    trainer = Trainer(config)
    trainer.start()
    trainer.train()
    return trainer


def _marks(method: str, setup: str) -> list[pytest.MarkDecorator]:
    """Returns the marks of a recipe: the convolutions of `maps` take long."""
    if method == "maps" and setup != "tuned":
        return [pytest.mark.heavy]
    return [pytest.mark.slow] if setup != "paper" else []


@pytest.mark.parametrize(
    ("method", "setup"),
    [
        pytest.param(method, setup, marks=_marks(method, setup))
        for setup in SETUPS
        for method in [*METHODS, "maps"]
    ],
)
def test_a_recipe_trains(method, setup, tmp_path):
    pixels = ["env.map.pixels=8"] if method == "maps" else []
    config = short(method, tmp_path, "policy.hold=1", *pixels, setup=setup)
    trainer = Trainer(config)
    initial = networks(trainer)
    trainer.start()
    seen = []
    trainer.train(lambda progress: seen.append((progress.step, progress.episode)))
    assert seen == [(step, step // HORIZON) for step in range(1, EPISODES * HORIZON + 1)]

    run = trainer.run
    assert list(tmp_path.iterdir()) == [run.path]
    assert RunFolder(run.path).config() == config
    assert run.values()["seed"] == config.seed
    check_lines(run, config)
    pictures = 12 if method == "maps" else 0  # two pictures, three convolutions each
    # actor and critic, and the target of each
    assert len(initial) == 2 * (10 + 12 + 2 * pictures)
    for name, weight in networks(trainer).items():
        assert weight.isfinite().all(), name
        assert not weight.equal(initial[name]), name
    check_actor(run, config, trainer)


def networks(trainer: Trainer) -> dict[str, torch.Tensor]:
    """Returns the weights of actors, critics and their targets."""
    state = trainer.setup.learner.loss.state_dict()
    return {name: weight.clone() for name, weight in state.items() if "module" in name}


def check_lines(run: RunFolder, config) -> None:
    """Checks that metrics.jsonl has one complete line per episode and the number of updates."""
    text = (run.path / "metrics.jsonl").read_text()
    lines = [json.loads(line) for line in text.splitlines()]
    assert len(lines) == EPISODES
    shared = config.replay == "shared"
    rows = math.ceil(BATCH / config.env.num_uavs) if shared else BATCH
    without = math.ceil(rows / ENVS) - 1
    for episode, line in enumerate(lines, start=1):
        assert line["episode"] == episode
        assert line["updates"] == episode * HORIZON - without
        assert line.keys() >= {*metrics.NAMES, "loss_actor", "loss_critic"}
        assert all(math.isfinite(value) for value in line.values())
        assert 0 <= line["coverage"] <= 100
        assert 1 <= line["tracking_first"] <= line["tracking_last"] <= HORIZON


def check_actor(run: RunFolder, config, trainer: Trainer) -> None:
    """Checks that the checkpoint's actor equals the trained actor."""
    assert run.step() == EPISODES * HORIZON
    loaded = load_actor(config, run.newest)
    rollout = trainer.setup.env.rollout(5, trainer.setup.learner.actor)
    for step in range(5):
        observed = keys.observation_keys(trainer.setup.env.observation_spec)
        again = loaded(rollout[:, step].select(*observed))
        assert again[keys.ACTION].equal(rollout[:, step][keys.ACTION])
    assert rollout[keys.ACTION].abs().max() > 0


def test_evaluations_and_checkpoints_follow_their_intervals(tmp_path, monkeypatch):
    saved, save = [], Trainer.save
    monkeypatch.setattr(Trainer, "save", lambda self: saved.append(self.setup.step) or save(self))
    config = short(
        "consensus",
        tmp_path,
        *("episodes=5", "env.horizon=20", "checkpoint_interval=2"),
        *("evaluation.interval=2", "evaluation.interval_episodes=2"),
    )
    run = trained(config).run
    frozen = {f"{fire}/{name}" for fire in ("huygens", "paper") for name in metrics.NAMES}
    for line in run.metrics():
        assert line.keys() & frozen == (frozen if line["episode"] in (2, 4) else set())
    assert saved == [40, 80, 100]
    held_out = {episode: run.metrics()[episode - 1] for episode in (2, 4)}
    coverage = {
        episode: (line["huygens/coverage"] + line["paper/coverage"]) / 2
        for episode, line in held_out.items()
    }
    best = read_header(run.path / BEST)
    assert best.best == max(coverage.values())
    assert best.step == 20 * max(coverage, key=lambda episode: coverage[episode])
    assert {path.name for path in run.path.iterdir()} == {
        *("config.yaml", "metrics.jsonl", "checkpoint.safetensors", BEST, "lock")
    }
