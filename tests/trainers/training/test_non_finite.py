"""Tests that a non-finite value ends training with a report, or rolls training back."""

import functools
import json
import math
import re
import shutil
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from test_recipes import METHODS
from test_resume import assert_same, until

from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError
from emberlink.envs.wildfire import WildfireEnv
from emberlink.policies.gaussian import MemoryActor
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.evaluation import evaluate
from emberlink.trainers.learners.anchor import Anchor
from emberlink.trainers.learners.ddpg import DDPG
from emberlink.trainers.learners.nan_guard import NonFiniteGuard, row_norms
from emberlink.trainers.learners.off_policy import OffPolicyLearner
from emberlink.trainers.learners.on_policy import OnPolicyLearner
from emberlink.trainers.learners.td3 import TD3
from emberlink.trainers.rollout.finite_actions import NonFiniteActionError
from emberlink.trainers.runs import checkpoint_file
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.training import non_finite
from emberlink.trainers.training.non_finite import NonFiniteError, NonFiniteReport, replay
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.trainer import Trainer

HORIZON, UAVS, ENVS, BATCH = 20, 3, 2, 16
STEP, UAV, ENV = 33, 1, 1
SMALL = [
    *(f"env.horizon={HORIZON}", "episodes=3", f"env.num_uavs={UAVS}", f"num_envs={ENVS}"),
    *("learner.hidden=[8,8]", f"learner.batch_size={BATCH}", "checkpoint_steps=10"),
    *("evaluation.interval=0", "evaluation.episodes=1"),
]
PLACES = ["observation", "reward", "gradient", "weight"]
LEARNERS = {"ddpg": DDPG, "td3": TD3, "ippo": OnPolicyLearner, "mappo": OnPolicyLearner}
SEQUENCES = ["learner.sequence=4", "learner.burn_in=2"]
GRU, STACK = ["policy.memory=gru"], ["policy.memory=stack"]


resolved = functools.cache(resolve)


def begun(method: str, output: Path, *more: str) -> Trainer:
    whole_episodes = {"learner=ippo", "learner=mappo"} & {*more}
    own = [text for text in SMALL if not (whole_episodes and "batch_size" in text)]
    config = resolved(method, (*own, *more))
    trainer = Trainer(replace(config, output=str(output)))
    trainer.start()
    return trainer


def update_at(step: int, method: str) -> int:
    """Returns the index of the update that follows a step."""
    shared = resolved(method, tuple(SMALL)).replay == "shared"
    needed = math.ceil(BATCH / UAVS) if shared else BATCH
    return step - math.ceil(needed / ENVS) + 1


class Poison:
    """Injects NaN into one value of a training at `STEP` by patching the classes.

    Attributes:
        always: whether updates with another index, such as that of a replay, are patched too.
    """

    def __init__(
        self, monkeypatch, place: str, method="consensus", env=ENV, uav=UAV, learner="ddpg"
    ):
        self.monkeypatch, self.update = monkeypatch, update_at(STEP, method)
        self.env, self.uav, self.learner = env, uav, LEARNERS[learner]
        self.critic = "critic" if learner == "ddpg" else "qvalue"
        self.always, self.visits, self.updates = False, Counter(), Counter()
        getattr(self, place)()

    def observation(self) -> None:
        snapshot = WildfireEnv._snapshot

        def poisoned(world, *given):
            now = snapshot(world, *given)
            if self.is_due(world, now[keys.STEP]):
                now[keys.OBSERVATION][self.env, self.uav % UAVS, 4] = math.nan
            return now

        self.monkeypatch.setattr(WildfireEnv, "_snapshot", poisoned)

    def reward(self) -> None:
        step = WildfireEnv._step

        def poisoned(world, tensordict):
            after = step(world, tensordict)
            if self.is_due(world, world._time):
                after[keys.REWARD][self.env, self.uav % UAVS] = -math.inf
            return after

        self.monkeypatch.setattr(WildfireEnv, "_step", poisoned)

    def memory(self) -> None:
        """Changes the state of a memory before the decision of the step."""
        state = MemoryActor._state

        def poisoned(actor, tensordict):
            before = state(actor, tensordict)
            if self.is_due(actor, tensordict[keys.STEP] + 1):
                before[self.env, self.uav, 2] = math.nan
            return before

        self.monkeypatch.setattr(MemoryActor, "_state", poisoned)

    def gradient(self) -> None:
        """Adds a term of value 0 to the critic's loss, whose derivative is NaN."""

        def change(learner, losses) -> None:
            weight = learner.parameters["critic.second.weight"]
            weight = weight[self.uav] if learner.critic_name == "value" else weight[:, self.uav]
            losses["critic"] = losses["critic"] + (0 * weight).sum().sqrt()

        self.in_losses(change)

    def loss(self) -> None:
        def change(_, losses) -> None:
            uavs = torch.arange(len(losses["critic"]))
            losses["critic"] = losses["critic"].masked_fill(uavs == self.uav, math.nan)

        self.in_losses(change)

    def in_losses(self, change) -> None:
        original = self.learner.losses

        def poisoned(learner, batch, *, actor=True):
            losses = original(learner, batch, actor=actor)
            self.updates[learner] += 1
            if self.always or self.updates[learner] == self.update:
                change(learner, losses)
            return losses

        self.monkeypatch.setattr(self.learner, "losses", poisoned)

    def weight(self) -> None:
        original = OffPolicyLearner._update

        def poisoned(learner, batch, actor):
            losses = original(learner, batch, actor)
            self.updates[learner] += 1
            if self.updates[learner] == self.update:
                with torch.no_grad():
                    learner.parameters["actor.second.weight"][self.uav, 2, 3] = math.nan
            return losses

        self.monkeypatch.setattr(OffPolicyLearner, "_update", poisoned)

    def is_due(self, world, time) -> bool:
        """Checks whether an environment is at `STEP`; its step counter restarts each episode."""
        self.visits[world, int(time[0])] += 1
        return int(time[0]) == STEP % HORIZON and self.visits[world, STEP % HORIZON] == 2


