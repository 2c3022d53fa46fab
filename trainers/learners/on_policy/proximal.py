"""The loss of PPO (Schulman et al. 2017) for all UAVs, through TorchRL's."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor
from torchrl.modules import IndependentNormal
from torchrl.objectives import ClipPPOLoss

from emberlink.envs import keys
from emberlink.policies.gaussian import LOG_PROB, MEAN, MemoryActor
from emberlink.trainers.learners.nan_guard import row_norms

VALUE = (keys.AGENTS, "state_value")
"""float32 [..., 1]: the critics' output, in units of the returns' standard deviation"""
ADVANTAGE = (keys.AGENTS, "advantage")
"""float32 [..., 1]: standardised"""
RETURN = (keys.AGENTS, "value_target")
"""float32 [..., 1], in units of the returns' standard deviation"""
_STD = (keys.AGENTS, "std")


def make_loss(
    actor: MemoryActor,
    critic: TensorDictModule,
    *,
    clip: float,
    entropy: float,
    device: torch.device | str,
) -> ClipPPOLoss:
    """Returns TorchRL's loss of whole episodes, with reduction "none".

    Args:
        actor: actors of all UAVs.
        critic: writes `VALUE`.
        clip: clip range of the probability ratio, [1 - clip, 1 + clip].
        entropy: weight of the entropy of the actions.
        device: of the networks.
    """
    observed: list[Any] = [key for key in actor.in_keys if key != keys.STEP]
    outputs: list[Any] = [MEAN, _STD]
    draw = ProbabilisticTensorDictModule(
        in_keys={"loc": MEAN, "scale": _STD},  # pyright: ignore[reportArgumentType]
        out_keys=[keys.ACTION],
        distribution_class=IndependentNormal,
    )
    policy: Any = [TensorDictModule(actor.module, in_keys=observed, out_keys=outputs), draw]
    loss = ClipPPOLoss(
        ProbabilisticTensorDictSequential(*policy),
        critic,
        clip_epsilon=clip,
        entropy_bonus=entropy > 0,
        entropy_coeff=entropy,
        loss_critic_type="l2",
        log_explained_variance=False,
        functional=False,
        reduction="none",
        device=torch.device(device),
    )
    loss.set_keys(
        action=keys.ACTION,
        sample_log_prob=LOG_PROB,
        advantage=ADVANTAGE,
        value_target=RETURN,
        value=VALUE,
    )
    return loss


def mean_of_uavs(loss: Tensor, alive: Tensor | None, teams: int) -> Tensor:
    """Returns the mean loss of each UAV of all seeds, over the decisions in which it flew.

    Args:
        loss: [seeds * environments, decisions, uavs].
        alive: bool of the same shape; None if UAVs do not fail.
        teams: number of seeds.
    """
    weight = torch.ones_like(loss) if alive is None else alive.to(loss.dtype)
    by_seed = torch.stack((loss * weight, weight)).unflatten(1, (teams, -1))
    total, count = by_seed.sum((2, 3))
    return (total / count.clamp(min=1)).flatten()


def clip_by_row(gradients: Sequence[Tensor], limit: float) -> None:
    """Shortens the gradients of a network to a Euclidean norm, in place and per row.

    Args:
        gradients: [rows, ...] each; a row belongs to a UAV or a team.
        limit: largest norm of a row of all gradients together.
    """
    norm = torch.stack(row_norms(gradients)).square().sum(0).sqrt()
    factor = (limit / (norm + 1e-6)).clamp(max=1)
    for gradient in gradients:
        gradient.mul_(factor.view(-1, *[1] * (gradient.ndim - 1)))
