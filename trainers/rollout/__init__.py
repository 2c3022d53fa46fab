"""Collects transitions by stepping the environments with the exploring policy."""

from emberlink.trainers.rollout.allocator import keep_freed_memory
from emberlink.trainers.rollout.collector import make_collector
from emberlink.trainers.rollout.cuda_graphs import graphed
from emberlink.trainers.rollout.products import fast_products

__all__ = ["fast_products", "graphed", "keep_freed_memory", "make_collector"]