EXPECTED = {
    "observation": {"tensor": "observation", "environment": ENV, "value": "nan"},
    "reward": {"tensor": "reward", "environment": ENV, "value": "-inf"},
    "memory": {"tensor": "action", "environment": ENV, "value": "nan"},
    "gradient": {"tensor": "gradient of critic.second.weight", "value": "nan"},
    "loss": {"tensor": "critic's loss", "value": "nan"},
    "weight": {"tensor": "action", "environment": 0, "value": "nan"},
}


def expected(place: str, method: str = "consensus", learner: str = "ddpg", **more) -> dict:
    whole = {"uav": UAV, "seed": 0, "environment": None, "step": STEP, "update": None}
    whole |= EXPECTED[place] | more
    if place in ("gradient", "loss"):
        whole["update"] = update_at(STEP, method)
    if place == "weight":
        whole["step"] = STEP + 1  # the first consequence: the actor's next action
    if learner == "td3" and place == "gradient":
        whole["tensor"] = "gradient of critic_1.second.weight"
    if place == "observation" and method == "positional":
        whole["uav"] = 0  # the first UAV that hears it
    return whole


def diverged(trainer: Trainer) -> NonFiniteError:
    with pytest.raises(NonFiniteError) as caught:
        trainer.train()
    return caught.value


def check_report(report: NonFiniteReport, wanted: dict) -> None:
    assert asdict(report) == wanted


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """Returns a function that gives the state of an undisturbed run just before `STEP`."""
    states = {}

    def of(method: str, learner: str = "ddpg", *more: str) -> dict:
        key = method, learner, *more
        if key not in states:
            folder = tmp_path_factory.mktemp("clean")
            trainer = begun(method, folder, f"learner={learner}", *more)
            until(trainer, STEP - 1)
            header, state = checkpoint_file.read(trainer.run.states()[-1])
            assert header["step"] == STEP - 1
            states[key] = state
        return states[key]

    return of


def check_weights(dump: Path, wanted: dict) -> None:
    """Checks that networks and optimizers in a dump are those of a state, to the last bit."""
    _, weights = checkpoint_file.read(dump / "tensors.safetensors")
    names = [n for n in wanted if n.startswith(("learner/networks/", "learner/optimizer/"))]
    assert set(names) <= weights.keys()
    for name in names:
        assert weights[name].numpy().tobytes() == wanted[name].numpy().tobytes(), name


