"""The networks of the UAVs: encoders of observations, actors and critics."""

from emberlink.policies.networks.actor_critic import (
    STATE_ACTION_VALUE,
    build,
    make_actor,
    make_critic,
    team_of,
)
from emberlink.policies.networks.layers import Generators

__all__ = ["STATE_ACTION_VALUE", "Generators", "build", "make_actor", "make_critic", "team_of"]
