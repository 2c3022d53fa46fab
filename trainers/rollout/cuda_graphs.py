"""CUDA graphs: launches a function's kernels on a GPU as one.

A step of the environments is a few hundred small kernels, and launching them takes longer than
running them.
"""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import torch

T = TypeVar("T")

_WARM_UP = 3
"""calls before a graph is recorded, in which libraries allocate their workspaces"""


class CudaGraph(Generic[T]):
    """Records a function without arguments at its fourth call and replays it from then on.

    The function must read and write tensors that stay at their address, and must not wait for the
    device. (tensordict's CudaGraphModule waits for the device at each call.)

    Args:
        function: its result is overwritten by the next call.
        device: the GPU.
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
            return self._warm_up()
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph, stream=torch.cuda.Stream()):
                self._result = self._function()
        self._graph.replay()
        result: Any = self._result
        return result

    def _warm_up(self) -> T:
        """Calls the function on a side stream, as torch requires before a recording."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            result = self._function()
        torch.cuda.current_stream().wait_stream(stream)
        return result


def graphed(function: Callable[[], T], device: torch.device | str) -> Callable[[], T]:
    """Returns the function as a CUDA graph, or itself where the device is no GPU."""
    device = torch.device(device)
    return CudaGraph(function, device) if device.type == "cuda" else function
