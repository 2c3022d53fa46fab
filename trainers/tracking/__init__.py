"""Sends a run's numbers and figures to trackers: wandb, TensorBoard, CSV."""
