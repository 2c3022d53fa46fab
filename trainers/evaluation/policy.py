"""Loads the frozen policy of a run, also for an environment with other settings."""

import warnings
from collections.abc import Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import TensorDictPrimer

from emberlink.comm.base import MODULES
from emberlink.envs import keys
from emberlink.envs.utils.atomic_io import user_path
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown
from emberlink.policies.hold import Held, held
from emberlink.policies.networks.messages import message_lag
from emberlink.policies.state import primer_of
from emberlink.trainers.build import build_actor, empty_env
from emberlink.trainers.config.compose import differences, evaluated_with, resolve, to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.config.values import flat, parse
from emberlink.trainers.evaluation.episodes import Panel, find_fire, play_side_by_side, scripted
from emberlink.trainers.evaluation.foreign import (
    FOREIGN,
    ForeignPolicy,
    OnnxPolicy,
    foreign_name,
    is_reference,
    new_run,
    open_policy,
    reference_of,
)
from emberlink.trainers.learners.base import ACTOR
from emberlink.trainers.replay.page import Replay
from emberlink.trainers.runs.checkpoint import load_weights, read_header
from emberlink.trainers.runs.pretrained import read_run
from emberlink.trainers.runs.run_folder import RunFolder

_CHANGEABLE = ("world", "edition", "fire", "env", "comm", "evaluation")
"""groups of keys that an evaluation can change"""
_OBSERVED = tuple(name for _, name in keys.NETWORKS_READ)
_UNITS = ("altitude", "horizon", "displacement", "view_angle", "observation_scale")


class TrainedPolicy(TensorDictSequential):
    """The frozen policy of a run, which maps observations to ("agents", "action").

    `make_env(policy.config)` returns its environment. A memory and held actions are read from the
    TensorDict and written under "next", as TorchRL's GRUModule does; `in_keys` and `out_keys` name
    them.

    Args:
        checkpoint: file of the networks, or `foreign.FOREIGN`.
        changes: settings that differ from the training's, such as `env.radio.range=0`, and the name
            of a chosen checkpoint.
    """

    def __init__(
        self,
        actor: TensorDictModule,
        config: RunConfig,
        checkpoint: Path,
        changes: Sequence[str] = (),
    ):
        modules: Any = [actor]
        super().__init__(*modules)
        self.config = config
        self.checkpoint = checkpoint
        self.changes = tuple(changes)

    @property
    def actor(self) -> Any:
        """The networks, with held actions."""
        return self.module[0]

    @property
    def decision(self) -> Any:
        """The networks, which decide each time they are called."""
        return self.actor.policy if isinstance(self.actor, Held) else self.actor

    @property
    def card(self) -> dict[str, Any]:
        """Plain values that a user of the policy needs: its making, its inputs and its outputs."""
        config, decision = self.config, self.decision
        values = flat(to_values(config))
        spec: Any = empty_env(config).append_transform(primer_of(decision)).observation_spec
        made = [f"{key}={values[key]}" for key in ("setup", "world")]
        changed = differences(config, resolve(config.method, made))
        own = [key for key in changed if key.startswith(("env.", "comm.", "policy."))]
        tied = config.policy.agent_index or config.comm["name"] == "positional"
        tied |= message_lag(config.policy, config.env.radio) > 0  # the team's links in flight
        return {
            "method": config.method,
            "settings": [*made, *(f"{key}={shown(values[key])}" for key in own)],
            "decides_every": config.policy.hold,
            "any_team": config.learner.share_parameters and not tied,
            "inputs": {
                key if isinstance(key, str) else key[-1]: {
                    "shape": ["environments", *spec[key].shape[1:]],
                    "dtype": str(spec[key].dtype).removeprefix("torch."),
                }
                for key in decision.in_keys
            },
            "outputs": ["next_" * (key[0] == "next") + key[-1] for key in decision.out_keys],
            "world": {key: shown(value) for key, value in values.items() if key.startswith("env.")},
        }

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Returns a transform that adds the policy's state to an environment; `make_env` does."""
        return primer_of(self)

    def replay(
        self, *others: "TrainedPolicy", fire: str | int | None = None, policies: Sequence[str] = ()
    ) -> Replay:
        """Returns a page that plays an episode of the evaluation; Jupyter shows it inline.

        Args:
            others: policies to show beside this one, on the same fire.
            fire: NAME, INDEX or NAME:INDEX of a held-out fire; `huygens:0`, or the first of the
                run's own fires, if None.
            policies: names of scripted policies to show as well.

        Raises:
            UserError: a name is not known, or the others have another map, team or horizon.
        """
        panels = [policy.panel() for policy in (self, *others)]
        panels += scripted(self.config, policies)
        name, index, arrival = find_fire(fire, self.config)
        return Replay(play_side_by_side(panels, arrival, index), f"{name}:{index}")

    def panel(self) -> Panel:
        """Returns the policy and its title."""
        return Panel(self.title, self.config, lambda _: self)

    @property
    def title(self) -> str:
        """The method, setup, world, seed and changed settings; the world `paper` is not named."""
        config = self.config
        world = [] if config.world == "paper" else [f"world {config.world}"]
        changes = [text for text in self.changes if not text.startswith("world=")]
        parts = [config.method, f"setup {config.setup}", *world, f"seed {config.seed}", *changes]
        return ", ".join(parts)


