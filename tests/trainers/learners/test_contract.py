"""Tests that every learner goes through every command, with memories and held actions."""

import json
from functools import cache
from pathlib import Path

import pytest
import torch
from inside import Inside
from rich.console import Console
from torchrl.envs import ExplorationType, set_exploration_type, step_mdp
from unpack_replay import data_of

from emberlink.envs import keys, parallel_env
from emberlink.policies.gaussian import MEMORY
from emberlink.trainers import compare, load, make_env
from emberlink.trainers.cli import main
from emberlink.trainers.evaluation.evaluate import play
from emberlink.trainers.replay.recording import Recorder
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep.command import sweep

HORIZON = 20
SMALL = [
    *("setup=tuned", f"env.horizon={HORIZON}", "env.num_uavs=3", "num_envs=4", "episodes=2"),
    *("learner.hidden=[8,8]", "evaluation.interval=1", "evaluation.interval_episodes=2"),
    *("evaluation.episodes=2", "evaluation.scripted=[lawnmower]"),
]
CASES = {
    "ddpg": ["learner=ddpg", "policy.hold=5", "learner.batch_size=8"],
    "td3": ["learner=td3", "policy.agent_index=true", "learner.batch_size=8"],
    "ippo": ["learner=ippo", "policy.memory=gru", "policy.hold=5"],
    "mappo": ["learner=mappo", "policy.memory=stack", "policy.agent_index=true"],
    "ddpg-gru": [
        *("learner=ddpg", "policy.memory=gru", "policy.hold=2", "learner.batch_size=8"),
        *("learner.sequence=4", "learner.burn_in=3"),
    ],
    "ddpg-team": ["learner=ddpg", "learner.critic=team", "learner.batch_size=8"],
    "td3-team": [
        *("learner=td3", "policy.memory=stack", "learner.critic=team", "learner.batch_size=8"),
        *("learner.sequence=4", "learner.burn_in=3", "learner.share_parameters=true"),
    ],
    "mappo-gru": ["learner=mappo", "policy.memory=gru", "policy.hold=10"],
    "mappo-map": ["learner=mappo", "learner.critic_map=true", "policy.hold=4"],
    "ippo-own": ["learner=ippo", "policy.memory=gru", "learner.share_parameters=false"],
    "imitation": ["learner=imitation", "policy.hold=5", "learner.samples=8"],
    "imitation-gru": [
        *("learner=imitation", "policy.memory=gru", "policy.hold=2", "learner.samples=8"),
        *("learner.sequence=4", "learner.burn_in=3"),
    ],
}
IN_CI = {"ddpg", "td3", "ippo", "mappo", "ddpg-gru", "mappo-gru", "imitation-gru"}
EACH = [case if case in IN_CI else pytest.param(case, marks=pytest.mark.heavy) for case in CASES]


def method_of(case: str, method: str = "consensus") -> str:
    """Returns the method of a case: imitation has a teacher for `maps` only."""
    return "maps" if case.startswith("imitation") else method


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Returns a function that gives the run folder of a case, trained by the command."""

    @cache
    def of(case: str) -> Path:
        folder = tmp_path_factory.mktemp(case)
        arguments = [method_of(case), *SMALL, *CASES[case], f"output={folder}"]
        assert main.main(["train", *arguments]) == 0
        (run,) = folder.iterdir()
        return run

    return of


pytestmark = pytest.mark.slow


@pytest.mark.parametrize("case", EACH)
def test_a_run_trains_and_its_evaluation_can_be_repeated(case, trained, capsys):
    run = trained(case)
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert len(lines) == 2
    for line in lines:
        losses = {key for key in line if key.startswith("loss_")}
        imitates = case.startswith("imitation")
        assert losses >= ({"loss_imitation"} if imitates else {"loss_actor", "loss_critic"})
        assert line.keys() >= {"coverage", "huygens/coverage"}
    before = json.loads((run / "eval.json").read_text())["results"]
    assert main.main(["eval", str(run)]) == 0
    assert json.loads((run / "eval.json").read_text())["results"] == before
    capsys.readouterr()


@pytest.mark.parametrize("case", EACH)
def test_a_loaded_policy_needs_no_further_code(case, trained):
    """TorchRL's rollout, PettingZoo and the evaluation give the same episode."""
    policy = load(trained(case))

    def env():
        return make_env(policy.config, num_envs=1, seed=7)

    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        rollout = env().rollout(HORIZON, policy)
    flight = rollout["next", *keys.POSITION][0]
    assert flight.shape == (HORIZON, 3, 3)
    measured = play(env(), policy)
    assert measured["coverage"].isfinite().all()
    recorder = Recorder()
    play(env(), policy, recorder.add)
    assert recorder.recording().steps["position"][-1].tolist() == flight[-1].tolist()
    pettingzoo = parallel_env(env())
    pettingzoo.reset()
    for step in range(HORIZON):
        *_, infos = pettingzoo.step(pettingzoo.act(policy))
        for uav in range(3):
            assert infos[f"uav_{uav}"]["position"].tolist() == flight[step, uav].tolist()
    assert not pettingzoo.agents