CASES = [
    *(("consensus", "ddpg", place, []) for place in PLACES),
    *((method, "ddpg", "observation", []) for method in METHODS if method != "consensus"),
    *(("consensus", "td3", place, []) for place in ("gradient", "loss")),
    pytest.param("consensus", "ddpg", "memory", [*GRU, *SEQUENCES], marks=pytest.mark.heavy),
    pytest.param("independent", "td3", "memory", [*STACK, *SEQUENCES], marks=pytest.mark.heavy),
    ("consensus", "ippo", "observation", GRU),
    ("independent", "ippo", "memory", [*GRU, "learner.share_parameters=false"]),
    ("shared_memory", "mappo", "reward", ["learner.critic_map=true"]),
    ("consensus", "mappo", "memory", STACK),
]


@pytest.mark.slow
@pytest.mark.parametrize(("method", "learner", "place", "more"), CASES)
def test_training_stops_and_names_the_value(
    method, learner, place, more, clean, tmp_path, monkeypatch
):
    before = clean(method, learner, *more)
    poison = Poison(monkeypatch, place, method, learner=learner)
    trainer = begun(method, tmp_path, f"learner={learner}", *more)
    error = diverged(trainer)
    report, wanted = error.report, expected(place, method, learner)
    check_report(report, wanted)
    assert f"{report.tensor} of UAV {report.uav}, seed 0" in str(error)
    assert f"step {report.step}" in str(error)
    dump = error.dump
    assert dump == trainer.run.path / f"divergence_step_{report.step}"
    assert {path.name for path in dump.iterdir()} == {
        *("tensors.safetensors", "config.yaml", "report.json")
    }
    assert RunFolder(dump).config() == trainer.config
    written = json.loads((dump / "report.json").read_text())
    assert NonFiniteReport(**written["report"]) == report
    # No update has used the value.
    if place != "weight":
        check_weights(dump, before)
    # The dump reproduces the value.
    poison.always = True
    assert replay(dump) == report
    poison.always = False
    if place == "gradient":
        assert replay(dump) is None
    # Earlier checkpoints are valid.
    assert [path.name for path in trainer.run.states()] == [
        "state_000000020.safetensors",
        "state_000000030.safetensors",
    ]
    again = resume(trainer.run.path)
    again.close()
    assert again.setup.step == 30
    assert all(value.isfinite().all() for value in again.setup.learner.weights().values())
    assert (trainer.run.path / "metrics.jsonl").read_text().count("\n") == 1


@pytest.mark.parametrize("place", ["observation", "reward", "gradient"])
def test_the_seed_of_the_value_is_named(place, tmp_path, monkeypatch):
    """The value is in the second seed's first environment, UAV 1."""
    Poison(monkeypatch, place, env=ENVS, uav=UAVS + UAV)
    trainer = begun("consensus", tmp_path, "seeds=[5,9]")
    error = diverged(trainer)
    more = {} if EXPECTED[place].get("environment") is None else {"environment": 0}
    check_report(error.report, expected(place, seed=9, **more))
    assert "seed 9" in str(error)
    assert error.dump.parent == trainer.runs[0].path
    if place != "gradient":
        assert replay(error.dump) == error.report


@pytest.mark.slow
@pytest.mark.parametrize("place", ["observation", "gradient", "loss"])
def test_a_late_poll_reports_the_same_value(place, clean, tmp_path, monkeypatch):
    """On a GPU the flags arrive some steps later. No update happens in between."""
    late, before = 3, clean("consensus")
    Poison(monkeypatch, place)
    seen: list[bool] = []

    def poll(guard: NonFiniteGuard, *, wait: bool = False) -> bool:
        seen.append(bool(guard.bad))
        return seen[-1] if wait else len(seen) > late and seen[-1 - late]

    monkeypatch.setattr(NonFiniteGuard, "poll", poll)
    trainer = begun("consensus", tmp_path)
    error = diverged(trainer)
    check_report(error.report, expected(place))
    assert trainer.setup.step == error.report.step + late
    check_weights(error.dump, before)


def test_no_checkpoint_contains_the_value(tmp_path, monkeypatch):
    """A checkpoint waits for the guard, even if it is polled late."""
    poll = NonFiniteGuard.poll
    monkeypatch.setattr(
        NonFiniteGuard, "poll", lambda guard, *, wait=False: wait and poll(guard, wait=True)
    )
    Poison(monkeypatch, "gradient")
    trainer = begun("consensus", tmp_path)
    check_report(diverged(trainer).report, expected("gradient"))
    assert trainer.setup.step == 40
    assert [path.stem[-3:] for path in trainer.run.states()] == ["020", "030"]
    assert len(trainer.run.lines()) == 1