def load(
    run: str | PathLike[str],
    overrides: Sequence[str] = (),
    *,
    checkpoint: str | PathLike[str] | None = None,
    device: str | None = None,
    **settings: Any,
) -> TrainedPolicy:
    """Returns the frozen policy of a run.

    Args:
        run: a run folder, or `pretrained:METHOD`.
        overrides: settings as texts `key=value`, as for `emberlink eval`.
        checkpoint: file of networks; the newest of the run if None.
        device: device of the networks; the run's if None.
        settings: `world`, settings of its fire (`"fire.path"`), or settings of `env`, `comm` or
            `evaluation` to change, as for `train`; the networks must fit.

    Raises:
        UserError: there is no such run, a file in it is damaged, or a setting does not fit.
    """
    folder = read_run(fspath(run))
    runs = sorted(str(file.parent) for file in folder.path.glob("*/config.yaml"))
    if runs and not (folder.path / "config.yaml").exists():
        several = f"a folder of {len(runs)} runs; choose one: {', '.join(runs)}"
        raise UserError(f"{folder.path}: {several}")
    name = foreign_name(folder)
    file = None if checkpoint is None else user_path(checkpoint)
    file = folder.newest if file is None and not name else file
    trained = folder.config(file, **({} if device is None else {"device": device}))
    config = evaluated_with(trained, {**dict(map(parse, overrides)), **settings})
    changed = differences(trained, config)
    if fixed := [key for key in changed if key.partition(".")[0] not in _CHANGEABLE]:
        raise UserError(
            f"{', '.join(fixed)}: an evaluation changes only keys of {', '.join(_CHANGEABLE)}"
        )
    changes = [*overrides, *(f"{key}={shown(value)}" for key, value in settings.items())]
    changes += [] if checkpoint is None else [Path(checkpoint).stem]
    if file is None:
        place = reference_of(folder)
        return foreign_policy(opened(place)[0], place, name, config, changes)
    return TrainedPolicy(load_actor(config, file), config, file, changes)


def opened(text: str) -> tuple[Any, str]:
    """Returns a policy given as text, a run's too, and by which text it is opened again."""
    if is_reference(text):
        return open_policy(text)
    return load(text), str(read_run(text).path.absolute())


def to_evaluate(
    policy: Any,
    method: str | None,
    overrides: Sequence[str] = (),
    *,
    name: str = "",
    checkpoint: str | PathLike[str] | None = None,
    device: str | None = None,
    **settings: Any,
) -> tuple[TrainedPolicy, RunFolder | None]:
    """Returns a policy to evaluate, and with a `name` its new run folder.

    Without a method, `policy` is a run, see `load`. With a method, whose environment it gets, it is
    one of `foreign.ForeignPolicy`, or a text, see `opened`. A run, or an ONNX file of `emberlink
    export`, then chooses setup, world and hold unless `overrides` or `settings` do.
    """
    text = fspath(policy) if isinstance(policy, str | PathLike) else ""
    if method is None and text and not name and not is_reference(text):
        return load(text, overrides, checkpoint=checkpoint, device=device, **settings), None
    if checkpoint is not None:
        raise UserError(f"{checkpoint} is a checkpoint: expected a run, and no method and no name")
    if method is None:
        raise UserError(
            f"{text or 'evaluate'}: expected emberlink eval POLICY METHOD [key=value ...] --name "
            "NAME, or evaluate(POLICY, METHOD, ...); METHOD says which observations it reads"
        )
    settings |= {} if device is None else {"device": device}
    place, reference = text or name or "policy", ""
    if text:
        policy, reference = opened(text)
    usual = _card(policy).get("settings", ())
    if usual and _card(policy)["method"] != method:
        usual = [text for text in usual if not text.startswith("comm.")]
    config = resolve(method, [*usual, *overrides], **settings)
    played = foreign_policy(policy, place, name, config)
    return played, new_run(reference, name, config) if name else None


