"""Tests that a stopped and resumed run equals the uninterrupted run bit for bit."""

import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import pytest
import torch
from damage import sealed_again
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_recipes import METHODS

from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.learners.off_policy.replay_buffer import ReplayMemory
from emberlink.trainers.runs import checkpoint_file
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.trainer import Progress, Trainer

HORIZON, EPISODES = 20, 4
SMALL = [
    *(f"env.horizon={HORIZON}", f"episodes={EPISODES}", "env.num_uavs=2", "num_envs=2"),
    *("learner.hidden=[8,8]",),
    *("evaluation.interval=0", "evaluation.interval_episodes=1", "evaluation.episodes=1"),
]


def replay(trainer: Trainer) -> ReplayMemory:
    learner: Any = trainer.setup.learner
    return learner.replay


# A replay buffer of 60 rows is full after 30 of the 80 steps.
REPLAY = ["learner.batch_size=16", "learner.buffer_size=60"]
SEQUENCES = ["learner.sequence=4", "learner.burn_in=3"]
ON_POLICY = ["policy.memory=gru", "policy.units=6"]


def begun(method: str, output: Path, *more: str) -> Trainer:
    own = ON_POLICY if {"learner=ippo", "learner=mappo"} & {*more} else REPLAY
    trainer = Trainer(resolve(method, [*SMALL, *own, f"output={output}", *more]))
    trainer.start()
    return trainer


def until(trainer: Trainer, step: int | None) -> Trainer:
    """Trains until a step, or to the end; appends the final state to `final`."""

    def watch(progress: Progress) -> None:
        if progress.step == step:
            trainer.stop()
        if progress.step == progress.steps:
            final[trainer] = everything(trainer)

    trainer.train(watch)
    return trainer


final: WeakKeyDictionary[Trainer, dict[str, torch.Tensor]] = WeakKeyDictionary()


def stopped_at(steps: list[int], method: str, output: Path, *more: str) -> Trainer:
    """Trains a run that is stopped and resumed at the given steps, to its end."""
    trainer = until(begun(method, output, *more), steps[0])
    for step in [*steps[1:], None]:
        trainer = until(resume(trainer.run.path), step)
    return trainer


def everything(trainer: Trainer) -> dict[str, torch.Tensor]:
    rollbacks = {name: torch.tensor(value) for name, value in asdict(trainer.rollbacks).items()}
    state = trainer.setup.state_dict().items()
    return rollbacks | {name: value.clone() for name, value in state}


def assert_same(run: Trainer, other: Trainer) -> None:
    """Checks that two runs have the same state, to the last bit, and the same metrics."""
    first, second = final[run], final[other]
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert value.dtype == second[name].dtype
        # Compared as bytes: NaN equals NaN, and 0 differs from -0.
        assert value.numpy().tobytes() == second[name].numpy().tobytes(), name
    for a, b in zip(run.runs, other.runs, strict=True):
        assert (a.path / "metrics.jsonl").read_bytes() == (b.path / "metrics.jsonl").read_bytes()
        assert [line["episode"] for line in b.lines("timing.jsonl")] == [
            line["episode"] for line in a.lines("timing.jsonl")
        ]
        best = "checkpoints/best.safetensors"
        assert networks_of(a.networks()[-1]) == networks_of(b.networks()[-1])
        assert networks_of(a.path / best) == networks_of(b.path / best)


