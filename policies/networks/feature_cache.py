"""Caches the features of an observation for two losses."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from torch import Tensor


class FeatureCache:
    """Caches the features of observations while it is active.

    The losses of DDPG evaluate a critic twice at each observation of a batch: with the action of
    the transition and with the actor's action. The features do not depend on the action. While the
    cache is active, observations and weights must not be written to.
    """

    def __init__(self) -> None:
        self._entries: dict[tuple, tuple[Sequence[Tensor], list[Tensor]]] | None = None

    @contextmanager
    def active(self) -> Iterator[None]:
        """Activates the cache for a `with` block and empties it at the end."""
        self._entries = {}
        try:
            yield
        finally:
            self._entries = None

    def get(
        self,
        observations: Sequence[Tensor],
        weight: Tensor,
        compute: Callable[[Sequence[Tensor]], list[Tensor]],
    ) -> list[Tensor]:
        """Returns the features of an observation.

        Cached features are returned detached, and only if the weights need no gradient: the
        actor's loss does not train the critic.

        Args:
            observations: the tensors of the observation.
            weight: a weight of the network; it distinguishes a network from its target network.
            compute: computes the features if they are not cached.
        """
        if self._entries is None:
            return compute(observations)
        # Keyed by memory address: the losses pass new tensor objects that share memory.
        key = tuple((tensor.data_ptr(), tensor.shape) for tensor in (*observations, weight))
        if key in self._entries and not weight.requires_grad:
            _, features = self._entries[key]
            return [part.detach() for part in features]
        features = compute(observations)
        # Holding the observations prevents their memory from being reused by other tensors.
        self._entries[key] = observations, features
        return features