def test_a_state_that_is_not_finite_is_not_saved(tmp_path):
    trainer = begun("consensus", tmp_path)
    until(trainer, 10)
    with torch.no_grad():
        trainer.setup.learner.parameters["critic.value.bias"][UAV] = math.inf
    with pytest.raises(NonFiniteError, match=r"value\.bias is inf at step 10; no checkpoint"):
        trainer.save()


def test_a_learning_rate_that_diverges(tmp_path):
    """Without injection, the squares of the weights overflow after one update."""
    trainer = begun("independent", tmp_path, "learner.critic_lr=1e25")
    error = diverged(trainer)
    assert error.report.update == 2
    assert replay(error.dump) == error.report


@pytest.mark.heavy
def test_the_command_prints_one_line(tmp_path, monkeypatch, capsys):
    Poison(monkeypatch, "reward")
    assert main.main(["train", "consensus", *SMALL, f"output={tmp_path}"]) == 2
    (run,) = tmp_path.iterdir()
    error = capsys.readouterr().err
    assert error == (
        f"emberlink train: reward of UAV 1, seed 0, environment 1, is -inf at step 33; "
        f"{run}/divergence_step_33 reproduces it; the last good checkpoint is "
        f"{run}/checkpoints/state_000000030.safetensors, resume with: emberlink train "
        f"resume={run} on_nan=rollback\n"
    )
    monkeypatch.undo()
    assert main.main(["train", f"resume={run}", "on_nan=rollback"]) == 0
    assert RunFolder(run).config().on_nan == "rollback"


def test_a_failed_dump_keeps_the_message(tmp_path, monkeypatch):
    Poison(monkeypatch, "reward")

    write = checkpoint_file.write

    def full(path, *rest):
        if path.parent.name.startswith("divergence"):
            raise UserError("no space left")
        write(path, *rest)

    monkeypatch.setattr(non_finite.checkpoint_file, "write", full)
    error = diverged(begun("consensus", tmp_path))
    assert "reward of UAV 1" in str(error)
    assert "its dump cannot be written: no space left" in str(error)
    assert error.dump is None


def diverging_above(monkeypatch, kind: type, update: int, share: float) -> None:
    """Makes a gradient NaN at an update while the learning rate is above a share of the first."""
    original, rates = kind.losses, []

    def poisoned(learner, *given, **named):
        losses = original(learner, *given, **named)
        if learner.updates == update:
            rates.append(learner.optimizer.param_groups[0]["lr"])
            if rates[-1] > share * rates[0]:
                weight = next(iter(learner.parameters.values()))
                losses["critic"] = losses["critic"] + (0 * weight).sum().sqrt()
        return losses

    monkeypatch.setattr(kind, "losses", poisoned)


def progress_of(trainer: Trainer) -> tuple[float, int, int]:
    """Returns scale of the learning rates, number of rollbacks, and steps."""
    return trainer.rollbacks.lr_scale, trainer.rollbacks.count, trainer.setup.step


