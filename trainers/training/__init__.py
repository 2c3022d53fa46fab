"""Trains policies: set-up, training loop, checkpoints, checks for NaN and Inf, resuming.

The files in the order of a run are `command` (emberlink train), `setup` (environments, learner,
collector), `warm_start` (actors of another run), `episode` (measures of the current episode),
`folders` (run folders), `trainer` (the loop), `checkpoints`, `non_finite` and `rollback` (NaN and
Inf), and `resume`. `self_test` is the training of emberlink doctor.
"""
