"""What a training does where a number is not finite: it ends at once and names it, or goes back."""

import functools
import json
import math
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from test_recipes import METHODS
from test_resume import assert_same, until

from emberlink.envs import keys
from emberlink.envs.wildfire import WildfireEnv
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.learners.ddpg import Learner
from emberlink.trainers.learners.nan_guard import Watch, norms
from emberlink.trainers.learners.replay_buffer import rows_needed
from emberlink.trainers.runs import checkpoint_file
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.training import divergence, state
from emberlink.trainers.training.divergence import Culprit, Divergence, replay
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


resolved = functools.cache(resolve)


def begun(method: str, output: Path, *more: str) -> Trainer:
    config = resolved(method, (*SMALL, *more))
    trainer = Trainer(replace(config, output=str(output)))
    trainer.start()
    return trainer


def update_at(step: int, method: str) -> int:
    """The number of the update that a step is followed by."""
    shared = resolved(method, tuple(SMALL)).memory == "shared"
    enough = rows_needed(UAVS, shared=shared, batch=BATCH)
    return step - -(-enough // ENVS) + 1


class Poison:
    """Makes one number of a training wrong at `STEP`, by patching the classes.

    Attributes:
        always: also in updates that have another number, such as the one of a replay.
    """

    def __init__(self, monkeypatch, place: str, method: str = "consensus", env: int = ENV, uav=UAV):
        self.monkeypatch, self.update = monkeypatch, update_at(STEP, method)
        self.env, self.uav = env, uav
        self.always, self.moments, self.updates = False, Counter(), Counter()
        getattr(self, place)()

    def observation(self) -> None:
        observe = WildfireEnv._observe

        def poisoned(world, position, counts, time):
            found = observe(world, position, counts, time)
            if self.is_due(world, time):
                found[self.env, self.uav % UAVS, 4] = math.nan
            return found

        self.monkeypatch.setattr(WildfireEnv, "_observe", poisoned)

    def reward(self) -> None:
        step = WildfireEnv._step

        def poisoned(world, tensordict):
            after = step(world, tensordict)
            if self.is_due(world, world._time):
                after[keys.REWARD][self.env, self.uav % UAVS] = -math.inf
            return after

        self.monkeypatch.setattr(WildfireEnv, "_step", poisoned)

    def gradient(self) -> None:
        losses = Learner.losses

        def poisoned(learner, batch):
            actor, critic = losses(learner, batch)
            self.updates[learner] += 1
            if self.always or self.updates[learner] == self.update:
                weight = learner.watch.trained["critic.second.weight"][self.uav]
                critic = critic + (0 * weight).sum().sqrt()  # 0, whose derivative is NaN
            return actor, critic

        self.monkeypatch.setattr(Learner, "losses", poisoned)

    def loss(self) -> None:
        losses = Learner.losses

        def poisoned(learner, batch):
            actor, critic = losses(learner, batch)
            self.updates[learner] += 1
            if self.always or self.updates[learner] == self.update:
                uavs = torch.arange(len(actor))
                actor = actor.masked_fill(uavs == self.uav, math.nan)
            return actor, critic

        self.monkeypatch.setattr(Learner, "losses", poisoned)

    def weight(self) -> None:
        update = Learner.update

        def poisoned(learner, batch):
            found = update(learner, batch)
            self.updates[learner] += 1
            if self.updates[learner] == self.update:
                with torch.no_grad():
                    learner.watch.trained["actor.second.weight"][self.uav, 2, 3] = math.nan
            return found

        self.monkeypatch.setattr(Learner, "update", poisoned)

    def is_due(self, world, time) -> bool:
        """Whether a moment is that of `STEP`: the second of its number, as episodes begin at 0."""
        self.moments[world, int(time[0])] += 1
        return int(time[0]) == STEP % HORIZON and self.moments[world, STEP % HORIZON] == 2


EXPECTED = {
    "observation": {"tensor": "observation", "environment": ENV, "value": "nan"},
    "reward": {"tensor": "reward", "environment": ENV, "value": "-inf"},
    "gradient": {"tensor": "gradient of critic.second.weight", "value": "nan"},
    "loss": {"tensor": "actor's loss", "value": "nan"},
    "weight": {"tensor": "weight actor.second.weight", "value": "nan"},
}


def expected(place: str, method: str = "consensus", **more) -> dict:
    """The culprit, but for how many UAVs it is found at."""
    whole = {"uav": UAV, "seed": 0, "environment": None, "step": STEP, "update": None}
    whole |= EXPECTED[place] | more
    if place in ("gradient", "loss"):
        whole["update"] = update_at(STEP, method)
    if place == "weight":
        whole["step"] = STEP + 1  # where it first does something: the actor's next action
    return whole


def diverged(trainer: Trainer) -> Divergence:
    with pytest.raises(Divergence) as caught:
        trainer.train()
    return caught.value


def check_culprit(culprit: Culprit, wanted: dict) -> None:
    assert {name: getattr(culprit, name) for name in wanted} == wanted


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """The networks of an undisturbed run just before `STEP`, and behind it."""
    found = {}

    def of(method: str) -> tuple[dict, dict]:
        if method not in found:
            trainer = begun(method, tmp_path_factory.mktemp("clean"), "checkpoint_steps=1")
            until(trainer, STEP)
            before, after = (checkpoint_file.read(path)[1] for path in trainer.run.states())
            found[method] = before, after
        return found[method]

    return of


def check_weights(bundle: Path, wanted: dict, *, but: str | None = None) -> None:
    """That networks and optimisers in a bundle are those of a state, to the last bit."""
    _, weights = checkpoint_file.read(bundle / "weights.safetensors")
    names = [name for name in wanted if name.startswith(("networks/", "optimizer/"))]
    assert weights.keys() == set(names)
    for name in names:
        same = weights[name].numpy().tobytes() == wanted[name].numpy().tobytes()
        assert same is (but is None or but not in name), name


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("method", METHODS)
def test_it_stops_at_once_and_names_the_number(method, place, clean, tmp_path, monkeypatch):
    before, after = clean(method)
    poison = Poison(monkeypatch, place, method)
    trainer = begun(method, tmp_path)
    error = diverged(trainer)
    check_culprit(error.culprit, expected(place, method))
    assert f"{error.culprit.tensor} of UAV {UAV}" in str(error)
    assert f"step {error.culprit.step}" in str(error)
    # No update was made with it.
    bundle = error.bundle
    assert bundle == trainer.run.path / f"divergence_step_{error.culprit.step}"
    if place == "weight":
        check_weights(bundle, after, but="actor_network_params.module.second.weight")
    else:
        check_weights(bundle, before)
    # What is in the bundle.
    assert {path.name for path in bundle.iterdir()} == {
        *("batch.safetensors", "weights.safetensors", "config.yaml", "report.json")
    }
    assert RunFolder(bundle).config() == trainer.config
    report = json.loads((bundle / "report.json").read_text())
    assert Culprit(**report["culprit"]) == error.culprit
    ranges = {name: one for name, one in report["ranges"].items() if one["not_finite"]}
    # Losses and gradients are not of what was collected, and all else is good.
    assert any(error.culprit.tensor.split()[-1].split(".")[-1] in name for name in ranges)
    _, batch = checkpoint_file.read(bundle / "batch.safetensors")
    rows = BATCH if place == "gradient" else ENVS
    assert batch["batch/next.agents.reward" if rows == BATCH else "batch/next.reward"].shape == (
        *(rows, UAVS, 1),
    )
    # It can be found again.
    poison.always = True
    assert replay(bundle) == error.culprit
    poison.always = False
    if place == "gradient":
        assert replay(bundle) is None
    # What was there before is good.
    assert [path.name for path in trainer.run.states()] == [
        "state_000000020.safetensors",
        "state_000000030.safetensors",
    ]
    again = resume(trainer.run.path)
    again.close()
    assert again.step == 30
    assert all(value.isfinite().all() for value in state.networks(again).values())
    assert len(trainer.run.lines()) == 1
    assert (trainer.run.path / "metrics.jsonl").read_text().count("\n") == 1


@pytest.mark.parametrize("place", ["observation", "loss"])
def test_the_uav_that_has_it_is_told_from_those_that_hear_it(place, tmp_path, monkeypatch):
    Poison(monkeypatch, place, "positional")
    culprit = diverged(begun("positional", tmp_path)).culprit
    check_culprit(culprit, expected(place, "positional"))
    assert culprit.uavs == (UAVS if place == "observation" else 1)


@pytest.mark.parametrize("place", PLACES)
def test_of_several_seeds_the_right_one_is_named(place, tmp_path, monkeypatch):
    """The second seed's first environment, its UAV 1."""
    Poison(monkeypatch, place, env=ENVS, uav=UAVS + UAV)
    trainer = begun("consensus", tmp_path, "seeds=[5,9]")
    error = diverged(trainer)
    more = {} if EXPECTED[place].get("environment") is None else {"environment": 0}
    check_culprit(error.culprit, expected(place, seed=9, **more))
    assert "seed 9" in str(error)
    assert error.bundle.parent == trainer.runs[0].path
    if place != "gradient":
        assert replay(error.bundle) == error.culprit


@pytest.mark.parametrize("late", [3])
@pytest.mark.parametrize("place", PLACES)
def test_who_looks_later_finds_the_same(place, late, clean, tmp_path, monkeypatch):
    """As on a GPU, whose flags arrive a step later: nothing is learnt meanwhile."""
    Poison(monkeypatch, place)
    seen: list[bool] = []

    def look(watch: Watch, *, wait: bool = False) -> bool:
        seen.append(bool(watch.bad))
        return seen[-1] if wait else len(seen) > late and seen[-1 - late]

    monkeypatch.setattr(Watch, "look", look)
    trainer = begun("consensus", tmp_path)
    error = diverged(trainer)
    check_culprit(error.culprit, expected(place))
    assert trainer.step == error.culprit.step + late
    before, after = clean("consensus")
    if place == "weight":
        weight = after["networks/value_network_params.module.second.weight"]
        assert trainer.learner.watch.trained["critic.second.weight"].equal(weight)
    else:
        check_weights(error.bundle, before)


def test_no_checkpoint_is_made_of_it(tmp_path, monkeypatch):
    """However late it is looked, a checkpoint is waited for."""
    look = Watch.look
    monkeypatch.setattr(Watch, "look", lambda watch, *, wait=False: wait and look(watch, wait=True))
    Poison(monkeypatch, "gradient")
    trainer = begun("consensus", tmp_path)
    check_culprit(diverged(trainer).culprit, expected("gradient"))
    assert trainer.step == 40
    assert [path.stem[-3:] for path in trainer.run.states()] == ["020", "030"]
    assert len(trainer.run.lines()) == 1


def test_a_learning_rate_that_blows_up(tmp_path):
    """Nothing is injected: weights whose squares are no numbers, after one update."""
    trainer = begun("independent", tmp_path, "learner.critic_lr=1e25")
    error = diverged(trainer)
    assert error.culprit.tensor.startswith("weight critic.")
    assert error.culprit.update == 1
    assert float(error.culprit.value) == pytest.approx(1e25, rel=0.1)
    assert replay(error.bundle) == error.culprit


def test_the_command_says_it_in_one_line(tmp_path, monkeypatch, capsys):
    Poison(monkeypatch, "reward")
    assert main.main(["train", "consensus", *SMALL, f"output={tmp_path}"]) == 2
    (run,) = tmp_path.iterdir()
    error = capsys.readouterr().err
    assert error == (
        f"emberlink train: reward of UAV 1, seed 0, environment 1, is -inf at step 33; what "
        f"reproduces it is in {run}/divergence_step_33; the last good checkpoint is "
        f"{run}/checkpoints/state_000000030.safetensors, resume with: emberlink train "
        f"resume={run} on_nan=rollback\n"
    )
    monkeypatch.undo()
    assert main.main(["train", f"resume={run}", "on_nan=rollback"]) == 0
    assert RunFolder(run).config().on_nan == "rollback"


def test_a_bundle_that_cannot_be_written_hides_nothing(tmp_path, monkeypatch):
    Poison(monkeypatch, "reward")

    def full(*_):
        raise ValueError("no space left")

    monkeypatch.setattr(divergence.state, "learner", full)
    error = diverged(begun("consensus", tmp_path))
    assert "reward of UAV 1" in str(error)
    assert "nothing could be kept of it: no space left" in str(error)
    assert error.bundle is None


def diverging_above(monkeypatch, share: float) -> None:
    """A gradient is NaN at every learner's 20th update while its rates are above a share."""
    losses = Learner.losses

    def poisoned(learner, batch):
        actor, critic = losses(learner, batch)
        group = learner.optimizer.param_groups[0]
        weight = group["params"][0]
        done = int(learner.optimizer.state[weight].get("step", 0))
        if done == 20 and group["lr"] > share * 1e-4:
            critic = critic + (0 * weight[UAV]).sum().sqrt()
        return actor, critic

    monkeypatch.setattr(Learner, "losses", poisoned)


ROLLBACK = ["on_nan=rollback", "setup=paper"]


@pytest.mark.parametrize("seeds", [[], ["seeds=[0,4]"]])
def test_a_rollback_goes_on_and_resumes_as_if_it_had_not_stopped(seeds, tmp_path, monkeypatch):
    diverging_above(monkeypatch, 0.3)
    trainer = begun("consensus", tmp_path / "a", *ROLLBACK, *seeds)
    copy = tmp_path / "b"
    notes = []

    def watch(progress) -> None:
        if progress.note:
            notes.append(progress.note)
            if len(notes) == 1:  # what is there is what a kill would leave
                shutil.copytree(trainer.run.path.parent, copy)

    # As `until` keeps what the training is by its end.
    train = trainer.train
    monkeypatch.setattr(trainer, "train", lambda report: train(lambda p: (watch(p), report(p))))
    until(trainer, None)
    assert (trainer.rate, trainer.tries, trainer.step) == (0.25, 0, 60)
    assert [group["lr"] for group in trainer.learner.optimizer.param_groups] == [2.5e-5, 2.5e-4]
    assert len(notes) == 2
    assert "rollback 2 of 5: on from step 20 with learning rates x 0.25" in notes[1]
    for run in trainer.runs:
        lines = (run.path / "rollbacks.jsonl").read_text().splitlines()
        assert [(json.loads(one)["to"], json.loads(one)["rate"]) for one in lines] == [
            (20, 0.5),
            (20, 0.25),
        ]
        assert [line["episode"] for line in run.lines()] == [1, 2, 3]
        assert [line["episode"] for line in run.lines("timing.jsonl")] == [1, 2, 3]
    assert len(list(trainer.run.path.glob("divergence_step_*"))) == 2
    # Killed after the first rollback, and stopped behind the second.
    resumed = resume(copy / trainer.run.path.name)
    assert (resumed.rate, resumed.tries, resumed.step) == (0.5, 1, 20)
    until(resumed, 37)
    again = resume(resumed.run.path)
    assert (again.rate, again.step) == (0.25, 37)
    assert_same(trainer, until(again, None))


def test_a_rollback_that_does_not_help_is_given_up(tmp_path, monkeypatch, capsys):
    """An environment's NaN, before there is a checkpoint."""
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
    assert "on_nan" not in err
    assert "rollback 1 of 5: on from step 0 with learning rates x 0.5" in out
    (folder,) = tmp_path.iterdir()
    assert len((folder / "rollbacks.jsonl").read_text().splitlines()) == 5
    assert {path.name for path in folder.glob("divergence*")} == {
        "divergence_step_13",
        *(f"divergence_step_13_{number}" for number in range(2, 7)),
    }
    again = resume(folder)
    assert (again.step, again.tries, again.rate) == (0, 5, 1 / 32)
    assert "given up" in str(diverged(again))
    # With the environment mended, it goes on with what is left of the rates.
    monkeypatch.undo()
    mended = resume(folder)
    assert mended.train()
    assert (mended.rate, mended.tries) == (1 / 32, 0)


def test_a_state_with_rates_that_cannot_be_is_refused(tmp_path):
    trainer = until(begun("independent", tmp_path), 10)
    path = trainer.run.states()[-1]
    header, content = checkpoint_file.read(path)
    for wrong in ({"rate": 0}, {"rate": 2.0}, {"rate": "a"}, {"tries": -1}, {"furthest": 1.5}):
        checkpoint_file.write(path, content, header | wrong)
        with pytest.raises(ValueError, match=path.name):
            resume(trainer.run.path)


@pytest.mark.parametrize("wrong", ["nan", "off", "true"])
def test_what_can_be_chosen(wrong, capsys):
    assert main.main(["train", "consensus", f"on_nan={wrong}"]) == 2
    assert "'stop' or 'rollback'" in capsys.readouterr().err


def test_norms_are_each_uavs():
    generator = torch.Generator().manual_seed(0)
    tensors = [torch.randn(3, 4, 5, generator=generator), torch.randn(3, 1, 7, generator=generator)]
    wanted = [[math.sqrt(sum(x * x for x in uav.flatten().tolist())) for uav in t] for t in tensors]
    torch.testing.assert_close(norms(tensors), torch.tensor(wanted))