ROLLBACK = ["on_nan=rollback", "setup=paper"]


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("learner", "more", "update", "to"),
    [
        ("ddpg", [], 21, 20),
        ("ddpg", ["seeds=[0,4]"], 21, 20),
        ("td3", [*GRU, *SEQUENCES], 21, 20),
        # Eight updates follow each episode, after its last step and before its checkpoint.
        ("ippo", [*GRU, "seeds=[0,4]"], 11, 30),
        ("mappo", ["learner.critic_map=true"], 11, 30),
    ],
)
def test_a_rollback_resumes_bit_for_bit(learner, more, update, to, tmp_path, monkeypatch):
    diverging_above(monkeypatch, LEARNERS[learner], update, 0.3)
    trainer = begun("consensus", tmp_path / "a", *ROLLBACK, f"learner={learner}", *more)
    rates = [group["lr"] for group in trainer.setup.learner.optimizer.param_groups]
    copy = tmp_path / "b"
    notes = []

    def watch(progress) -> None:
        if progress.note:
            notes.append(progress.note)
            if len(notes) == 1:  # the files equal those after a kill
                shutil.copytree(trainer.run.path.parent, copy)

    # Like `until`, keeps the final state of the training.
    train = trainer.train
    monkeypatch.setattr(trainer, "train", lambda report: train(lambda p: (watch(p), report(p))))
    until(trainer, None)
    assert progress_of(trainer) == (0.25, 0, 60)
    lowered = [group["lr"] for group in trainer.setup.learner.optimizer.param_groups]
    whole_episodes = learner in ("ippo", "mappo")  # the last of three has a third of the rate
    assert lowered == pytest.approx([rate / (12 if whole_episodes else 4) for rate in rates])
    assert len(notes) == 2
    assert f"rollback 2 of 5: on from step {to} with learning rates x 0.25" in notes[1]
    for run in trainer.runs:
        lines = (run.path / "rollbacks.jsonl").read_text().splitlines()
        assert [(json.loads(text)["to"], json.loads(text)["lr_scale"]) for text in lines] == [
            (to, 0.5),
            (to, 0.25),
        ]
        assert [line["episode"] for line in run.lines()] == [1, 2, 3]
        assert [line["episode"] for line in run.lines("timing.jsonl")] == [1, 2, 3]
    assert len(list(trainer.run.path.glob("divergence_step_*"))) == 2
    # Killed after the first rollback, and stopped after the second.
    resumed = resume(copy / trainer.run.path.name)
    assert progress_of(resumed) == (0.5, 1, to)
    until(resumed, 47)
    again = resume(resumed.run.path)
    # This checkpoint is after the failing step, so the count restarts.
    assert progress_of(again) == (0.25, 0, 47)
    assert_same(trainer, until(again, None))


def test_weights_are_checked_before_they_are_saved_and_evaluated(tmp_path, capsys):
    """The only update of the run makes weights whose squares are infinite."""
    tiny = ["env.horizon=20", "num_envs=2", "env.num_uavs=2", "episodes=1", "policy.hold=10"]
    own = ["learner=mappo", "learner.epochs=1", "learner.minibatches=1", "learner.lr=1e30"]
    command = ["train", "independent", *tiny, *own, "evaluation.interval=1", f"output={tmp_path}"]
    assert main.main(command) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert re.search(
        r"weight actor\S+, seed 0, is \d\S*e\+\d\d at step 20; its square is infinite", err
    )
    assert "on_nan=rollback" in err
    (folder,) = tmp_path.iterdir()
    assert not [*folder.rglob("*.safetensors"), *folder.glob("eval*")]
    assert not (folder / "metrics.jsonl").exists() or not (folder / "metrics.jsonl").read_text()


@pytest.mark.parametrize("on_nan", ["stop", "rollback"])
def test_an_action_of_a_validation_that_is_not_finite_ends_the_training(
    on_nan, tmp_path, monkeypatch
):
    def validate(*_: Any) -> dict:
        raise NonFiniteActionError("nan", 1, 0, 3)

    monkeypatch.setattr(evaluate, "validate", validate)
    more = ["evaluation.interval=1", "seeds=[4,5]", f"on_nan={on_nan}", "checkpoint_steps=0"]
    trainer = begun("independent", tmp_path, *more)
    with pytest.raises(NonFiniteError, match="; nothing was saved") as caught:
        trainer.train()
    said = str(caught.value)
    where = "action in the validation of UAV 1, seed 4, environment 0, is nan at step 20"
    assert said.startswith(where)
    assert ("given up after 5 rollbacks" in said) == (on_nan == "rollback")
    assert not any(run.lines() for run in trainer.runs)
    assert not [*tmp_path.rglob("*_000000020.safetensors")]


def test_an_action_of_the_last_evaluation_that_is_not_finite(tmp_path, monkeypatch, capsys):
    def fail(*_: Any, **__: Any) -> None:
        raise NonFiniteActionError("nan", 1, 0, 3)

    monkeypatch.setattr(evaluate, "evaluate", fail)
    assert main.main(["train", "independent", *SMALL, f"output={tmp_path}"]) == 2
    err = capsys.readouterr().err
    assert err.endswith(
        "action is nan for UAV 1 of environment 0 at step 3; expected finite numbers; the training "
        "has diverged: train a new run with smaller learning rates\n"
    )


