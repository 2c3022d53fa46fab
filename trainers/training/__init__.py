"""Trains policies: set-up, training loop, checks for NaN and Inf, resuming."""
