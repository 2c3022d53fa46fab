"""Sends a run's numbers and figures to trackers: wandb, TensorBoard, CSV."""

from emberlink.trainers.tracking.trackers import Trackers

__all__ = ["Trackers"]
