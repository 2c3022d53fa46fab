"""Trains policies: set-up, training loop, checks for NaN and Inf, resuming.

The files in the order of a run are `command` (emberlink train), `setup` (environments, learner,
collector), `warm_start` (actors of another run), `trainer` (the loop), `episode` (measures of the
current episode) and `resume`. `self_test` is the training of emberlink doctor.
"""