def test_a_weight_with_an_infinite_square_is_named_with_its_seed_and_uav(tmp_path):
    trainer = begun("independent", tmp_path, "seeds=[4,5]")
    networks = trainer.setup.learner.networks()
    name = next(name for name, value in networks.items() if value.shape[:2] == (2 * UAVS, 6))
    with torch.no_grad():
        networks[name][4, 2] = 1e19
        non_finite.check(trainer.setup, trainer.run, wait=True)
        networks[name][4, 2, 1] = -2e19
    with pytest.raises(NonFiniteError) as caught:
        non_finite.check(trainer.setup, trainer.run, wait=True)
    where = f"weight {name} of UAV 1, seed 5, is -2e+19 at step 0"
    assert str(caught.value) == f"{where}; its square is infinite; nothing was saved"
    trainer.close()


def test_a_weight_of_a_second_critic_is_named_with_its_seed_and_uav(tmp_path):
    trainer = begun("independent", tmp_path, "seeds=[4,5]", "learner=td3")
    networks = trainer.setup.learner.networks()
    name = next(name for name, value in networks.items() if value.shape[:2] == (2, 2 * UAVS))
    with torch.no_grad():
        networks[name][1, 4] = torch.inf
    with pytest.raises(NonFiniteError, match=re.escape(f"weight {name} of UAV 1, seed 5, is inf")):
        non_finite.check(trainer.setup, trainer.run, wait=True)
    trainer.close()


@pytest.mark.heavy
def test_rollbacks_without_progress_end_the_training(tmp_path, monkeypatch, capsys):
    """The environment gives NaN before the first checkpoint."""
    step = WildfireEnv._step

    def poisoned(world, tensordict):
        after = step(world, tensordict)
        if int(world._time[0]) == 13:
            after[keys.REWARD] += math.nan
        return after

    monkeypatch.setattr(WildfireEnv, "_step", poisoned)
    command = ["train", "consensus", *SMALL, *ROLLBACK, "checkpoint_steps=0", f"output={tmp_path}"]
    assert main.main(command) == 2
    out, err = capsys.readouterr()
    assert err.count("\n") == 1
    assert "given up after 5 rollbacks, learning rates x 0.03125" in err
    assert "train a new run with smaller learning rates" in err
    assert "on_nan" not in err
    assert "rollback 1 of 5: on from step 0 with learning rates x 0.5" in out
    (folder,) = tmp_path.iterdir()
    assert len((folder / "rollbacks.jsonl").read_text().splitlines()) == 5
    assert {path.name for path in folder.glob("divergence*")} == {
        "divergence_step_13",
        *(f"divergence_step_13_{number}" for number in range(2, 7)),
    }
    again = resume(folder)
    assert progress_of(again) == (1 / 32, 5, 0)
    assert "given up" in str(diverged(again))
    # Once the environment is repaired, training resumes with the reduced learning rates.
    monkeypatch.undo()
    mended = resume(folder)
    assert mended.train()
    assert progress_of(mended)[:2] == (1 / 32, 0)


@pytest.mark.parametrize("value", ["nan", "off", "true"])
def test_settings_of_rollbacks(value, capsys):
    assert main.main(["train", "consensus", f"on_nan={value}"]) == 2
    assert "'stop' or 'rollback'" in capsys.readouterr().err


def test_gradient_norms_are_per_uav():
    generator = torch.Generator().manual_seed(0)
    tensors = [torch.randn(3, 4, 5, generator=generator), torch.randn(3, 1, 7, generator=generator)]
    wanted = [[math.sqrt(sum(x * x for x in uav.flatten().tolist())) for uav in t] for t in tensors]
    torch.testing.assert_close(torch.stack(row_norms(tensors)), torch.tensor(wanted))


@pytest.mark.parametrize(
    ("learner", "more", "weight"),
    [
        ("ippo", GRU, "output"),
        ("mappo", GRU, "network.output"),
        ("mappo", [*STACK, "learner.critic_map=true"], "network.output"),
    ],
)
def test_learners_from_whole_episodes_stop_and_name_the_value(
    learner, more, weight, tmp_path, monkeypatch
):
    """The third of the eight updates after the second episode has a gradient that is NaN."""
    original, bad, computed = OnPolicyLearner.losses, [11], []

    def poisoned(learner, batch):
        losses = original(learner, batch)
        if learner.updates in bad:
            computed.append(losses["critic"].detach())
            values = learner.parameters[f"critic.{weight}.weight"]
            losses["critic"] = losses["critic"] + (0 * values).sum().sqrt()
        return losses

    monkeypatch.setattr(OnPolicyLearner, "losses", poisoned)
    trainer = begun("consensus", tmp_path, f"learner={learner}", *more, "policy.hold=2")
    error = diverged(trainer)
    wanted = {"tensor": f"gradient of critic.{weight}.weight", "uav": None, "seed": 0}
    wanted |= {"environment": None, "step": 40, "update": 11, "value": "nan"}
    check_report(error.report, wanted)
    assert error.dump is not None
    assert replay(error.dump) == error.report
    torch.testing.assert_close(computed[0], computed[1])
    bad.clear()
    assert replay(error.dump) is None
    for value in trainer.setup.learner.weights().values():
        assert value.isfinite().all()
    again = resume(trainer.run.path)
    assert again.setup.step == 30
    again.close()


