"""Manages run folders: configuration, metrics, checkpoints, lock, trained policies."""
