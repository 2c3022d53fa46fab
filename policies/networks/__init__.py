"""The networks of the UAVs: encoders of observations, actors and critics."""

from emberlink.policies.networks.actor_critic import (
    STATE_ACTION_VALUE,
    TAKEN,
    make_actor,
    make_critic,
)

__all__ = ["STATE_ACTION_VALUE", "TAKEN", "make_actor", "make_critic"]
