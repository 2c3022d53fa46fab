"""Lists the run folders in an output folder by their configuration."""

from pathlib import Path

from emberlink.trainers.runs import pretrained
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep.jobs import FoundRun, Identity, identity, is_finished


class RunIndex:
    """Maps identities of configurations to run folders; each folder is read once.

    Args:
        output: folder of the run folders; it may not exist yet.

    Attributes:
        runs: identity -> a finished run, or the last one by name; without copies of the package's
            trained policies.
        unreadable: path -> reason for each folder whose config.yaml cannot be read.
    """

    def __init__(self, output: Path):
        self.output = output
        self.runs: dict[Identity, FoundRun] = {}
        self.unreadable: dict[Path, str] = {}
        self._read: set[Path] = set()

    @property
    def size(self) -> int:
        """The number of folders read so far."""
        return len(self._read)

    def update(self) -> None:
        """Reads the configurations of new folders."""
        for file in sorted(self.output.glob("*/config.yaml")):
            if file.parent not in self._read and not pretrained.is_copy(file.parent):
                self._read.add(file.parent)
                self._add(RunFolder(file.parent))

    def _add(self, run: RunFolder) -> None:
        try:
            # The device of the run may not exist on this machine.
            config = run.config(device="cpu")
        except ValueError as error:
            self.unreadable[run.path] = str(error)
            return
        name = identity(config)
        known = self.runs.get(name)
        if known is None or not is_finished(known.folder, config):
            self.runs[name] = FoundRun(run, config.seeds)
