"""Tests imitation of map_greedy by the UAVs' maps, and trainings that begin with its actors."""

import json
import math
import shutil
import warnings

import pytest
import torch
from inside import Inside
from rich.console import Console
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn

from emberlink.comm.maps import Maps
from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError
from emberlink.policies.scripted.map_greedy import MapGreedy
from emberlink.trainers.build import build_env
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.learners.anchor import Anchor
from emberlink.trainers.learners.base import ACTOR
from emberlink.trainers.learners.imitation import Imitation, Mixture
from emberlink.trainers.rollout.teacher import Teacher
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep.command import sweep
from emberlink.trainers.training.non_finite import NonFiniteError, NonFiniteReport, replay
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.setup import TrainingSetup
from emberlink.trainers.training.trainer import Trainer

WORLD = [
    "world=front",
    "env.num_uavs=3",
    "num_envs=2",
    "fire.num_train_fires=2",
    "env.grid=[30,30]",
]
SHORT = [
    *("env.horizon=20", "episodes=4", "learner.hidden=[8,8]", "checkpoint_steps=4"),
    *("evaluation.interval=0", "evaluation.episodes=1", "evaluation.scripted=[]"),
    *("comm.pixels=8", "policy.hold=2"),
]
TINY = ["learner.samples=4", "learner.buffer_size=60"]
MEMORY = ["policy.memory=gru", "policy.units=4", "learner.sequence=3", "learner.burn_in=2"]
OFF_POLICY = ["learner.batch_size=4", "learner.buffer_size=60", "learner.share_parameters=true"]


def settings(learner: str, *more: str) -> list[str]:
    return ["setup=tuned", *WORLD, *SHORT, f"learner={learner}", *more]


def taught(hold: int, *more: str):
    config = resolve("maps", [*WORLD, f"policy.hold={hold}", "env.horizon=120", *more])
    fire = torch.full((30, 30), math.inf)
    fire[8:20, 9:21] = 3 * torch.rand(12, 12, generator=torch.Generator().manual_seed(0))
    times = torch.stack((fire, fire + 60))[None].repeat(2, 1, 1, 1)
    return build_env(config, num_envs=2, fire=times, seed=5, device="cpu", teacher="map_greedy")


def test_without_a_radio_the_teacher_is_map_greedy():
    env = taught(1, "env.radio.range=0")
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
    teacher, maps = env.transform[1], env.transform[0].module
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
    td = env.reset()
    for _ in range(3):
        action, target = td[keys.TEACHER], env.transform[1].target.clone()
        start = td[keys.POSITION]
        for _ in range(10):
            td = env.step(td.set(keys.ACTION, action))["next"]
        moved = td[keys.POSITION] - start
        wanted = torch.cat((target - start[..., :2], 4 - start[..., 2:]), -1)
        near = wanted.abs().amax(-1) <= 2  # cells flown in ten steps
        torch.testing.assert_close(moved[near], wanted[near], atol=1e-4, rtol=0)
        assert (moved[~near].abs().amax(-1) - 2).abs().max() < 1e-4


@pytest.mark.heavy
def test_the_share_of_the_teacher_falls_and_is_taken():
    setup = TrainingSetup(resolve("maps", settings("imitation", *TINY, "episodes=20")))
    explorer, td = setup.learner.explorer, setup.env.reset()
    for share in (1.0, 0.0):
        explorer.share.fill_(share)
        acted = explorer(td.clone())
        taken = (acted[keys.ACTION] == td[keys.TEACHER]).all(-1)
        assert (taken == bool(share)).all()
    setup.learner._advance(0)
    shares = []
    for _ in range(3):
        setup.dry_run(100)
        shares.append(explorer.share.item())
    assert shares == pytest.approx([0.6, 0.4, 0.2])


