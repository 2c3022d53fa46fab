"""Tests that networks learn from maps with every learner, and fly in teams and maps of any size."""

import json

import pytest
import torch

from emberlink.envs import keys
from emberlink.trainers import load, make_env
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.setup import TrainingSetup

SMALL = [
    *("env.horizon=8", "env.num_uavs=2", "num_envs=2", "episodes=4", "learner.hidden=[8,8]"),
    *("evaluation.interval=0", "evaluation.episodes=2", "evaluation.scripted=[]"),
    *("evaluation.huygens=false", "env.grid=[20,24]", "policy.units=4"),
]
OFF_POLICY = ["learner.batch_size=6", "learner.sequence=2", "learner.burn_in=2"]


@pytest.mark.parametrize(
    ("learner", "more"),
    [
        ("ddpg", []),
        ("mappo", ["learner.critic_map=true"]),
        ("ddpg", ["policy.memory=gru", "policy.hold=2"]),
        ("ippo", ["policy.memory=gru", "seeds=[0,1]"]),
        *(
            pytest.param(learner, more, marks=pytest.mark.slow)
            for learner, more in [
                ("td3", ["policy.memory=gru", "learner.critic=team"]),
                ("td3", []),
                ("ippo", ["learner.share_parameters=false"]),
                ("mappo", ["policy.memory=gru", "policy.hold=4"]),
                ("ddpg", ["policy.memory=stack", "policy.agent_index=true"]),
            ]
        ),
    ],
)
def test_every_learner_learns(learner, more):
    mine = OFF_POLICY if learner in ("ddpg", "td3") else []
    setup = TrainingSetup(resolve("maps", [f"learner={learner}", *SMALL, *mine, *more]))
    before = {name: weight.clone() for name, weight in setup.learner.weights().items()}
    setup.dry_run(16)
    assert setup.learner.updates
    after = setup.learner.weights()
    assert all(weight.isfinite().all() for weight in after.values())
    convolutions = [name for name in after if "encoder" in name and name.startswith("actor")]
    assert len(convolutions) == 12
    for name in convolutions:
        assert not after[name].equal(before[name]), name


def test_pictures_are_stored_as_bytes_in_a_bounded_buffer():
    config = resolve("maps", [*SMALL, *OFF_POLICY, "learner.buffer_size=20"])
    setup = TrainingSetup(config)
    setup.dry_run(16)
    stored = {k: v for k, v in setup.learner.state_dict().items() if k.startswith("replay/rows")}
    pictures = [value for name, value in stored.items() if name.endswith("crops")]
    assert [(value.dtype, value.shape) for value in pictures] == [
        (torch.uint8, (10, 2, 2, 8, 24, 24))
    ] * 2
    bytes_of_a_transition = sum(v.numel() * v.element_size() for v in stored.values()) / 20
    assert bytes_of_a_transition < 2 * 2 * 8 * 24 * 24 + 100


def trained(tmp_path, *more: str):
    assert main.main(["train", "maps", *SMALL, *OFF_POLICY, *more, f"output={tmp_path}"]) == 0
    (run,) = tmp_path.iterdir()
    return run


@pytest.mark.parametrize(
    "changes",
    [
        ["env.num_uavs=1", "env.grid=[20,20]"],
        pytest.param(["env.num_uavs=24", "env.grid=[128,100]"], marks=pytest.mark.heavy),
        ["env.num_uavs=3"],
        pytest.param(["env.num_uavs=64", "env.grid=[60,60]"], marks=pytest.mark.heavy),
        pytest.param(["env.grid=[128,128]"], marks=pytest.mark.heavy),
    ],
)
def test_a_trained_policy_flies_in_other_teams_and_maps(changes, tmp_path):
    run = trained(tmp_path)
    assert main.main(["eval", str(run), *changes, "--fires", "1"]) == 0
    (file,) = [path for path in run.glob("eval_*.json") if "env." in path.name]
    assert json.loads(file.read_text())


@pytest.mark.parametrize("uavs", [1, 3, 24, 64])
@pytest.mark.parametrize("grid", [[20, 20], [128, 128], [20, 128]])
def test_a_policy_of_six_uavs_acts_in_every_team_and_map(uavs, grid):
    """A UAV acts as it would with the same observation if it were alone."""
    policy = load("pretrained:maps", num_uavs=uavs, grid=grid)
    burning = torch.full(grid, torch.inf)
    burning[5:15, 5:15] = 1.0
    env = make_env(policy.config, num_envs=2, fire=burning, seed=1)
    flight = env.rollout(12, policy)
    assert flight[keys.ACTION].shape == (2, 12, uavs, 3)
    assert flight[keys.ACTION].isfinite().all()
    furthest = torch.tensor([*grid, policy.config.env.altitude[1] + 1]) - 1
    assert (flight["next", *keys.POSITION] <= furthest).all()
    decision = flight[:, 10].exclude(keys.ACTION)
    decision[keys.AGENTS] = decision[keys.AGENTS][:, -1:]
    alone = load("pretrained:maps", num_uavs=1)(decision)[keys.ACTION]
    torch.testing.assert_close(alone[:, 0], flight[keys.ACTION][:, 10, -1])


def test_weights_of_each_uav_fit_one_team_only(tmp_path, capsys):
    run = trained(tmp_path, "learner.share_parameters=false")
    capsys.readouterr()
    assert main.main(["eval", str(run), "env.num_uavs=3", "--fires", "1"]) == 2
    assert "uavs=2; this configuration has uavs=3" in " ".join(capsys.readouterr().err.split())


def test_weights_with_an_agent_index_fit_one_team_only(tmp_path, capsys):
    run = trained(tmp_path, "policy.agent_index=true")
    capsys.readouterr()
    assert main.main(["eval", str(run), "env.num_uavs=3", "--fires", "1"]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "this configuration has uavs=3 (env.num_uavs), and its networks read the index" in error


def test_observations_of_positional_fit_one_team_only(tmp_path, capsys):
    shared = ["learner.share_parameters=true", "learner.hidden=[8,8]", "env.horizon=10"]
    few = ["env.num_uavs=2", "episodes=1", "evaluation.episodes=1", "evaluation.scripted=[]"]
    assert main.main(["train", "positional", *shared, *few, f"output={tmp_path}"]) == 0
    (run,) = tmp_path.iterdir()
    capsys.readouterr()
    assert main.main(["eval", str(run), "env.num_uavs=3", "--fires", "1"]) == 2
    assert "env.num_uavs=2 (now 3)" in " ".join(capsys.readouterr().err.split())


def test_what_a_uav_observes_does_not_depend_on_the_team(tmp_path):
    shapes = set()
    for uavs, grid in ((1, "[20,20]"), (3, "[60,50]"), (24, "[128,128]")):
        config = resolve("maps", [f"env.num_uavs={uavs}", f"env.grid={grid}", "env.horizon=4"])
        spec = TrainingSetup(config).env.observation_spec
        shapes.add(tuple(map(tuple, keys.observation_shapes(spec))))
    assert shapes == {((2,), (2, 8, 24, 24))}
