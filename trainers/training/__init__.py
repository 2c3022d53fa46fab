"""Trains policies: what is trained, its state, checks for NaN, the loop, and resuming.

A run's story, file by file: `setup` (environments, learner, collector), `episode` (measures of the
episode at hand), `folders` (run folders), `checkpoints` (saved states), `trainer` (the loop),
`non_finite` and `rollback` (NaN and Inf), `resume`. Import from those files; this one imports none.
"""
