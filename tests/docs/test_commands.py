"""Runs the commands of the documentation, shortened; trainings are built and not run."""

import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from fire_files import Ellipses, frame_of, raster_of, write_asc, write_tif

from emberlink.trainers.cli.main import main
from emberlink.trainers.comparison import bootstrap
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.setup import TrainingSetup

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
VARIABLES = re.compile(r"^(?:[A-Z_]+=\S+ )+")
YAML = r"`(?:\w+/)*((?:method|setup|setup_method|world|learner)/\w+\.yaml)`[^`]*```yaml\n(.*?)```"
ENTRY_POINTS = """[emberlink.comm]
headcount = extensions_block:Headcount
visited = communication_block:Visited
[emberlink.learners]
sac = extensions_block:SAC
[emberlink.memory]
fading = learners_block:Fading
[emberlink.scripted]
gather = extensions_block:Gather
"""
BLOCKS = {"communication": 1, "extensions": 3, "learners": 1, "worlds": 0}
"""the number of Python blocks of a page, from its first, that make up a module"""


def commands_of(page: Path) -> Iterator[str]:
    """Yields the commands of a page: indented lines, without comments and continued lines."""
    text = page.read_text().replace("\\\n", " ")
    for line in re.findall(r"^    (.*)$", text, re.MULTILINE):
        command = VARIABLES.sub("", re.sub(r"\s+#.*$", "", line)).strip()
        if command.startswith("emberlink ") and not command.split()[1].endswith(":"):
            yield re.sub(r"\s+", " ", command)


def is_synopsis(command: str) -> bool:
    """Returns whether a line describes arguments, such as `emberlink fire import FILE…`."""
    return bool(re.search(r" \[(-|key)|FILE…|\bMETHOD\b", command))


COMMANDS = sorted({c for page in PAGES for c in commands_of(page) if not is_synopsis(c)})


@pytest.fixture(scope="module")
def prepared(tmp_path_factory) -> Path:
    """Makes a folder with the fires, YAML files and modules that the commands read."""
    folder = tmp_path_factory.mktemp("docs")
    fire = Ellipses()
    write_asc(folder / "ArrivalTime.asc", raster_of(fire, 240))
    seconds = raster_of(fire, 240)
    seconds[seconds > 0] *= 60
    write_tif(folder / "time_of_arrival.tif", seconds, crs=None)
    frame_of(fire, range(60, 301, 60)).to_file(folder / "Perimeters.shp")
    days = frame_of(fire, (60, 120, 240)).rename(columns={"Elapsed_Mi": "DateCurrent"})
    days["DateCurrent"] = [f"2020-08-{day}T13:00:00" for day in (18, 19, 20)]
    days.to_file(folder / "perimeters.geojson")
    for page, count in BLOCKS.items():
        text = (ROOT / "docs" / f"{page}.md").read_text()
        for name, content in re.findall(YAML, text, re.DOTALL):
            (folder / "mine" / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / "mine" / name).write_text(content)
        blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[:count]
        (folder / f"{page}_block.py").write_text("\n".join(blocks))
    (folder / "mine.py").write_text("def act(observation):\n    return observation[..., :3]\n")
    (folder / "blocks-1.dist-info").mkdir()
    (folder / "blocks-1.dist-info" / "METADATA").write_text("Name: blocks\nVersion: 1\n")
    (folder / "blocks-1.dist-info" / "entry_points.txt").write_text(ENTRY_POINTS)
    return folder


@pytest.fixture
def place(prepared, finished, tmp_path, monkeypatch) -> Path:
    """Enters a copy of that folder with a finished run in runs/."""
    folder = Path(shutil.copytree(prepared, tmp_path / "here"))
    shutil.copytree(finished, folder / "runs" / "one")
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    # The same folder for all commands, so that each choice of files is composed once.
    monkeypatch.setenv("EMBERLINK_CONFIGS", str(prepared / "mine"))
    monkeypatch.setattr(bootstrap, "RESAMPLES", 200)
    return folder


BANK = ["--output", "bank.npy"]
PLACES = {"RUN": "runs/one", "runs/…": "runs/one", "runs/a": "runs/one", "runs/b": "runs/one"}


def shortened(words: list[str]) -> list[str]:
    """Returns the arguments of a shorter command for the folder of `place`."""
    verb, *rest = (PLACES.get(word, word) for word in words)
    rest = [
        re.sub("=(RUN|runs/…)$", "=runs/one", word).replace("BANK", "bank.npy") for word in rest
    ]
    rest = [re.sub("^docs/", f"{ROOT}/docs/", word) for word in rest]
    if any(word.startswith("resume=") for word in rest) or verb not in SHORT:
        return [verb, *rest]
    short = SHORT[verb](rest)
    return [verb, *short] if verb in ("train", "sweep", "render") else [verb, *rest, *short]


def _train(rest: list[str]) -> list[str]:
    """Returns the arguments of a training with few fires."""
    fires = ["fire.num_train_fires=2"] * (not any(word.endswith("=file") for word in rest))
    # A warm start needs a run of the same method: test_imitation.py tests it.
    return [*(word for word in rest if not word.startswith("learner.warm_start")), *fires]


def _eval(rest: list[str]) -> list[str]:
    is_run = rest[0].startswith("runs/")
    return ["--fires", "1", *([] if is_run else ["env.horizon=20"])]


def _tune(rest: list[str]) -> list[str]:
    return ["episodes=1", "num_envs=2", "env.horizon=50", "evaluation.interval=1", "--trials", "1"]


def _render(rest: list[str]) -> list[str]:
    """Returns the arguments of a render of three steps or two frames."""
    episodes: list[str] = []
    for word in rest:
        episodes += [word, "env.horizon=60"] if word.startswith("pretrained") else [word]
    return [*episodes, "--step", "3"] if "--step" in rest else [*episodes, "--frames", "2"]


SHORT = {
    "world": lambda _: ["env.horizon=5", "--fires", "2"],
    "train": _train,
    # Executors of clusters may not be installed.
    "sweep": lambda rest: [*(w for w in rest if not w.startswith("executor")), "--dry-run"],
    "eval": _eval,
    "tune": _tune,
    "render": _render,
}


def different(commands: list[str]) -> list[str]:
    """Returns commands that differ when they are shortened."""
    return list({tuple(shortened(shlex.split(c)[1:])): c for c in reversed(commands)}.values())


LONG = re.compile("emberlink (compare pretrained|world check|eval pretrained:maps world|doctor)")
"""beginnings of commands that take long"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        pytest.param(command, marks=pytest.mark.heavy if LONG.match(command) else ())
        for command in different(COMMANDS)
    ],
)
def test_a_command_of_the_documentation_runs(command, place):
    if "=BANK" in command:
        assert main(["fire", "import", "ArrivalTime.asc", "fire.units=minutes", *BANK]) == 0
    if ".onnx independent" in command:
        assert main(["export", "pretrained:strong/independent", "independent.onnx"]) == 0
    verb, *rest = shortened(shlex.split(command)[1:])
    if verb == "train" and "resume=" not in command:
        TrainingSetup(resolve(rest[0], rest[1:]))
    elif [verb, *rest][:2] == ["world", "check"]:
        # 1: a world of a few steps does not satisfy all conditions
        assert main([verb, *rest]) in (0, 1)
    else:
        assert main([verb, *rest]) == 0


def test_every_command_is_documented():
    verbs = {command.split()[1] for command in COMMANDS}
    assert {*SHORT, "compare", "export", "list", "doctor"} <= verbs
