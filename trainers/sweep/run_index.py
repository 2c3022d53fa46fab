"""The run folders in an output folder, each read once."""

from pathlib import Path

from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep.jobs import FoundRun, Identity, identity


class RunIndex:
    """Finds run folders by the identity of their configuration.

    Args:
        output: the folder that holds the run folders; it need not be there yet.

    Attributes:
        runs: the newest run of each identity.
        unreadable: why a folder with a config.yaml is not read, by path.
    """

    def __init__(self, output: Path):
        self.output = output
        self.runs: dict[Identity, FoundRun] = {}
        self.unreadable: dict[Path, str] = {}
        self._read: set[Path] = set()

    @property
    def size(self) -> int:
        """The number of folders that were read, which grows with each new one."""
        return len(self._read)

    def update(self) -> None:
        """Reads the configurations of the folders that are new."""
        for file in sorted(self.output.glob("*/config.yaml")):
            if file.parent not in self._read:
                self._read.add(file.parent)
                self._add(RunFolder(file.parent))

    def _add(self, run: RunFolder) -> None:
        try:
            # The run may be from a machine with another device.
            config = run.config(device="cpu")
        except ValueError as error:
            self.unreadable[run.path] = str(error)
            return
        self.runs[identity(config)] = FoundRun(run, config.seeds)
