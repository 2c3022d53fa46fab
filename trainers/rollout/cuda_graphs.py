"""Launches all kernels of a function on a GPU at once, as a CUDA graph.

A step of the environments is a few hundred small kernels, which take longer to launch than to run.
"""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import torch

T = TypeVar("T")

_WARM_UP = 3
"""calls before recording, in which libraries allocate their workspaces"""


class CudaGraph(Generic[T]):
    """Records a function without arguments at its fourth call and replays it afterwards.

    The function must read and write tensors at fixed addresses, and must not synchronise with the
    device. (tensordict's CudaGraphModule synchronises at each call.)

    Args:
        function: the function; each call overwrites the result of the previous one.
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
        """Calls the function on a side stream, as torch requires before recording."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            result = self._function()
        torch.cuda.current_stream().wait_stream(stream)
        return result


def graphed(function: Callable[[], T], device: torch.device | str) -> Callable[[], T]:
    """Returns the function as a CUDA graph, or the function itself if the device is not a GPU."""
    device = torch.device(device)
    return CudaGraph(function, device) if device.type == "cuda" else function