@pytest.mark.parametrize("learner", ["ddpg", "td3"])
@pytest.mark.parametrize("more", [GRU, STACK, ["learner.critic=team"]])
def test_the_update_of_a_sequence_or_a_team_can_be_repeated(learner, more, tmp_path, monkeypatch):
    """The gradient of UAV 1's critic is NaN in the ninth update."""
    kind, bad, computed = LEARNERS[learner], [9], []
    original = kind.losses

    def poisoned(learner, batch, **more):
        losses = original(learner, batch, **more)
        if learner.updates in bad:
            computed.append(losses["critic"].detach())
            values = learner.parameters["critic.value.weight"]
            losses["critic"] = losses["critic"] + (0 * values[..., 1, :, :]).sum().sqrt()
        return losses

    monkeypatch.setattr(kind, "losses", poisoned)
    trainer = begun("independent", tmp_path, f"learner={learner}", *more, *SEQUENCES)
    error = diverged(trainer)
    critic = "critic_1" if learner == "td3" else "critic"
    assert error.report.tensor == f"gradient of {critic}.value.weight"
    assert (error.report.uav, error.report.update) == (1, 9)
    assert error.dump is not None
    assert replay(error.dump) == error.report
    torch.testing.assert_close(computed[0], computed[1])
    bad.clear()
    assert replay(error.dump) is None


@pytest.mark.parametrize("learner", ["ddpg", "ippo"])
def test_the_loss_of_an_anchor_is_repeated_with_its_weight(learner, tmp_path, monkeypatch):
    first = begun("independent", tmp_path / "first", f"learner={learner}")
    first.train()
    start = [f"learner.warm_start={first.run.path}", "learner.anchor=0.5"]
    trainer = begun("independent", tmp_path / "anchored", f"learner={learner}", *start)
    original, weights = Anchor.loss, []

    def poisoned(anchor, *actions):
        weights.append(anchor.weight.item())
        return original(anchor, *actions) * (math.nan if len(weights) == 9 else 1)

    monkeypatch.setattr(Anchor, "loss", poisoned)
    error = diverged(trainer)
    wanted = weights[8]
    weights.clear()
    assert replay(error.dump) is None
    assert weights == [wanted]
    assert 0 < wanted < 0.5


def test_a_dump_holds_the_fires_of_a_file(tmp_path, monkeypatch):
    np.save(tmp_path / "bank.npy", np.random.default_rng(0).uniform(0, 30, (3, 30, 30)))
    fire = "fire=file", f"fire.path={tmp_path / 'bank.npy'}"
    original = DDPG.losses

    def poisoned(learner, batch, **more):
        losses = original(learner, batch, **more)
        losses["critic"] = losses["critic"] * math.nan
        return losses

    monkeypatch.setattr(DDPG, "losses", poisoned)
    trainer = begun("independent", tmp_path / "runs", *fire)
    (tmp_path / "bank.npy").unlink()
    error = diverged(trainer)
    assert replay(error.dump) == error.report


def test_the_first_bad_batch_is_kept_whatever_the_size_of_the_next():
    """The last minibatch of an epoch may be smaller than the others."""
    guard = NonFiniteGuard("cpu")

    def batch(size: int, value: float) -> TensorDict:
        return TensorDict({"x": torch.full((size,), value)}, batch_size=[size])

    assert guard.batch is None
    for size, value, loss in [(2, 1.0, 0.0), (1, 2.0, 0.0), (2, 3.0, torch.nan), (1, 4.0, 0.0)]:
        guard.record_batch(batch(size, value))
        guard.check_gradients({"loss": torch.tensor([loss])}, {})
    assert guard.batch is not None
    assert guard.batch["x"].tolist() == [3.0, 3.0]
