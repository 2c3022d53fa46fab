"""A cache that lets two losses use the same features of an observation."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from torch import Tensor


class FeatureCache:
    """Keeps the features of observations while it is active.

    The losses of DDPG evaluate a critic twice at each observation of a batch: with the action that
    was taken, and with the actor's action. The features do not depend on the action. Nothing may
    write to observations or weights while the cache is active.
    """

    def __init__(self) -> None:
        self._entries: dict[tuple, tuple[Sequence[Tensor], list[Tensor]]] | None = None

    @contextmanager
    def active(self) -> Iterator[None]:
        """Keeps features within a `with` block, and forgets them at its end."""
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

        Kept features are returned detached, and only where the weights need no gradient: the
        actor's loss does not train the critic.

        Args:
            observations: the tensors of the observation.
            weight: a weight of the network, by which networks and their targets differ.
            compute: computes the features.
        """
        if self._entries is None:
            return compute(observations)
        # By their memory: the losses hand over new tensor objects for the same numbers.
        key = tuple((tensor.data_ptr(), tensor.shape) for tensor in (*observations, weight))
        if key in self._entries and not weight.requires_grad:
            _, features = self._entries[key]
            return [part.detach() for part in features]
        features = compute(observations)
        # With the observation, so that its memory is not used for another tensor meanwhile.
        self._entries[key] = observations, features
        return features