def test_the_loss_falls_and_is_that_of_smooth_l1():
    more = ["learner.samples=16", "learner.lr=0.003", "learner.updates_per_step=4"]
    setup = TrainingSetup(resolve("maps", settings("imitation", *TINY, *more)))
    losses, learner = [], setup.learner
    setup.dry_run(20)
    batch = learner.replay.sample()
    loss = learner.losses(batch)["imitation"]
    acted = learner.actor(batch.clone())
    difference = (acted[keys.AGENTS, "mean"] - batch[keys.TEACHER]).abs()
    smooth = torch.where(difference < 1, difference.square() / 2, difference - 0.5)
    assert loss.detach().allclose(smooth.mean((0, 2)))
    for _ in range(60):
        losses.append(learner.update(batch)["imitation"].mean().item())
    assert losses[-1] < 0.5 * losses[0]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["maps", *settings("imitation"), "policy.memory=gru"], "learner.sequence=16: an episode"),
        (["maps", *settings("imitation"), "learner.actor_of=imitation"], "no actors of its own"),
        (["maps", *settings("imitation"), "learner.actor_of=none"], "learner.actor_of='none'"),
        (
            ["maps", *settings("imitation"), "learner.samples=9", "learner.buffer_size=8"],
            "samples=9 is larger than buffer_size=8",
        ),
        (
            ["maps", *settings("ippo"), "learner.anchor=1"],
            "learner.anchor=1: needs learner.warm_start",
        ),
        (
            ["maps", *settings("ippo"), "env.observation=window"],
            "Maps reads it; it comes from env.observation=sight",
        ),
        (["consensus", "learner=imitation"], "which only method maps keeps"),
        (
            ["maps", *settings("imitation"), "learner.teacher=curier"],
            "learner.teacher='curier' is not known",
        ),
        (["maps", *settings("imitation"), "learner.teacher=courier"], "known: map_greedy"),
        (
            ["maps", *settings("ippo"), "learner.warm_start=nowhere"],
            "learner.warm_start=nowhere: there is no such run folder",
        ),
    ],
)
def test_what_cannot_be_imitated_is_one_line(arguments, said, tmp_path, capsys):
    assert main.main(["train", *arguments, f"output={tmp_path}"]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.iterdir())


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


def test_an_imitation_is_recorded_and_evaluated(imitated):
    lines = [
        json.loads(line) for line in (imitated["ippo"] / "metrics.jsonl").read_text().splitlines()
    ]
    assert len(lines) == 4
    assert all(0 < line["loss_imitation"] < 2 for line in lines[1:])
    assert json.loads((imitated["ippo"] / "eval.json").read_text())
    assert main.main(["eval", str(imitated["ippo"]), "env.num_uavs=5", "--fires", "1"]) == 0


@pytest.mark.heavy
def test_a_sweep_of_imitations_trains_each_once(tmp_path):
    arguments = ["maps", *settings("imitation", *TINY, "learner.teacher_share=0,1")]
    arguments += ["env.horizon=12", "episodes=1", f"output={tmp_path}"]
    for _ in range(2):
        assert sweep(arguments, Console(quiet=True), executor=Inside()) == 0
        runs = [RunFolder(file.parent) for file in tmp_path.glob("*/config.yaml")]
        share = [run.config().learner.teacher_share for run in runs]
        assert sorted(share) == [0, 1]
        (first,), (second,) = (run.metrics() for run in runs)
        assert first["loss_imitation"] != second["loss_imitation"]
        assert all((run.path / "eval.json").exists() for run in runs)


def test_a_run_without_a_checkpoint_begins_with_these_actors_again(imitated, tmp_path):
    start = [f"learner.warm_start={imitated['ippo']}", "learner.anchor=0.5", "on_nan=rollback"]
    trainer = Trainer(resolve("maps", [*settings("ippo", *start), f"output={tmp_path}"]))
    trainer.start()
    expected = trainer.setup.learner.weights()
    trainer.close()  # as if the process had been killed

    def check(learner):
        actor = {name: value for name, value in expected.items() if name.startswith(ACTOR)}
        weights, frozen = learner.weights(), learner.anchor.network.state_dict()
        for name, value in actor.items():
            assert weights[name].equal(value), name
            assert frozen[name.removeprefix(ACTOR)].view_as(value).equal(value), name

    resumed = resume(trainer.run.path)
    check(resumed.setup.learner)
    report = NonFiniteReport("reward", 0, 0, 0, step=1, update=None, value="nan")
    resumed.roll_back(NonFiniteError(str(report), report, None))
    check(resumed.setup.learner)
    resumed.close()


