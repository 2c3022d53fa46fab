"""Draws the rows and columns of a replay buffer of which a batch consists."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torchrl.data.replay_buffers.samplers import RandomSampler
from torchrl.data.replay_buffers.storages import TensorStorage

from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use

_ROWS, _COLUMNS = range(2)


class TeamSampler(RandomSampler):
    """Samples a batch for each UAV, uniformly, from a storage of shape [rows, teams * uavs].

    A sample is a function of the seed and the number of earlier samples. It is the same on every
    device and does not depend on other seeds that are trained in parallel.

    Args:
        uavs: UAVs per team.
        shared: whether a UAV samples from the transitions of its team, or only from its own.
        joint: whether the UAVs of a team sample the same rows. If `shared` is true, too, they
            exchange their places: UAV k samples from UAV (k + n) % uavs, with one random n per
            entry of the batch.
        rows: capacity of the storage.
        seeds: seed of each team.
        device: device of the storage and the indices.
    """

    def __init__(
        self,
        uavs: int,
        *,
        shared: bool,
        joint: bool,
        rows: int,
        seeds: Sequence[int],
        device: torch.device | str,
    ):
        super().__init__()
        self.uavs, self.shared, self.joint, self.rows = uavs, shared, joint, rows
        # On the device, so that CUDA graphs read their current values.
        self.draws = torch.zeros((), dtype=torch.int64, device=device)
        self.written = torch.zeros((), dtype=torch.int64, device=device)
        self._keys = counter_rng.fold_in(torch.tensor(seeds, device=device), Use.REPLAY_SAMPLE)
        self._team = torch.arange(len(seeds), device=device)[:, None, None] * uavs
        self._own = torch.arange(uavs, device=device)

    def extend(self, index: Tensor) -> None:
        """Counts the rows that the buffer has written."""
        self.written.add_(len(index))

    def sample(self, storage: TensorStorage, batch_size: int) -> tuple[tuple[Tensor, ...], dict]:
        """Returns rows and columns, int64 [batch_size, teams * uavs] each.

        Entry [:, k] is the batch of UAV k.
        """
        if len(storage) == 0:
            raise RuntimeError("cannot sample from an empty replay memory")
        rows, columns = self._draw(batch_size, self.written.clamp(max=self.rows))
        return (rows, columns), {}

    def _draw(self, count: int, limit: Tensor) -> tuple[Tensor, Tensor]:
        """Draws numbers below a limit, and columns, int64 [count, teams * uavs] each."""
        key = counter_rng.fold_in(self._keys, self.draws)
        self.draws += 1
        alike = 1 if self.joint else self.uavs

        def draw(use: int, limit: int | Tensor) -> Tensor:
            numbers = counter_rng.integers(counter_rng.fold_in(key, use), count * alike, limit)
            return numbers.view(-1, count, alike).expand(-1, -1, self.uavs)

        numbers, columns = draw(_ROWS, limit), self._own.expand(len(self._keys), count, -1)
        if self.shared:
            drawn = draw(_COLUMNS, self.uavs)
            columns = (columns + drawn) % self.uavs if self.joint else drawn
        both = (of_teams.transpose(0, 1).flatten(1) for of_teams in (numbers, columns + self._team))
        return next(both), next(both)


class SequenceSampler(TeamSampler):
    """Samples sequences of an environment's successive decisions, none of which spans two episodes.

    Environments are stored one after another at each decision, and their episodes begin together.
    A sequence has `burn_in` decisions, which only prepare the memory, and `sequence` decisions to
    learn from. It is drawn uniformly from all sequences of stored episodes. Sequences may extend
    beyond either end of an episode, so that each decision is drawn equally often. The burn-in is
    shorter where the episode has fewer decisions before the sequence; the memory is empty at the
    beginning of the episode.

    TorchRL's SliceSampler draws the same rows for all UAVs, from the global generator.

    Args:
        burn_in: decisions before those to learn from.
        sequence: decisions to learn from.
        horizon: decisions of an episode; at least `sequence`.
        envs: environments per seed.
        more: arguments of `TeamSampler`.
    """

    def __init__(self, *args, burn_in: int, sequence: int, horizon: int, envs: int, **more):
        super().__init__(*args, **more)
        device = self._own.device
        self.burn_in, self.sequence, self.horizon, self.envs = burn_in, sequence, horizon, envs
        episodes = -(-(self.rows // envs) // horizon) + 1  # at most, the first in part
        self._episode = torch.arange(episodes, device=device)
        self._offset = torch.arange(-burn_in, sequence, device=device)[:, None]

    def sample(self, storage: TensorStorage, batch_size: int) -> tuple[tuple[Tensor, ...], dict]:
        """Returns rows and columns, int64 [sequences, decisions, teams * uavs] each.

        There are as many sequences as have `batch_size` decisions to learn from, rounded up. In the
        dict, "missing" counts the decisions that a burn-in lacks, int64 [sequences, teams * uavs],
        and "within" tells which decisions to learn from are within the episode, bool [sequences,
        `sequence`, teams * uavs]. Rows of other decisions are those of the nearest decision.
        """
        first, end = self._stored()
        starts = (end - first + self.sequence - 1) * (end > first)
        sums = starts.cumsum(0)
        number, columns = self._draw(-(-batch_size // self.sequence), sums[-1] * self.envs)
        number, env = (number // self.envs).contiguous(), number % self.envs
        place = torch.searchsorted(sums, number, right=True)
        first, end = first[place], end[place]
        drawn = first - (self.sequence - 1) + number - (sums - starts)[place]
        start = torch.maximum(drawn, first)
        began = start // self.horizon * self.horizon
        last = torch.minimum(drawn + self.sequence, end) - 1
        decisions = start.unsqueeze(1) + self._offset
        info = {
            "missing": (began + self.burn_in - start).clamp(min=0),
            "within": decisions[:, self.burn_in :] <= last.unsqueeze(1),
        }
        decisions = decisions.clamp(began.unsqueeze(1), end.unsqueeze(1) - 1)
        rows = (decisions * self.envs + env.unsqueeze(1)) % self.rows
        return (rows, columns.unsqueeze(1).expand_as(rows)), info

    def _stored(self) -> tuple[Tensor, Tensor]:
        """Returns for each stored episode the decisions to learn from: the first, and the end.

        Decisions are counted from the beginning of the run. An episode whose beginning is
        overwritten has a burn-in before its first one.
        """
        after = self.written // self.envs
        oldest = (self.written - self.rows).clamp(min=0).add(self.envs - 1) // self.envs
        begin = (oldest // self.horizon + self._episode) * self.horizon
        end = torch.minimum(begin + self.horizon, after)
        first = torch.where(begin >= oldest, begin, oldest + self.burn_in)
        return first, end