@pytest.mark.parametrize(
    "case",
    ["ippo", "mappo", "mappo-gru", "ddpg-gru", pytest.param("td3-team", marks=pytest.mark.heavy)],
)
def test_an_episode_that_begins_again_forgets_the_one_before(case, trained):
    """Environment 0 begins again after 8 steps; environment 1 goes on."""
    policy = load(trained(case))
    env = make_env(policy.config, num_envs=2, seed=7)
    with torch.no_grad():
        td = env.reset()
        for _ in range(8):
            td = step_mdp(env.step(policy(td)))
        before = td.clone()
        td = env.reset(td.set("_reset", torch.tensor([[True], [False]])))
        fresh = policy(td.exclude(MEMORY, ("agents", "held")).clone())
        acted, unchanged = policy(td.clone()), policy(before)
    for key in (keys.ACTION, MEMORY):
        assert acted[key][0].equal(fresh[key][0])
        assert acted[key][1].equal(unchanged[key][1])
    assert acted[MEMORY].any()


ALL = pytest.param(["ddpg", "td3", "ippo", "mappo", "imitation"], marks=pytest.mark.heavy)


@pytest.mark.parametrize("cases", [ALL, ["ddpg-gru", "ippo"]])
def test_runs_of_all_learners_are_rendered_and_compared(cases, trained, tmp_path, capsys):
    """A page shows the first episode of the evaluation."""
    runs = [trained(case) for case in cases]
    film, page = tmp_path / "film.gif", tmp_path / "page.html"
    for output in (film, page):
        assert main.main(["render", *map(str, runs), "--output", str(output)]) == 0
    assert film.stat().st_size > 1000
    for run, panel in zip(runs, data_of(page.read_text())["panels"], strict=True):
        evaluated = json.loads((run / "eval.json").read_text())["results"]["huygens"]["learned"]
        covered = 100 * panel["seen"][0][-1] / panel["burnt"][0][-1]
        assert covered == pytest.approx(evaluated["coverage"][0], rel=1e-6)
        rewards = [sum(uav[1:]) / HORIZON for uav in panel["reward"]]
        assert sum(rewards) / 3 == pytest.approx(evaluated["mean_reward"][0], rel=1e-5)
    comparison = compare(runs)
    assert comparison.runs["label"].nunique() == len(cases)
    capsys.readouterr()


@pytest.mark.heavy
@pytest.mark.parametrize("learners", [["ippo", "mappo"], ["td3"]])
def test_a_sweep_over_learners(learners, tmp_path, capsys):
    own = [] if "ippo" in learners else ["learner.batch_size=8"]
    swept = [f"learner={','.join(learners)}", "seed=0,1", "evaluation.episodes=1"]
    arguments = ["independent", *SMALL, *own, *swept, f"output={tmp_path}"]
    assert sweep(arguments, Console(quiet=True), executor=Inside()) == 0
    runs = [RunFolder(path.parent) for path in tmp_path.glob("*/config.yaml")]
    assert sorted((run.config().learner.name, run.config().seed) for run in runs) == [
        (learner, seed) for learner in learners for seed in (0, 1)
    ]
    assert all(run.evaluated() for run in runs)
    capsys.readouterr()


SIDE_BY_SIDE = [case for case in CASES if case != "ddpg"]  # that of ddpg is in test_seeds.py


@pytest.mark.heavy
@pytest.mark.parametrize("case", SIDE_BY_SIDE)
def test_seeds_side_by_side_learn_the_same_as_alone(case, tmp_path):
    method = method_of(case, "independent")
    settings = ["train", method, *SMALL, *CASES[case], "evaluation.interval=0"]
    assert main.main([*settings, "seeds=[3,11]", f"output={tmp_path / 'both'}"]) == 0
    both = sorted((tmp_path / "both").iterdir(), key=lambda run: RunFolder(run).config().seed)
    for seed, run in zip((3, 11), both, strict=True):
        assert main.main([*settings, f"seed={seed}", f"output={tmp_path / str(seed)}"]) == 0
        (alone,) = (tmp_path / str(seed)).iterdir()
        lines = zip(RunFolder(run).metrics(), RunFolder(alone).metrics(), strict=True)
        for line, single in lines:
            assert line == pytest.approx(single, rel=1e-3, abs=1e-3)
        together, own = load(run).module[0], load(alone).module[0]
        for stacked, single in zip(together.parameters(), own.parameters(), strict=True):
            torch.testing.assert_close(stacked, single, rtol=1e-3, atol=1e-4)