LEARNERS = [
    ("ippo", "ippo", ["learner.minibatches=2", "seeds=[3,4]"]),
    ("ddpg", "ddpg", OFF_POLICY),
    pytest.param("mappo", "ippo", [], marks=pytest.mark.heavy),
    pytest.param("td3", "ddpg", OFF_POLICY, marks=pytest.mark.heavy),
]


@pytest.mark.parametrize(("learner", "actor_of", "more"), LEARNERS)
def test_a_run_begins_with_the_actors_of_another(learner, actor_of, more, imitated, tmp_path):
    start = [f"learner.warm_start={imitated[actor_of]}", "learner.anchor=0.5"]
    trainer = Trainer(resolve("maps", [*settings(learner, *more, *start), f"output={tmp_path}"]))
    mine = trainer.setup.learner
    trainer.start()
    theirs = TrainingSetup(
        resolve("maps", settings("imitation", *TINY, f"learner.actor_of={actor_of}"))
    )
    resumed = resume(imitated[actor_of])
    resumed.close()
    expected = resumed.setup.learner.weights()
    assert theirs.learner.weights().keys() == expected.keys()
    for team in range(len(trainer.setup.seeds)):
        weights = mine.weights(team)
        for name, value in expected.items():
            assert weights[name].equal(value), name
            target = name.replace(ACTOR, "target_" + ACTOR)
            assert target not in weights or weights[target].equal(value)
    trainer.train()
    assert all("loss_anchor" in line for line in trainer.run.metrics()[1:])
    assert mine.anchor.weight < 0.3
    assert any(not mine.weights()[name].equal(value) for name, value in expected.items())
    frozen = mine.anchor.network.state_dict()
    for name, value in expected.items():
        assert frozen[name.removeprefix(ACTOR)][:1].equal(value.view(1, *value.shape[1:]))


@pytest.mark.parametrize("warm", [False, True])
def test_the_first_noise_is_that_of_the_configuration(warm, imitated, tmp_path):
    start = [f"learner.warm_start={imitated['ippo']}"] if warm else []
    more = [*start, "learner.log_std=-1.5", f"output={tmp_path}"]
    trainer = Trainer(resolve("maps", settings("ippo", *more)))
    trainer.start()
    noise = trainer.setup.learner.weights()["actor_network_params.module.log_std"]
    assert (noise == -1.5).all()


@pytest.mark.parametrize("name", ["", "map greedy", "../map_greedy"])
def test_a_teacher_has_a_name(name):
    with pytest.raises(UserError, match=r"learner\.teacher=.*: expected a name of letters, digits"):
        resolve("maps", settings("imitation", f"learner.teacher={name}"))


def test_actors_of_a_run_on_a_device_that_is_not_here(imitated, tmp_path):
    run = shutil.copytree(imitated["ippo"], tmp_path / "run")
    config = (run / "config.yaml").read_text()
    assert "device: cpu" in config
    (run / "config.yaml").write_text(config.replace("device: cpu", "device: cuda:7"))
    more = [f"learner.warm_start={run}", f"output={tmp_path / 'runs'}"]
    Trainer(resolve("maps", settings("ippo", *more))).start()


def test_another_grid_is_warned_of_where_positions_are_observed(imitated, tmp_path):
    start = [f"learner.warm_start={imitated['ippo']}", "env.grid=[40,40]"]
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        Trainer(resolve("maps", settings("ippo", *start, f"output={tmp_path}"))).start()


def test_another_reward_is_not_warned_of(tmp_path):
    start = "learner.warm_start=pretrained:tuned/consensus/s0", f"output={tmp_path}"
    config = resolve("consensus", ["setup=tuned", *start, "comm.heading.weight=0"])
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        Trainer(config).start()


def test_an_old_checkpoint_has_no_memory(tmp_path, capsys):
    """The networks of `tuned` were written before there were settings of the policy."""
    start = ["learner.warm_start=pretrained:tuned/independent/s0", "policy.memory=gru"]
    arguments = ["train", "independent", "setup=tuned", *start, f"output={tmp_path}"]
    assert main.main(arguments) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "it was trained with policy.memory=none (now gru)" in said