def foreign_policy(
    policy: Any, place: str, name: str, config: RunConfig, changes: Sequence[str] = ()
) -> TrainedPolicy:
    """Returns a policy of any kind, if it fits, which decides as often as `policy.hold` says."""
    if isinstance(policy, TrainedPolicy) and isinstance(policy.decision, ForeignPolicy):
        policy = policy.decision.policy  # of its folder
    spec = empty_env(config).observation_spec
    observed = keys.observation_keys(spec)
    if card := _card(policy):
        values = flat(to_values(config))
        fixed = [] if card["any_team"] else ["env.num_uavs"]
        fixed += ["env.radio.delay"] * ("hears" in card["inputs"])  # of learned messages
        for key in fixed:
            if (now := shown(values[key])) != (made := card["world"][key]):
                raise UserError(f"{place}: {key}={now}; its networks are for {key}={made}")
        here = {name: [*spec[group, name].shape[2:]] for group, name in observed}
        read = {name: one["shape"][2:] for name, one in card["inputs"].items() if name in _OBSERVED}
        if read != here:
            made = f"a policy of {card['method']} observes {read}"
            raise UserError(f"{place}: {made}, and {config.method} observes {here}")
    policy = policy.decision if isinstance(policy, TrainedPolicy) else policy
    actor: Any = ForeignPolicy(policy, name or "policy", observed)
    actor = held(actor, config.policy.hold, config.env.num_uavs)
    return TrainedPolicy(actor, config, Path(FOREIGN), [*filter(None, [name]), *changes])


def _card(policy: Any) -> dict[str, Any]:
    """Returns the card of a policy that emberlink has trained or exported; else an empty one."""
    return policy.card if isinstance(policy, TrainedPolicy | OnnxPolicy) else {}


def load_actor(config: RunConfig, checkpoint: Path) -> TensorDictModule:
    """Returns the frozen networks of a checkpoint, which map observations to ("agents", "action").

    It warns of settings that give observations or actions another meaning than in training (see
    `units`), and of a base that the networks never saw.
    """
    actor = build_actor(config, empty_env(config))
    network: Any = actor.module
    weights = load_weights(checkpoint, network, config)
    trained, compared = read_header(checkpoint).config, units(config)
    if config.env.observation == "map" and trained["env"]["base"] is None:
        compared += ("env.base",)
    differ = [
        f"{key}={shown(now)} (in training {shown(before)})"
        for key, (now, before) in differences(config, trained).items()
        if key in compared
    ]
    if differ:
        warnings.warn(
            f"{', '.join(differ)}: what the networks observe and do means something else here",
            stacklevel=2,
        )
    network.load_state_dict({name.removeprefix(ACTOR): v for name, v in weights.items()})
    if (fault := config.evaluation.message_fault) != "none":
        if getattr(network, "messages", None) is None:
            raise UserError(f"evaluation.message_fault={fault}: the policy has no learned messages")
        network.messages.fault = fault
    return actor.requires_grad_(False)


def units(config: RunConfig) -> tuple[str, ...]:
    """Returns the keys that define the units of observations and actions.

    The grid is among them if a UAV observes where in the box it is.
    """
    world = _UNITS
    if config.env.observation == "map":
        world += ("map.scales", "map.spread")
    if config.env.observation != "map" or config.env.map.position:
        world += ("grid",)
    said = MODULES.find(config.comm["name"]).units
    return (*(f"env.{key}" for key in world), *(f"comm.{key}" for key in said))
