"""Defines the frozen policy that `emberlink.trainers.load` returns."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential, dispatch
from torchrl.data import Composite
from torchrl.envs import TensorDictPrimer

from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown
from emberlink.policies.state import primer_of
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation import episodes
from emberlink.trainers.replay.page import Replay


class TrainedPolicy(TensorDictSequential):
    """The frozen policy of a run, which maps observations to ("agents", "action").

    `make_env(policy.config)` returns its environment. A memory and held actions are read from the
    TensorDict and written under "next", as TorchRL's GRUModule does; `in_keys` and `out_keys` name
    them.

    Args:
        actor: the networks.
        observation_spec: of their environment.
        config: configuration of the run.
        checkpoint: file of the networks.
        changes: settings that are not those of the training, such as `env.radio.range=0`.
    """

    def __init__(
        self,
        actor: TensorDictModule,
        observation_spec: Composite,
        config: RunConfig,
        checkpoint: Path,
        changes: Sequence[str] = (),
    ):
        modules: Any = [actor]
        super().__init__(*modules)
        names = keys.observation_keys(observation_spec)
        self._observed = dict(zip(names, keys.observation_shapes(observation_spec), strict=True))
        self.config = config
        self.checkpoint = checkpoint
        self.changes = tuple(changes)

    @dispatch(auto_batch_size=False)
    def forward(  # pyright: ignore[reportIncompatibleVariableOverride]
        self, tensordict: TensorDictBase, *args: Any, **kwargs: Any
    ) -> TensorDictBase:
        """Writes the actions of all UAVs.

        Raises:
            UserError: the observations are not those that the policy was trained with.
        """
        self._check(tensordict)
        return super().forward(tensordict, *args, **kwargs)

    def _check(self, tensordict: TensorDictBase) -> None:
        """Checks the number of UAVs and the shape of what each of them observes."""
        config = self.config
        for key, shape in self._observed.items():
            wanted = [config.env.num_uavs, *shape]
            given = tensordict.get(key, None)
            there = None if given is None else list(given.shape[-len(wanted) :])
            if there != wanted:
                raise UserError(
                    f"this policy of {config.method} reads {key} with the last sizes {wanted}, the "
                    f"environment gives {there}; make_env(policy.config) returns its environment"
                )

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Returns a transform that adds the policy's state to an environment.

        `make_env` has added it already.
        """
        return primer_of(self)

    def replay(
        self,
        *others: "TrainedPolicy",
        fire: str | int | None = None,
        policies: Sequence[str] = (),
    ) -> Replay:
        """Returns a page that plays an episode of the evaluation; Jupyter shows it inline.

        Args:
            others: policies to show beside this one, on the same fire.
            fire: NAME, INDEX or NAME:INDEX of a held-out fire; `huygens:0`, or the first of the
                run's own fires, if None.
            policies: names of scripted policies to show, too.

        Raises:
            UserError: a name is not known, or the others are no policies, or have another map, team
                or horizon.
        """
        for other in others:
            if not isinstance(other, TrainedPolicy):
                raise UserError(
                    f"replay: {shown(other)} is not a policy of load(...); fire=0 chooses a fire"
                )
        own = [
            episodes.Panel(
                episodes.title_of(policy.config, *policy.changes),
                policy.config,
                lambda _, policy=policy: policy,
            )
            for policy in (self, *others)
        ]
        return episodes.replay([*own, *episodes.scripted(self.config, policies)], fire)