def test_actors_of_another_network_are_refused(imitated, tmp_path, capsys):
    start = f"learner.warm_start={imitated['ddpg']}"
    arguments = ["train", "maps", *settings("ippo", start), f"output={tmp_path}"]
    assert main.main(arguments) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "learner.warm_start=" in said
    assert "learner.name=imitation (now ippo)" in said
    assert "learner.actor_of=ddpg" in said
    assert not list(tmp_path.iterdir())


def test_weights_of_each_uav_are_refused_where_they_are_shared(imitated, tmp_path, capsys):
    start = f"learner.warm_start={imitated['ippo']}", "learner.share_parameters=false"
    assert main.main(["train", "maps", *settings("ippo", *start), f"output={tmp_path}"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "it was trained with learner.share_parameters=true (now false), learner." in said


def test_a_layer_that_this_run_lacks_is_refused(imitated, tmp_path, capsys):
    start = f"learner.warm_start={imitated['ippo']}", "learner.hidden=[8]"
    assert main.main(["train", "maps", *settings("ippo", *start), f"output={tmp_path}"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    settings_first, tensor_last = said.split(": holds ")
    assert "it was trained with learner.hidden=[8, 8] (now [8])" in settings_first
    assert tensor_last.endswith("which this configuration does not have")


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("none", "there is no such run folder"),
        ("run/checkpoints/best.safetensors", "expected a run folder, found a file"),
    ],
)
def test_actors_of_no_run_are_an_error(path, said, imitated, tmp_path, capsys):
    shutil.copytree(imitated["ippo"], tmp_path / "run")
    start = f"learner.warm_start={tmp_path / path}"
    assert main.main(["train", "maps", *settings("ippo", start), f"output={tmp_path / 'o'}"]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "o").exists()


def test_a_shipped_policy_that_does_not_fit_leaves_no_copy(tmp_path, capsys):
    start = "learner.warm_start=pretrained:maps", "comm.pixels=8", f"output={tmp_path}"
    assert main.main(["train", "maps", *settings("ippo", *start)]) == 2
    assert "comm.pixels=24 (now 8)" in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.iterdir())


def test_pictures_of_other_scales_are_warned_of(imitated, tmp_path):
    def prepare(*more: str) -> None:
        start = f"learner.warm_start={imitated['ippo']}", f"output={tmp_path}"
        trainer = Trainer(resolve("maps", settings("ippo", *start, *more)))
        trainer.start()
        trainer.close()

    with pytest.warns(UserWarning, match=r"comm.scales=\[1, 5\], this run has \[1, 3\]"):
        prepare("comm.scales=[1,3]")
    with pytest.warns(UserWarning, match=r"env.displacement=[\d.]+, this run has 0.7"):
        prepare("env.displacement=0.7")
    with pytest.warns(UserWarning, match=r"env.altitude=\[1.0, 4.0\], this run has \[1.0, 5.0\]"):
        prepare("env.altitude=[1.0,5.0]")
    with pytest.warns(UserWarning, match=r"env.view_angle=30.0, this run has 45.0"):
        prepare("env.view_angle=45")
    with pytest.warns(UserWarning, match=r"env.base=null, this run has \[0.0, 9.0\]"):
        prepare("env.base=[0,9]")
    with pytest.warns(UserWarning, match=r"env.radio.range=10.0, this run has 0.0"):
        prepare("env.radio.range=0.0")
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        prepare()


def finished(config, stop: int | None):
    trainer = Trainer(config)
    trainer.start()
    if stop is not None:
        trainer.train(lambda progress: trainer.stop() if progress.step >= stop else None)
        trainer = resume(trainer.run.path)
    trainer.train()
    return trainer


@pytest.mark.parametrize(
    ("learner", "more"),
    [
        ("imitation", TINY),
        ("ippo", []),
        pytest.param("imitation", [*TINY, *MEMORY], marks=pytest.mark.heavy),
        pytest.param("ddpg", OFF_POLICY, marks=pytest.mark.heavy),
    ],
)
def test_a_resumed_run_is_the_same_bit_for_bit(learner, more, imitated, tmp_path):
    if learner != "imitation":
        more = [*more, f"learner.warm_start={imitated[learner]}", "learner.anchor=0.5"]
    states, lines = [], []
    for stop in (None, 34):
        config = resolve("maps", [*settings(learner, *more), f"output={tmp_path / str(stop)}"])
        trainer = finished(config, stop)
        states.append(trainer.setup.state_dict())
        lines.append(trainer.run.metrics())
    assert states[0].keys() == states[1].keys()
    for name, value in states[0].items():
        assert value.nan_to_num(7).equal(states[1][name].nan_to_num(7)), name
    assert lines[0] == lines[1]


def poison(place: str, monkeypatch) -> None:
    """Makes a number NaN: of environment 1 and UAV 2 at step 10, or of the fifth update."""
    owner, name = {
        "observation": (Maps, "_vector"),
        "teacher": (Teacher, "_teach"),
        "gradient": (Imitation, "losses"),
    }[place]
    original = getattr(owner, name)

    def poisoned(self, tensordict, *more):
        result = original(self, tensordict, *more)
        if place == "gradient":
            weight = self.parameters["actor.output.weight"]
            if self.updates == 5:
                result["imitation"] = result["imitation"] + (0 * weight).sum().sqrt()
        elif tensordict[keys.STEP][1] == 10:
            values = result if place == "observation" else result[keys.TEACHER]
            values[1, 2] = math.nan
        return result

    monkeypatch.setattr(owner, name, poisoned)


EXPECTED = {
    "observation": ("observation", 2, 1, 10, None),
    "teacher": ("teacher", 2, 1, 11, None),
    "gradient": ("gradient of actor.output.weight", None, None, 10, 5),
}


@pytest.mark.parametrize("more", [[], MEMORY])
@pytest.mark.parametrize("place", [*EXPECTED])
def test_a_value_that_is_not_finite_stops_an_imitation(place, more, tmp_path, monkeypatch):
    poison(place, monkeypatch)
    own = [*TINY, *more, "learner.teacher_share=1", f"output={tmp_path}"]
    trainer = Trainer(resolve("maps", settings("imitation", *own)))
    trainer.start()
    with pytest.raises(NonFiniteError) as caught:
        trainer.train()
    report, dump = caught.value.report, caught.value.dump
    tensor, uav, env, step, update = EXPECTED[place]
    step += 4 if update and more else 0  # the first sequence is complete later
    assert report == NonFiniteReport(tensor, uav, 0, env, step, update, "nan")
    assert dump is not None
    assert replay(dump) == report
    assert all(value.isfinite().all() for value in trainer.setup.learner.weights().values())
    monkeypatch.undo()
    assert place != "gradient" or replay(dump) is None
    again = resume(trainer.run.path)
    assert again.setup.step == step - step % 4
    again.close()


class Still(TensorDictModuleBase):
    """A student that does not move."""

    in_keys, out_keys = [keys.TEACHER], [keys.ACTION]

    def forward(self, tensordict):
        return tensordict.set(keys.ACTION, torch.zeros_like(tensordict[keys.TEACHER]))


def test_each_uav_takes_the_action_of_the_teacher_with_the_same_probability():
    mixture, envs = Mixture(Still(), "cpu"), 8000
    mixture.share.fill_(0.3)
    td = TensorDict(
        {keys.TEACHER: torch.ones(envs, 3, 3), keys.RNG_KEY: torch.arange(envs)}, [envs]
    )
    td[keys.STEP] = torch.zeros(envs, dtype=torch.int64)
    taken = mixture(td)[keys.ACTION].mean(-1)
    assert taken.unique().tolist() == [0, 1]
    assert taken.mean().item() == pytest.approx(0.3, abs=0.02)
    assert (torch.corrcoef(taken.T) - torch.eye(3)).abs().max() < 0.05


def test_the_weight_of_an_anchor_falls_linearly_to_0():
    anchor = Anchor(nn.Linear(2, 2), 0.4, "cpu")
    for done, weight in ((0.0, 0.4), (0.25, 0.3), (0.75, 0.1), (1.0, 0.0)):
        anchor.advance(done)
        assert anchor.weight.item() == pytest.approx(weight)
