"""What a GPU needs to be kept busy: CUDA graphs, and a collector that never waits for the device.

A step of the environments is a few hundred small kernels, and launching them takes longer than
running them. Recorded as a graph they are launched as one.
"""

from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type, step_mdp

T = TypeVar("T")

_WARM_UP = 3
"""plain calls before a graph is recorded, in which libraries allocate what they need once"""


class CudaGraph(Generic[T]):
    """A function without arguments, recorded at its fourth call and replayed from then on.

    It must read and write tensors that stay where they are, and must not wait for the device.
    (tensordict's CudaGraphModule waits for the device at each call.)

    Args:
        function: what it returns is overwritten by the next call.
        device: the GPU that it works on.
    """

    def __init__(self, function: Callable[[], T], device: torch.device):
        self._function, self._device, self._calls = function, device, 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._result: T | None = None

    def __call__(self) -> T:
        with torch.cuda.device(self._device):
            return self._call()

    def _call(self) -> T:
        self._calls += 1
        if self._calls <= _WARM_UP:
            return self._call_beside()
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph, stream=torch.cuda.Stream()):
                self._result = self._function()
        self._graph.replay()
        result: Any = self._result
        return result

    def _call_beside(self) -> T:
        """On a stream of its own, as torch asks of calls before a recording."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            result = self._function()
        torch.cuda.current_stream().wait_stream(stream)
        return result


def graphed(function: Callable[[], T], device: torch.device | str) -> Callable[[], T]:
    """The function as a CUDA graph, or itself where the device is no GPU."""
    device = torch.device(device)
    return CudaGraph(function, device) if device.type == "cuda" else function


class LockstepCollector:
    """Collects as TorchRL's Collector does, one step at a time, without looking at the device.

    All environments begin together and all episodes last for the horizon, so that it is known
    without asking when they end. What is yielded is overwritten by the next step.

    Args:
        env: environments side by side, with their communication.
        policy: with noise.
        horizon: steps of an episode.
        steps: of all environments, in all.
    """

    def __init__(self, env: EnvBase, policy: TensorDictModuleBase, *, horizon: int, steps: int):
        self.env, self.policy, self.horizon, self.steps = env, policy, horizon, steps
        self._done = 0
        self._moment: TensorDictBase = env.reset()
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            acted = policy(self._moment.copy())
        for key in set(policy.out_keys) - set(env.action_keys):
            self._moment.set(key, torch.zeros_like(acted.get(key)))
        self._advance = graphed(self._step, env.device or "cpu")

    def __iter__(self) -> Iterator[TensorDictBase]:
        while self._done < self.steps:
            with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
                collected = self._advance()
            self._done += 1
            if self._done % self.horizon == 0:
                self._moment.update_(self.env.reset())
            yield collected

    @property
    def carried(self) -> TensorDictBase:
        """The moment that the next step begins with: observations, communication, noise."""
        return self._moment

    def go_on(self, carried: TensorDictBase, step: int) -> None:
        """Goes on from a moment, so many steps into the run.

        Written into the tensors that there are: a recorded graph reads those.
        """
        self._moment.update_(carried.select(*self._moment.keys(True, True)))
        self._done = step

    def shutdown(self) -> None:
        """Nothing runs beside the program; there is nothing to end."""

    def _step(self) -> TensorDictBase:
        acted = self.env.step(self.policy(self._moment.clone()))
        self._moment.update_(step_mdp(acted, keep_other=True))
        return acted.unsqueeze(-1)
