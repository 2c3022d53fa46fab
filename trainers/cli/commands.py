"""Defines the commands and their arguments, except `fire` and `list`.

Their code is imported when they run, so that `emberlink --help` does not import torch.
"""

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from emberlink.envs.utils.config_files import find
from emberlink.trainers.cli.parser import between, command, command_group, path, positive, run_of

if TYPE_CHECKING:
    from rich.console import Console

EXTRAS = {  # of `compare`, beside its page
    "marl-eval": "marl_eval.json, training and held-out fires in the format of MARL-eval",
    "pdf": "the figures as PDF",
    "svg": "the figures as SVG",
}
_OVERRIDES: dict[str, Any] = {"metavar": "key=value", "nargs": "*", "default": []}
_REPEATABLE: dict[str, Any] = {"action": "append", "default": []}


def run_name(text: str) -> str:
    """Checks that the folder of a run exists; a text with `:` or `=` names none."""
    if not {":", "="} & {*text} and not path(text).exists():
        raise argparse.ArgumentTypeError(f"{text}: there is no such run folder")
    return text


def add_train(commands: Any) -> None:
    text = """train one of the methods and evaluate it
    Trains a method, evaluates the frozen policies on test fires, and writes a run folder with
    config.yaml, metrics.jsonl, checkpoints, eval.json, figures, GIF and replay page.
    emberlink train consensus setup=tuned episodes=20 seed=1
    """
    usage = "emberlink train METHOD | resume=RUN [key=value ...]"
    add = command(commands, "train", _checked("training.command:train"), text, usage=usage)
    method = "a method of emberlink list methods; or resume=RUN, to resume the training of a run"
    add("method", metavar="METHOD", help=method)
    keys = "any key of configs/base.yaml, such as setup=tuned, fire=huygens, seed=1, env.num_uavs=3"
    add("overrides", help=keys, **_OVERRIDES)


def _checked(place: str) -> Callable[[argparse.Namespace, "Console"], int]:
    """Returns a function that runs `place` (see `run_of`).

    It reports a wrong name or key before torch is imported, which takes seconds.
    """

    def run(options: argparse.Namespace, console: "Console") -> int:
        method, overrides = options.method, options.overrides
        if not method.startswith("resume="):
            find("method", method)
            from emberlink.trainers.config.values import composed  # imports Hydra

            composed(method, overrides)
        return run_of(place)(options, console)

    return run


def add_eval(commands: Any) -> None:
    text = """evaluate the frozen policies of a run, or a policy of your own
    Plays the policies of a run's newest checkpoint and the scripted ones on the same test
    fires, prints a table, and writes eval.json, figures, GIF and replay page to the run. A
    policy of your own gets a run folder, which compare and render read.
    emberlink eval mine.py:act independent setup=tuned --name mine
    """
    usage = "emberlink eval RUN | POLICY METHOD --name NAME [key=value ...]"
    add = command(commands, "eval", "evaluation.evaluate_run:run_command", text, usage=usage)
    run = "a run folder or pretrained:METHOD; or a policy: file.py:NAME, module:NAME or file.onnx"
    add("folder", metavar="RUN | POLICY", type=run_name, help=run)
    add(
        "overrides",
        help="keys of comm. or env. to change, such as env.radio.loss=0.5, world=NAME, or "
        "evaluation.scripted=[] for the frozen policies alone; the names of the files contain "
        "them. After POLICY: the method whose observations it reads, and keys as for train",
        **_OVERRIDES,
    )
    add("--name", help="what comparisons call a policy of your own")
    add("--checkpoint", metavar="FILE", type=path, help="a checkpoint (default: the newest)")
    add("--fires", metavar="N", type=positive, help="number of episodes (default: the run's)")
    add("--device", help="cpu, cuda, ... (default: the run's)")


def add_export(commands: Any) -> None:
    text = """write the policy of a run as an ONNX file
    Writes the networks of a run's newest checkpoint as FILE.onnx, and FILE.json, which says
    what they read and write, in which units. No existing file is replaced.
    emberlink export pretrained:consensus consensus.onnx
    """
    add = command(commands, "export", _export, text)
    add("folder", metavar="RUN", help="a run folder, or pretrained:METHOD")
    add("file", metavar="FILE.onnx", type=path, help="a new file")


