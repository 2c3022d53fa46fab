"""Starts SLURM with one node on this machine, for tests.

    python tests/cluster/slurm.py FOLDER COMMAND...

runs a command with the cluster, and stops the cluster when the command has ended. It needs root and
Debian's packages slurmctld, slurmd and munge. All files are in FOLDER: a configuration, keys, logs.
"""

import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PROGRAMS = ("slurmctld", "slurmd", "munged", "sbatch", "squeue")
INSTALL = "apt-get install slurmctld slurmd munge"
CORES = 2
HOST = socket.gethostname().split(".")[0]
CONFIG = """\
ClusterName=emberlink
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
# A requeued job waits until credentials of its first start have expired.
AuthInfo=socket={folder}/munge.socket,cred_expire=5
CredType=cred/munge
SlurmctldPort={port}
SlurmdPort={node_port}
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SwitchType=switch/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
JobRequeue=1
KillWait=5
SlurmdTimeout=20
ReturnToService=2
SlurmdParameters=config_overrides
SchedulerParameters=sched_interval=5,bf_interval=5
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} State=UNKNOWN
PartitionName=low Nodes={host} Default=YES MaxTime=INFINITE PriorityTier=1 GraceTime=5
PartitionName=high Nodes={host} MaxTime=INFINITE PriorityTier=10 PreemptMode=OFF
"""


def missing() -> list[str]:
    """Returns the programs that are not installed."""
    path = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
    return [program for program in PROGRAMS if shutil.which(program, path=path) is None]


@contextmanager
def cluster(folder: Path) -> Iterator[dict[str, str]]:
    """Runs a cluster of one node; yields the environment variables that its commands need.

    Args:
        folder: an empty folder for the files of the cluster.

    Raises:
        RuntimeError: a program is missing or the node does not become idle.
    """
    if absent := missing():
        raise RuntimeError(f"{', '.join(absent)}: not installed; install with: {INSTALL}")
    folder.chmod(0o755)
    (folder / "state").mkdir()
    (folder / "spool").mkdir()
    key = folder / "munge.key"
    key.write_bytes(secrets.token_bytes(128))
    key.chmod(0o400)
    config = folder / "slurm.conf"
    ports = [_free_port(), _free_port()]
    numbers = {"port": ports[0], "node_port": ports[1], "cores": CORES}
    config.write_text(CONFIG.format(folder=folder, host=HOST, **numbers))
    path = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
    environment = {**os.environ, "PATH": path, "SLURM_CONF": str(config)}
    munge = [f"--key-file={key}", f"--socket={folder}/munge.socket"]
    munge += [f"--{name}-file={folder}/munge.{name}" for name in ("pid", "log", "seed")]
    started: list[subprocess.Popen] = []
    try:
        for command in (
            ["munged", "--foreground", "--force", *munge],
            ["slurmctld", "-D", "-f", str(config)],
            ["slurmd", "-D", "-f", str(config), "-N", HOST],
        ):
            log = (folder / f"{command[0]}.out").open("wb")
            started.append(
                subprocess.Popen(command, env=environment, stdout=log, stderr=subprocess.STDOUT)
            )
            log.close()
            time.sleep(1)
        _wait_until_idle(environment, folder)
        yield environment
    finally:
        subprocess.run(["scancel", "--user=root"], env=environment, check=False)
        for process in reversed(started):
            process.terminate()
        for process in reversed(started):
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()


def kill_node(folder: Path) -> None:
    """Kills slurmd and all that it has started, as if the machine had lost its power."""
    listed = subprocess.check_output(["ps", "-e", "-o", "pid,ppid,args"], text=True)
    rows = [line.split(maxsplit=2) for line in listed.splitlines()[1:]]
    steps = [int(pid) for pid, _, text in rows if text.startswith("slurmstepd: [")]
    dying = [int((folder / "slurmd.pid").read_text()), *steps]
    for process in dying:  # grows
        dying += [int(pid) for pid, parent, _ in rows if int(parent) == process]
    for process in {*dying}:
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)


@contextmanager
def node(folder: Path, environment: dict[str, str]) -> Iterator[None]:
    """Runs slurmd again after `kill_node`."""
    command = ["slurmd", "-D", "-f", str(folder / "slurm.conf"), "-N", HOST]
    with (folder / "slurmd.out").open("ab") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
    try:
        yield
    finally:
        process.terminate()
        process.wait(30)


def _wait_until_idle(environment: dict[str, str], folder: Path) -> None:
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        command = ["sinfo", "--noheader", "--partition=low", "--format=%t"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        if done.stdout.strip() == "idle":
            return
        time.sleep(0.5)
    logs = [file.read_text(errors="replace")[-2000:] for file in sorted(folder.glob("*.log"))]
    raise RuntimeError(f"the node is not idle: {done.stdout}{done.stderr}\n" + "\n".join(logs))


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


if __name__ == "__main__":
    with cluster(Path(sys.argv[1])) as variables:
        sys.exit(subprocess.run(sys.argv[2:], env=variables).returncode)
