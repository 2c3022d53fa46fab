"""Run folders: configuration, metrics, checkpoints, lock and trackers of a training."""
