"""Defines modules with fast attribute access to buffers."""

from typing import Any

from torch import Tensor, nn


class Buffers(nn.Module):
    """A module whose buffers and submodules are plain attributes as well.

    `nn.Module` looks them up last, which takes a tenth of the time of a step of one environment.
    Buffers must be written in place, and moved with `to`. Persistent buffers are the state of an
    environment, which checkpoints hold. Constants are registered with `persistent=False`.
    """

    def register_buffer(self, name: str, tensor: Tensor | None, persistent: bool = True) -> None:
        super().register_buffer(name, tensor, persistent)
        self.__dict__[name] = tensor

    def __setattr__(self, name: str, value: Any) -> None:
        if name in self.__dict__.get("_buffers", ()):
            raise AttributeError(f"{name} is a buffer: write it in place, self.{name}.copy_(...)")
        super().__setattr__(name, value)
        if isinstance(value, nn.Module):
            self.__dict__[name] = value

    def _apply(self, fn: Any, recurse: bool = True) -> "Buffers":
        super()._apply(fn, recurse)
        self.__dict__.update(self._buffers)
        return self
