"""Tests that NaN or Inf ends a training with its place, and that nothing is saved over."""

import pytest
import torch
from refusal import refused
from test_resume import REPLAY, begun

from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.trainer import NonFiniteError, Trainer

BAD = {"NaN": torch.nan, "Inf": torch.inf}


def spoil(trainer: Trainer, where: str, step: int, value: float) -> None:
    """Makes a number of a training non-finite at a step."""
    learn = trainer.setup.learn

    def learns(rollout):
        losses = learn(rollout)
        if trainer.setup.step == step and where == "loss":
            losses[-1]["critic"][0] = value
        if trainer.setup.step == step and where == "weight":
            with torch.no_grad():
                next(iter(trainer.setup.learner.actor.parameters())).view(-1)[0] = value
        return losses

    trainer.setup.learn = learns


@pytest.mark.parametrize("kind", BAD)
@pytest.mark.parametrize("where", ["loss", "weight"])
def test_the_training_ends_and_the_last_checkpoint_stays(where, kind, tmp_path):
    trainer = begun("independent", tmp_path, *REPLAY, "checkpoint_steps=10")
    spoil(trainer, where, 20, BAD[kind])
    with pytest.raises(NonFiniteError) as caught:
        trainer.train()
    trainer.close()
    said, run = str(caught.value), trainer.run
    assert f"at step {20}; the last good checkpoint is {run.newest}, of step 10" in said
    assert ("loss critic is " in said) == (where == "loss")
    assert run.step() == 10
    resume(run.path).close()


def test_the_command_ends_with_one_line(tmp_path, capsys):
    # With this rate the weights leave the range of float32 after some updates.
    wild = ["learner.actor_lr=1e30", "learner.critic_lr=1e30", "env.horizon=40", "episodes=2"]
    arguments = [*REPLAY, *wild, "num_envs=2", f"output={tmp_path}"]
    assert resolve("independent", arguments)
    refused(["train", "independent", *arguments], capsys, "there is no checkpoint")