def networks_of(path: Path) -> tuple[dict, dict[str, bytes]]:
    """Returns the contents of a file of networks without its configuration."""
    header, tensors = checkpoint_file.read(path)
    for key in ("config", "sha256"):  # `output` and `checkpoint_steps` differ
        header.pop(key)
    return header, {name: value.numpy().tobytes() for name, value in tensors.items()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Returns a function that gives the uninterrupted run of a method."""
    runs: dict[tuple, Trainer] = {}

    def of(method: str, *more: str) -> Trainer:
        if (method, *more) not in runs:
            folder = tmp_path_factory.mktemp("whole")
            runs[method, *more] = until(begun(method, folder, *more), None)
        return runs[method, *more]

    return of


# Before the first update; within, at and after the end of an episode; before the last step. At
# step 33 of 80 the replay buffer has just wrapped around.
STOPS = dict(
    zip(METHODS, [[1, 33], [40], [41, 42, 79], [33, 40, 79]], strict=True), maps=[1, 33, 40, 79]
)
IN_CI = {(method, "ddpg") for method in METHODS}
IN_CI |= {("consensus", learner) for learner in ("td3", "ippo", "mappo")}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "steps", "learner"),
    [
        pytest.param(
            *(method, steps, learner),
            marks=() if (method, learner) in IN_CI else pytest.mark.heavy,
        )
        for method, steps in STOPS.items()
        for learner in ("ddpg", "td3", "ippo", "mappo")
    ],
)
def test_a_resumed_run_equals_the_uninterrupted_run(method, steps, learner, whole, tmp_path):
    more = [] if learner == "ddpg" else [f"learner={learner}"]
    more += ["comm.pixels=8"] if method == "maps" else []
    assert_same(whole(method, *more), stopped_at(steps, method, tmp_path, *more))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "more"),
    [
        ("consensus", ["learner=ddpg"]),
        pytest.param("positional", ["learner=td3"], marks=pytest.mark.heavy),
        ("independent", ["learner=ippo"]),
        pytest.param(
            "shared_memory", ["learner=mappo", "learner.critic_map=true"], marks=pytest.mark.heavy
        ),
        pytest.param(
            "consensus",
            ["learner=ddpg", "policy.memory=stack", *SEQUENCES, "learner.critic=team"],
            marks=pytest.mark.heavy,
        ),
        pytest.param(
            "independent", ["learner=td3", "policy.memory=gru", *SEQUENCES], marks=pytest.mark.heavy
        ),
    ],
)
def test_seeds_side_by_side_are_resumed_together(method, more, whole, tmp_path):
    more = "seeds=[0,1,2]", *more
    stopped = stopped_at([27, 60], method, tmp_path, *more)
    assert len(stopped.runs) == 3
    assert_same(whole(method, *more), stopped)


# A replay buffer has wrapped around after 15 of the 40 decisions.
@pytest.mark.parametrize(
    "more",
    [
        ["learner=ippo"],
        pytest.param(["learner=ippo", "learner.share_parameters=false"], marks=pytest.mark.heavy),
        ["learner=mappo", "policy.memory=stack", "learner.critic_map=true"],
        ["learner=ddpg"],
        pytest.param(["learner=ddpg", "learner.critic=team"], marks=pytest.mark.heavy),
        ["learner=ddpg", "policy.memory=gru", *SEQUENCES],
        pytest.param(
            [
                *("learner=td3", "policy.memory=stack", "learner.sequence=3", "learner.burn_in=4"),
                "learner.critic=team",
            ],
            marks=pytest.mark.heavy,
        ),
    ],
)
def test_held_actions_and_memories_are_resumed(more, whole, tmp_path):
    """The run stops within an episode, and at its end."""
    held = *more, "policy.hold=2", "env.failures=1"
    assert_same(whole("consensus", *held), stopped_at([10, 26, 40], "consensus", tmp_path, *held))


@pytest.mark.heavy
def test_a_run_can_be_stopped_at_any_step(whole, tmp_path):
    """Stops a run every 5 steps, so within, at and after the end of every episode."""
    steps, evaluated = list(range(5, HORIZON * EPISODES, 5)), "evaluation.interval=2"
    assert_same(whole("consensus", evaluated), stopped_at(steps, "consensus", tmp_path, evaluated))


@pytest.mark.heavy
def test_several_updates_a_step_and_the_released_setup(whole, tmp_path):
    more = ["setup=released", "learner.updates_per_step=3"]
    assert_same(whole("consensus", *more), stopped_at([9, 50], "consensus", tmp_path, *more))


def test_the_folder_of_any_seed_can_be_resumed(tmp_path):
    trainer = until(begun("independent", tmp_path, "seeds=[4,5]"), 25)
    again = resume(trainer.runs[1].path)
    assert [run.path for run in again.runs] == [run.path.absolute() for run in trainer.runs]
    assert again.setup.step == 25
    again.close()
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for run in trainer.runs:
        shutil.move(run.path, moved)
    until(resume(moved / trainer.run.path.name), None)
    shutil.rmtree(moved / trainer.runs[1].path.name)
    with pytest.raises(ValueError, match=r"is missing; its seed"):
        resume(moved / trainer.run.path.name)


def test_a_stack_is_resumed_after_only_one_configuration_was_changed(tmp_path):
    trainer = until(begun("independent", tmp_path, "seeds=[4,5]"), 25)
    first, second = trainer.runs
    first.write_config(replace(first.config(), episodes=5))
    resume(second.path).close()
    assert [run.config().episodes for run in trainer.runs] == [5, 5]
    second.write_config(replace(second.config(), num_envs=3))
    with pytest.raises(ValueError, match="not of the run of"):
        resume(first.path)


def test_a_folder_with_characters_that_cannot_be_printed_is_resumed_again(paused, tmp_path):
    folder = paused.rename(tmp_path / "run\u3000one")
    until(resume(folder), 35)
    until(resume(folder), 45)
    for state in RunFolder(folder).states()[:-1]:
        state.unlink()
    resume(folder).close()


def test_a_state_of_another_name_becomes_a_checkpoint(paused):
    run = RunFolder(paused)
    (state,) = run.states()
    mine = state.rename(state.with_name("state_mine.safetensors"))
    trainer = resume(mine)
    trainer.close()
    assert [path.name for path in run.states()] == ["state_000000030.safetensors"]
    assert mine.exists()
    resume(paused).close()


def test_metrics_after_the_checkpoint_are_truncated_and_repeated(whole, tmp_path):
    trainer = until(begun("positional", tmp_path, "checkpoint_steps=7"), 45)
    run = trainer.run
    (run.checkpoints / "state_000000045.safetensors").unlink()
    (run.checkpoints / "state_000000049.safetensors.17.part").write_bytes(b"half a file")
    (run.checkpoints / ".tmpQ3x9Zk").write_bytes(b"half a file of safetensors'")
    (run.path / "metrics.jsonl").open("a").write('{"episode": 3, "upd')
    again = resume(run.path)
    assert again.setup.step == 42
    left = {path.name for path in run.checkpoints.iterdir()}
    assert "step_000000045.safetensors" not in left
    assert not [name for name in left if name.endswith(".part") or name.startswith(".tmp")]
    assert len(run.lines()) == (run.path / "metrics.jsonl").read_text().count("\n") == 2
    assert_same(whole("positional"), until(again, None))


def test_a_run_without_a_checkpoint_restarts(whole, tmp_path):
    trainer = until(begun("consensus", tmp_path), 30)
    for path in trainer.run.states() + trainer.run.networks():
        path.unlink()
    again = resume(trainer.run.path)
    assert (again.setup.step, trainer.run.lines()) == (0, [])
    assert_same(whole("consensus"), until(again, None))


def test_additional_episodes_equal_those_of_a_longer_run(whole, tmp_path):
    """Includes a replay buffer that was full and becomes larger."""
    roomy = "learner.buffer_size=100000"
    short = until(begun("shared_memory", tmp_path, roomy, "episodes=2"), None)
    assert len(replay(short)) == replay(short).capacity == 2 * 2 * HORIZON
    again = resume(short.run.path, overrides=[f"episodes={EPISODES}"])
    assert_same(whole("shared_memory", roomy), until(again, None))
    assert RunFolder(short.run.path).config().episodes == EPISODES


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["env.num_uavs=3"], "env.num_uavs=3: the run has env.num_uavs=2"),
        (["learner.gamma=0.5"], "learner.gamma=0.5"),
        (["seed=9"], "seed=9"),
        (["output=elsewhere"], "output=elsewhere"),
        (["setup=tuned"], "setup=tuned: the run has setup=paper"),
        (["fire=huygens"], "fire=huygens: the run has fire=paper"),
        (["episodes=1"], "episodes=1: the run has done 1.5"),
        (["keep_checkpoint=3"], "'keep_checkpoint' is not known; did you mean keep_checkpoints?"),
        (["keep_checkpoints=0"], "keep_checkpoints=0"),
    ],
)
def test_settings_of_the_training_are_kept(overrides, message, paused, capsys):
    older = RunFolder(paused).states()[0].with_name("state_000000010.safetensors")
    older.write_bytes(b"")
    before = contents(paused)
    assert main.main(["train", f"resume={paused}", *overrides]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert "the one before it" not in error  # the newest one is not damaged
    assert contents(paused) == before


@pytest.fixture(scope="module")
def _paused(tmp_path_factory) -> Path:
    return until(begun("consensus", tmp_path_factory.mktemp("paused")), 30).run.path


@pytest.fixture
def paused(_paused, tmp_path) -> Path:
    """Returns a copy of a run that was stopped at step 30."""
    return Path(shutil.copytree(_paused, tmp_path / "paused"))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_command_resumes_and_reports_a_finished_run(paused, whole, capsys):
    quiet = ["evaluation.episodes=2", "checkpoint_interval=1", "keep_checkpoints=2", "setup=paper"]
    assert main.main(["train", "positional", f"resume={paused}"]) == 2
    assert "the run is of method 'consensus'" in capsys.readouterr().err
    assert main.main(["train", "consensus", f"resume={paused}", *quiet]) == 0
    assert "resumed at step 30 of 80" in capsys.readouterr().out
    uninterrupted = (whole("consensus").run.path / "metrics.jsonl").read_bytes()
    assert (paused / "metrics.jsonl").read_bytes() == uninterrupted
    assert len(RunFolder(paused).networks()) == 2
    before = contents(paused)
    assert main.main(["train", f"resume={paused}"]) == 0
    out = capsys.readouterr().out
    assert "is finished" in out
    assert "note: " not in out
    assert contents(paused) == before
    assert main.main(["train", f"resume={paused}", "evaluation.episodes=1"]) == 0
    note = "note: eval.json is that of the earlier settings of evaluations; for another one: "
    assert f"{note}emberlink eval {paused}\n" in capsys.readouterr().out


def test_another_version_of_a_package_gives_a_warning(paused, capsys):
    state = RunFolder(paused).states()[-1]
    sealed_again(state, lambda header, _: header["versions"].update(torch="1.0", vmas="1.4"))
    assert main.main(["train", f"resume={paused}", "evaluation.episodes=2"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    expected = f"made with torch 1.0 (now {torch.__version__}), vmas 1.4 (now not installed): the"
    assert expected in out


def test_a_state_with_numbers_of_eight_bits_is_refused(paused, capsys):
    def narrow(_, tensors: dict[str, torch.Tensor]) -> None:
        name = next(name for name, value in tensors.items() if value.is_floating_point())
        tensors[name] = tensors[name].to(torch.float8_e4m3fn)

    (state,) = RunFolder(paused).states()
    sealed_again(state, narrow)
    assert main.main(["train", f"resume={paused}"]) == 2
    error = capsys.readouterr().err
    assert f"{state}: does not fit this training: " in error
    assert error.count("\n") == 1


def test_networks_of_an_incomplete_save_are_removed(tmp_path):
    more = ["checkpoint_steps=9", "keep_checkpoints=2"]
    run = until(begun("independent", tmp_path, *more), None).run
    kept = run.networks()
    shutil.copy(kept[0], kept[0].with_name("step_000000054.safetensors"))
    resume(run.path).close()
    assert run.networks() == kept


def test_folders_that_cannot_be_resumed(paused, tmp_path, capsys):
    def refused(path: Path | str, *words: str) -> None:
        assert main.main(["train", f"resume={path}"]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        for word in words:
            assert word in error

    refused("", "one run folder")
    refused(tmp_path / "none", "no such run folder")
    refused(tmp_path, "config.yaml is missing")
    lines = (paused / "metrics.jsonl").read_text()
    (paused / "metrics.jsonl").write_text(lines[:-5])
    refused(paused, "metrics.jsonl", "1 lines")
    (paused / "metrics.jsonl").write_text("#" + lines[1:-1] + "x")
    refused(paused, "metrics.jsonl", "1 lines")
    (paused / "metrics.jsonl").write_text(lines)
    RunFolder(paused).states()[0].unlink()
    refused(paused, "holds networks alone", "emberlink eval")


@pytest.mark.heavy
def test_a_tracker_continues_from_the_checkpoint(tmp_path):
    def table(trainer: Trainer) -> str:
        return (trainer.run.path / "metrics.csv").read_text()

    more = ["logger=csv", "evaluation.interval=0"]
    whole_run = until(begun("independent", tmp_path / "a", *more), None)
    two = until(begun("independent", tmp_path / "b", *more, "checkpoint_interval=1"), 70)
    for path in [two.run.state(70), *two.run.networks()[-1:]]:
        path.unlink()  # like a killed run: the csv table contains later episodes
    assert table(whole_run) == table(until(resume(two.run.path), None))
    assert len(table(whole_run).splitlines()) == 1 + EPISODES


def test_old_checkpoints_are_removed_except_the_best(tmp_path):
    more = ["checkpoint_steps=9", "keep_checkpoints=3", "evaluation.interval=1"]
    trainer = until(begun("consensus", tmp_path, *more), None)
    run = trainer.run
    assert [path.stem[-3:] for path in run.networks()] == ["063", "072", "080"]
    assert [path.stem[-3:] for path in run.states()] == ["072", "080"]
    header = checkpoint_file.read_header(run.checkpoints / "best.safetensors")
    held_out = [line["huygens/coverage"] + line["paper/coverage"] for line in run.lines()]
    assert header["step"] == HORIZON * (1 + held_out.index(max(held_out)))


@pytest.mark.heavy
def test_tensorboard_replaces_repeated_episodes(tmp_path):
    """A run killed before its first checkpoint repeats all four episodes."""
    trainer = until(begun("independent", tmp_path, "logger=tensorboard"), 70)
    for path in trainer.run.states() + trainer.run.networks():
        path.unlink()
    until(resume(trainer.run.path), None)
    events = EventAccumulator(str(trainer.run.path / "tensorboard"))
    events.Reload()
    assert [event.step for event in events.Scalars("mean_reward")] == [1, 2, 3, 4]


@pytest.mark.heavy
def test_wandb_keeps_the_name_of_the_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "offline")
    trainer = until(begun("independent", tmp_path / "runs", "logger=wandb"), 25)
    until(resume(trainer.run.path), None)
    folders = sorted((trainer.run.path / "wandb").glob("offline-run-*"))
    # offline-run-TIME-NAME, and -1 for a second one within a second
    assert len({folder.name.split("-")[3] for folder in folders}) == 1


def test_the_best_networks_have_the_least_of_a_measure_of_which_less_is_better(tmp_path):
    more = ["evaluation.headline=tracking_last", "evaluation.interval=1"]
    trainer = begun("independent", tmp_path, *more)
    for measured in (30.0, 20.0, 25.0):
        trainer._keep_best(0, {"huygens/tracking_last": measured, "paper/tracking_last": measured})
    assert trainer.best == [20.0]
    trainer.close()
