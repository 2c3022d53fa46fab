"""Tests the wheel, its metadata and its console script, outside the checkout."""

import json
import os
import re
import subprocess
import sys
import sysconfig
import venv
import zipfile
from email.parser import HeaderParser
from pathlib import Path, PurePosixPath

import pytest
import yaml
from own_package import write_package
from tiny_run import TINY

ROOT = Path(__file__).parents[1]
FOLDERS = ("envs", "comm", "policies", "trainers", "configs")
# Written in two parts, so that this file does not contain the forbidden text.
REGISTRIES = ("pypi" + ".org", "pythonhosted" + ".org", "download.pytorch" + ".org", "npmjs" + ".")
PRIVATE = re.compile(
    r"(?<![\w.])/(?:work|root|home|Users)/\w|" + "|".join(map(re.escape, REGISTRIES))
)


def run(*command, cwd: Path, env: dict[str, str] | None = None, **options) -> str:
    """Returns the output of a command; fails with the output if the command fails."""
    done = subprocess.run(
        list(map(str, command)),
        cwd=cwd,
        env=env,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=600,  # on a busy machine
        **options,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}"
    return done.stdout


def copy_sources(target: Path) -> Path:
    """Copies the checkout without old build outputs, which setuptools would include."""
    for path in tracked_files():
        if path.is_file() and not path.is_symlink():
            copy = target / path.relative_to(ROOT)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(path.read_bytes())
    return target


def tracked_files() -> list[Path]:
    """Returns the files that git does not ignore."""
    listed = run("git", "ls-files", "--cached", "--others", "--exclude-standard", "-z", cwd=ROOT)
    return sorted(ROOT / name for name in listed.split("\0") if name)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    source = copy_sources(folder / "source")
    build = (sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, source)
    run(*build, cwd=folder)
    (file,) = folder.glob("emberlink-*.whl")
    return file


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the executables of an environment with the wheel and the installed libraries."""
    folder = tmp_path_factory.mktemp("installed")
    venv.create(folder, with_pip=False)
    base = {"base": str(folder), "platbase": str(folder)}
    library = Path(sysconfig.get_path("purelib", "venv", vars=base))
    # Editable installs are not visible through a path file.
    (library / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    programs = Path(sysconfig.get_path("scripts", "venv", vars=base))
    pip = (sys.executable, "-m", "pip", "--python", programs / "python", "install", "-q")
    # --ignore-installed: do not replace the emberlink that is visible through the path file.
    run(*pip, "--no-deps", "--no-index", "--ignore-installed", wheel, cwd=folder)
    return programs


def test_wheel_holds_the_package_and_nothing_else(wheel: Path):
    with zipfile.ZipFile(wheel) as file:
        names = [PurePosixPath(name) for name in file.namelist()]
    tops = {name.parts[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"emberlink"}
    assert len(tops) == 2
    held = {str(PurePosixPath(*name.parts[1:])) for name in names if name.parts[0] == "emberlink"}
    source = {
        path.relative_to(ROOT).as_posix()
        for path in tracked_files()
        if path.is_file()
        and path.relative_to(ROOT).parts[0] in (*FOLDERS, "__main__.py")
        and (
            path.suffix in (".py", ".yaml", ".html", ".js", ".css")
            or path.name in ("py.typed", "LICENSE")
            or "pretrained" in path.parts
        )
    }
    assert held == source
    assert {f"{folder}/py.typed" for folder in FOLDERS} <= held
    # Jupyter has a package called comm. With this file, tools started here would import ours.
    assert "comm/__init__.py" not in held


def test_every_dependency_is_pinned(wheel: Path):
    with zipfile.ZipFile(wheel) as file:
        (name,) = (n for n in file.namelist() if n.endswith(".dist-info/METADATA"))
        metadata = HeaderParser().parsestr(file.read(name).decode())
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    # No local version such as +cpu, no URL.
    assert [pin for pin in pins if not re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.]+", pin)] == []
    names = {_normal(pin.split("==")[0]) for pin in pins}
    assert len(names) == len(pins)
    required = {
        _normal(re.match(r"[\w.-]+", line)[0]) for line in metadata.get_all("Requires-Dist")
    }
    assert required - {"emberlink"} - names == set()


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.mark.heavy
def test_an_extension_package_adds_a_method_a_setup_and_a_fire(installed: Path, tmp_path: Path):
    """Also tests that the console script of the wheel trains."""
    ours = ("PYTHON", "PYTEST", "EMBERLINK")  # variables that may refer to the checkout
    env = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
    env |= {"OMP_NUM_THREADS": "1", "XDG_CACHE_HOME": str(tmp_path / "cache")}
    cwd, python = tmp_path, installed / "python"
    before = {file: file.stat().st_mtime_ns for file in installed.parent.rglob("emberlink/**/*.py")}
    pip = (sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-deps")
    source = write_package(cwd / "source")
    run(*pip, "--no-index", "--no-build-isolation", source, cwd=cwd)
    arguments = ("train", "headcount", "setup=small", *TINY)
    printed = run(installed / "emberlink", *arguments, cwd=cwd, env=env)
    (folder,) = (cwd / "runs").iterdir()
    assert Path(printed.strip().splitlines()[-1]) == folder.relative_to(cwd)
    assert list((folder / "figures").glob("*.gif"))
    written = yaml.safe_load((folder / "config.yaml").read_text())
    assert written["comm"] == {"name": "headcount", "scale": 0.5}
    assert (written["setup"], written["fire"]["name"]) == ("small", "faint")
    assert len((folder / "metrics.jsonl").read_text().splitlines()) == 2
    assert set(json.loads((folder / "eval.json").read_text())["results"]) == {"huygens", "faint"}
    assert before == {file: file.stat().st_mtime_ns for file in before}


def test_no_file_names_a_machine_or_a_registry():
    hits_by_file = {}
    for path in tracked_files():
        if not path.is_file() or path.is_symlink():
            continue
        try:
            hits = PRIVATE.findall(path.read_text())
        except UnicodeDecodeError:
            continue
        if hits:
            hits_by_file[str(path.relative_to(ROOT))] = hits
    assert hits_by_file == {}
