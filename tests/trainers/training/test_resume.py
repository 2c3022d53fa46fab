"""Tests that a stopped and resumed run equals the uninterrupted run bit for bit."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from refusal import refused
from test_recipes import METHODS

from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.runs import checkpoint
from emberlink.trainers.runs.run_folder import BEST, METRICS, NEWEST, RunFolder
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.trainer import Progress, Trainer

HORIZON, EPISODES = 10, 4
SMALL = [
    *(f"env.horizon={HORIZON}", f"episodes={EPISODES}", "env.num_uavs=2", "num_envs=2"),
    *("learner.hidden=[8,8]",),
    *("evaluation.interval=0", "evaluation.interval_episodes=1", "evaluation.episodes=1"),
    "evaluation.scripted=[]",
]
# A replay buffer of 30 rows is full after 15 of the 40 steps.
REPLAY = ["learner.batch_size=16", "learner.buffer_size=30"]
GRU = ["policy.memory=gru", "policy.units=6"]
FEW = ["learner.epochs=2", "learner.minibatches=2"]
LEARNERS = {
    "ddpg": ["learner=ddpg", *REPLAY],
    "td3": ["learner=td3", *REPLAY, "learner.critic=team"],
    "ippo": ["learner=ippo", *FEW, *GRU, "learner.share_parameters=false"],
    "mappo": ["learner=mappo", *FEW, *GRU, "learner.critic_map=true"],
    "imitation": ["learner=imitation", "learner.samples=8", "learner.buffer_size=30"],
}


def begun(method: str, output: Path, *more: str) -> Trainer:
    trainer = Trainer(resolve(method, [*SMALL, *more, f"output={output}"]))
    trainer.start()
    return trainer


def until(trainer: Trainer, step: int | None) -> Trainer:
    """Trains until a step, or to the end."""

    def watch(progress: Progress) -> None:
        if progress.step == step:
            trainer.stop()

    trainer.train(watch)
    trainer.close()
    return trainer


def stopped_at(steps: list[int], method: str, output: Path, *more: str) -> Trainer:
    """Trains a run that is stopped and resumed at the given steps, to its end."""
    trainer = until(begun(method, output, *more), steps[0])
    for step in [*steps[1:], None]:
        trainer = until(resume(trainer.run.path), step)
    return trainer


def assert_same(run: Trainer, other: Trainer) -> None:
    """Checks that two finished runs have the same metrics, weights and training state."""
    assert [line["episode"] for line in run.run.metrics()] == [1, 2, 3, 4]
    first, second = run.run.path, other.run.path
    assert (first / METRICS).read_bytes() == (second / METRICS).read_bytes()
    for name in (NEWEST, BEST):
        a, b = (checkpoint.read_tensors(path / name) for path in (first, second))
        assert a.keys() == b.keys()
        for key, value in a.items():
            # As bytes: NaN equals NaN, and 0 differs from -0.
            assert value.numpy().tobytes() == b[key].numpy().tobytes(), f"{name}: {key}"


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


# Before the first update; within, at and after the end of an episode; before the last step.
@pytest.mark.parametrize(
    ("method", "learner", "steps"),
    [
        ("independent", "ddpg", [1, 17]),
        ("consensus", "ippo", [10, 30]),
        ("maps", "imitation", [17, 20, 39]),
        pytest.param("maps", "ddpg", [1, 17, 39], marks=pytest.mark.heavy),
        *(
            pytest.param(method, learner, [10, 20], marks=pytest.mark.heavy)
            for method in METHODS
            for learner in LEARNERS
            if learner != "imitation"
        ),
    ],
)
def test_a_resumed_run_equals_the_uninterrupted_run(method, learner, steps, whole, tmp_path):
    more = [*LEARNERS[learner], *(["env.map.pixels=8"] if method == "maps" else [])]
    assert_same(whole(method, *more), stopped_at(steps, method, tmp_path, *more))


# A sensor that misses cells, maps as observations, exchanged maps and messages that are learned.
FRONT = [
    *("world=front", "learner=mappo", "fire.num_train_fires=2", "env.radio.range=60"),
    *("env.radio.loss=0.3", "env.map.pixels=8", "policy.hold=2", "policy.message_size=4"),
]
MAP = ["env.observation=map"]


@pytest.mark.parametrize(
    ("method", "more"),
    [
        ("independent", [*GRU, "policy.message=attention", "env.radio.delay=5"]),
        ("maps", ["policy.message=mean"]),
        *(
            pytest.param(*case, marks=pytest.mark.heavy)
            for case in (
                ("consensus", [*GRU, "policy.message=mean"]),
                ("independent", [*MAP, "policy.message=attention"]),
                ("independent", [*MAP, *LEARNERS["imitation"], *GRU, "policy.message=attention"]),
            )
        ),
    ],
)
def test_messages_maps_and_the_sensor_are_resumed(method, more, whole, tmp_path):
    more = [*FRONT, *more]
    assert_same(whole(method, *more), stopped_at([4, 10, 18], method, tmp_path, *more))


LATE = ["env.radio.delay=5", "env.radio.bandwidth=200", "env.radio.loss=0.3", "env.radio.burst=4.0"]


@pytest.mark.parametrize("method", ["consensus", "maps"])
def test_messages_in_flight_are_resumed(method, whole, tmp_path):
    more = [*REPLAY, *LATE, "env.base=[3, 3]", "env.measures=all", "env.radio.range=60"]
    more += ["env.map.pixels=8"] if method == "maps" else []
    assert_same(whole(method, *more), stopped_at([7, 17, 31], method, tmp_path, *more))


def test_held_actions_failures_and_evaluations_are_resumed(whole, tmp_path):
    more = *REPLAY, "policy.hold=2", "env.failures=1", "evaluation.interval=2", "checkpoint_steps=7"
    assert_same(whole("consensus", *more), stopped_at([6, 22, 30], "consensus", tmp_path, *more))


def test_what_a_killed_process_left_is_removed(whole, tmp_path):
    trainer = begun("positional", tmp_path, *REPLAY, "checkpoint_steps=7")

    def die(progress: Progress) -> None:
        if progress.step == 31:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trainer.train(die)
    trainer.close()
    run = trainer.run
    assert len(run.metrics()) == 3  # the checkpoint is of step 28, within the third episode
    (run.path / f"{NEWEST}.17.part").write_bytes(b"half a file")
    (run.path / ".tmpQ3x9Zk").write_bytes(b"half a file of safetensors'")
    (run.path / METRICS).open("a").write('{"episode": 4, "upd')
    (run.path / "thesis.part").write_text("mine")
    again = resume(run.path)
    assert (again.setup.step, len(run.metrics())) == (28, 2)
    left = {path.name for path in run.path.iterdir()}
    assert left == {*("config.yaml", METRICS, NEWEST, BEST, "lock", "thesis.part")}
    assert_same(whole("positional", *REPLAY), until(again, None))


def test_a_run_without_a_checkpoint_begins_again(whole, tmp_path):
    run = until(begun("consensus", tmp_path, *REPLAY), 15).run
    run.newest.unlink()
    again = resume(run.path)
    assert (again.setup.step, run.metrics()) == (0, [])
    assert_same(whole("consensus", *REPLAY), until(again, None))
    run.newest.unlink()
    run.write_config(replace(again.config, checkpoint_interval=2))  # it has had one
    with pytest.raises(ValueError, match=f"holds no {NEWEST}"):
        resume(run.path)


def test_additional_episodes_equal_those_of_a_longer_run(whole, tmp_path):
    """Includes a replay buffer that was full and becomes larger."""
    roomy = "learner.batch_size=16", "learner.buffer_size=100000"
    run = until(begun("shared_memory", tmp_path, *roomy, "episodes=2"), None).run
    again = resume(run.path, overrides=[f"episodes={EPISODES}"])
    again.close()  # as if killed: the next resume knows the number of episodes
    assert_same(whole("shared_memory", *roomy), until(resume(run.path), None))
    assert run.values()["episodes"] == run.config().episodes == EPISODES


@pytest.fixture(scope="module")
def _paused(tmp_path_factory) -> Path:
    return until(begun("consensus", tmp_path_factory.mktemp("paused"), *REPLAY), 15).run.path


@pytest.fixture
def paused(_paused, tmp_path) -> Path:
    """Returns a copy of a run that was stopped at step 15."""
    return Path(shutil.copytree(_paused, tmp_path / "paused"))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_command_resumes_and_reports_a_finished_run(paused, whole, capsys):
    (paused / "config.yaml").write_text("learner: edited\n")  # the checkpoint holds the settings
    assert main.main(["train", f"resume={paused}", "evaluation.episodes=2"]) == 0
    assert "resumed at step 15 of 40" in capsys.readouterr().out
    uninterrupted = (whole("consensus", *REPLAY).run.path / METRICS).read_bytes()
    assert (paused / METRICS).read_bytes() == uninterrupted
    before = contents(paused)
    assert main.main(["train", f"resume={paused}"]) == 0
    assert "is finished" in capsys.readouterr().out
    assert contents(paused) == before
    (paused / "eval.json").unlink()
    assert main.main(["train", f"resume={paused}"]) == 0
    assert RunFolder(paused).evaluated()


def test_what_cannot_be_resumed_is_left_as_it_is(paused, tmp_path, capsys):
    def check(path: Path | str, *words: str, override: str = "evaluation.episodes=1") -> None:
        before = contents(paused)
        refused(["train", f"resume={path}", override], capsys, *words)
        assert contents(paused) == before

    check(paused, "env.num_uavs=3: the run has env.num_uavs=2", override="env.num_uavs=3")
    check(paused, "setup=tuned: the run has setup=paper", override="setup=tuned")
    check(paused, "episodes=1: the run has done 1.5", override="episodes=1")
    check(tmp_path, "config.yaml is missing")
    lines = (paused / METRICS).read_text()
    (paused / METRICS).write_text(lines[:-5])
    check(paused, METRICS, "1 episodes of the checkpoint")
    (paused / METRICS).write_text(lines)
    run, content = RunFolder(paused), RunFolder(paused).newest.read_bytes()
    run.newest.write_bytes(content[:-10])
    check(paused, str(run.newest))
    shutil.copy(run.path / BEST, run.newest)
    check(paused, "holds networks alone")


def test_the_best_networks_are_chosen_anew_by_another_measure(paused):
    (line,) = RunFolder(paused).metrics()
    for text, best in (("episodes=5", line["coverage"]), ("evaluation.headline=exits", None)):
        trainer = resume(paused, overrides=[text.replace("exits", "tracking_last")])
        trainer.close()
        assert trainer.best == best
