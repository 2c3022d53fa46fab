"""Defines a communication method with a large state for tests: a map of visited cells."""

from typing import ClassVar

import torch
from torchrl.data import Unbounded

from emberlink.comm.base import CommModule
from emberlink.comm.no_comm import NoCommConfig
from emberlink.envs import keys


class VisitedMap(CommModule):
    """Marks the UAV's cell, merges the maps of its neighbours, and observes the size of its map."""

    config_type: ClassVar[type] = NoCommConfig
    hears: ClassVar[bool] = True

    def __init__(self, world, config, num_envs=1):
        super().__init__(world, config, num_envs)
        self.register_buffer("map", torch.zeros(num_envs, world.num_uavs, *world.grid))

    def specs(self, observation):
        *batch, features = observation[keys.OBSERVATION].shape
        observation[keys.OBSERVATION] = Unbounded((*batch, features + 1), device=observation.device)
        return observation

    def reset(self, tensordict, mask):
        self.map.masked_fill_(mask[:, None, None, None], 0)

    def forward(self, tensordict):
        cell = tensordict[keys.POSITION][..., :2].round().long()
        index = (cell[..., 0] * self.world.grid[1] + cell[..., 1]).unsqueeze(-1)
        self.map.flatten(2).scatter_(2, index, 1.0)
        heard = tensordict[keys.HEARS][..., None, None] * self.map.unsqueeze(1)
        self.map.copy_(torch.maximum(self.map, heard.amax(2)))
        before = tensordict[keys.OBSERVATION]
        size = self.map.sum((-1, -2)).unsqueeze(-1)
        return tensordict.set(keys.OBSERVATION, torch.cat((before, size), -1))

    def shaping(self, tensordict):
        return 0.01 * self.map.sum((-1, -2))