def _export(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.trainers.evaluation.export import export

    for written in export(options.folder, options.file):
        console.print(str(written), soft_wrap=True)
    return 0


def add_compare(commands: Any) -> None:
    text = """compare runs: methods, setups, several seeds
    Gathers finished runs by setup, world, training fire and method and prints interquartile
    means with 95 % intervals over seeds and fires, the gain of messages, and the paper's
    claims; writes compare.html, with all tables and figures, and compare.json to a folder.
    emberlink compare runs/ --output comparison
    """
    add = command(commands, "compare", _compare, text)
    folders = "run folders, folders of run folders, or names such as pretrained:tuned"
    add("folders", metavar="RUN", nargs="+", type=lambda text: path(run_name(text)), help=folders)
    add("--output", metavar="FOLDER", type=path, help="a new folder (default: compare)")
    label = "name of the runs of the first RUN, of the second, and so on (default: their method)"
    add("--label", metavar="NAME", help=label, **_REPEATABLE)
    extras: dict[str, Any] = {"action": "append_const", "dest": "extras", "default": []}
    for name, what in EXTRAS.items():
        add(f"--{name}", const=name, help=f"also write {what}", **extras)


def _compare(options: argparse.Namespace, console: "Console") -> int:
    from rich.text import Text

    from emberlink.trainers.comparison.comparison import compare_runs
    from emberlink.trainers.comparison.report import free_folder, printed, tables, write_report

    def say(text: str, style: str = "yellow") -> None:
        console.print(Text(text, style=style), soft_wrap=True)

    folder = free_folder(options.output)
    comparison = compare_runs(options.folders, options.label)
    write_report(comparison, folder, lambda text: say(f"  {text}", "dim"), options.extras)
    left_out = [f"{run} is left out: {why}" for run, why in comparison.left_out]
    for note in (*left_out, *comparison.notes):
        say(f"note: {note}")
    for section in comparison.sections:
        for table in tables(comparison, section):
            console.print(printed(table, section))
    say(str(folder / "compare.html"), "")
    return 0


def add_render(commands: Any) -> None:
    text = """an episode as GIF and MP4, or as a page to play; several runs side by side
    Plays the frozen policies of runs on the same held-out fire from the same start positions.
    Writes a GIF and an MP4 to the first run's figures, or with --output FILE.html a page that
    plays the episodes in a browser. No existing file is replaced.
    emberlink render pretrained:maps pretrained:maps env.radio.range=0 --output replay.html
    """
    add = command(commands, "render", "evaluation.render:render", text)
    add(
        "runs",
        metavar="RUN",
        nargs="+",
        type=run_name,
        help="a run folder, or pretrained:METHOD; after it KEY=VALUE, such as env.radio.range=0, "
        "for other settings of env and comm, or world=NAME",
    )
    policy = "a scripted policy to draw, too; repeatable"
    add("--policy", metavar="NAME", help=policy, **_REPEATABLE)
    fire = (
        "a held-out fire: NAME, INDEX or NAME:INDEX (default: huygens:0, or the first of the run)"
    )
    add("--fire", help=fire)
    file = "a checkpoint in place of the newest; one for each run"
    add("--checkpoint", metavar="FILE", type=path, help=file, **_REPEATABLE)
    kinds = "a folder, or a new file: .html (a page to play), .gif, .mp4 or .png (one picture)"
    add("--output", metavar="PATH", type=path, help=kinds)
    add("--step", metavar="STEP", type=between(0), help="step of a .png (default: the last)")
    add("--frames", type=positive, default=126, help="maximum number of frames (default: 126)")
    add("--fps", type=between(1, 50), default=12, help="frames per second, 1 to 50 (default: 12)")
    add("--size", type=between(100, 2000), help="pixels of a map's longer side, 100 to 2000")
    add("--seen", action="store_true", help="draw seen fire in grey")


def add_sweep(commands: Any) -> None:
    text = """train methods x seeds x setups
    Trains and evaluates every combination, several runs at a time. Finished runs in the output
    folder are skipped, and stopped ones are resumed by the same command.
    emberlink sweep consensus positional setup=paper,tuned seed=0,1,2 output=runs
    """
    usage = "emberlink sweep [--dry-run] [METHOD ...] [key=value,value ...]"
    add = command(commands, "sweep", _sweep, text, usage=usage)
    more = """methods (default: all); keys as for train, with one value or several;
    executor=local, submitit (SLURM) or ray, and its keys executor.KEY=value"""
    add("arguments", metavar="METHOD | key=value,value", nargs="+", help=more)
    add("--dry-run", action="store_true", help="only print the state of each run")


def _sweep(options: argparse.Namespace, console: "Console") -> int:
    for text in options.arguments:  # before torch is imported
        if "=" not in text:
            find("method", text)
    return run_of("sweep.command:sweep")(options, console)


def add_tune(commands: Any) -> None:
    text = """choose a method's settings by validation fires
    Trains a method again and again with settings that Optuna chooses, stops trainings that are
    below the median, and prints the best settings. Trials are runs in
    output/tune_METHOD_SETUP_WORLD; the same command continues.
    emberlink tune consensus setup=strong world=front --trials 20
    """
    add = command(commands, "tune", _checked("sweep.tune:tune"), text)
    add("method", metavar="METHOD", help="a method, as for train")
    add("overrides", help="keys as for train, which all trials have", **_OVERRIDES)
    add("--trials", metavar="N", type=positive, default=20, help="number of trials (default: 20)")
    what = "a YAML file of keys and values to try (default: that of the learner in configs/space)"
    add("--space", metavar="FILE", type=path, help=what)


def add_world(commands: Any) -> None:
    text = """test whether worlds are calibrated
    Plays scripted policies to find out whether a world is hard enough and what messages are
    worth in it.
    emberlink world check front
    """
    actions = command_group(commands, "world", text)
    text = """test the conditions of the suite in worlds
    Plays the scripted policies of worlds on test fires and prints their measures and the
    conditions of the suite. The exit status is 1 if a world does not satisfy one.
    emberlink world check front fire.burn_time=90 --validation --fires 32
    """
    add = command(actions, "world check", "worlds.check:check", text)
    names = "worlds (default: those of the suite); keys to change, such as fire.burn_time=90"
    add("arguments", metavar="NAME | key=value", nargs="*", help=names)
    add("--fires", metavar="N", type=positive, default=100, help="number of fires (default: 100)")
    on_validation = {"const": "validation", "default": "test", "action": "store_const"}
    add("--validation", dest="split", help="play on validation fires instead", **on_validation)
    add("--json", dest="output", metavar="FILE", type=path, help="a new file for the numbers")


def add_doctor(commands: Any) -> None:
    text = """check the installation
    Prints versions and devices and runs a self-test: the environment of every
    method, and updates of its networks. Prints how long the self-test took.
    emberlink doctor
    """
    command(commands, "doctor", "training.self_test:doctor", text)
