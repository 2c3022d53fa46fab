"""Names what replaces the keys of earlier versions."""

REMOVED: dict[str, str] = {
    "executor.seeds": "each seed is a run: seed=0,1,2",
    "executor.share": "each run is a job; executor.gpus=0.25 of executor=ray shares a GPU",
    "executor.restarts": "a killed run is listed at the end; the same command resumes it",
    "on_nan": "NaN or Inf ends a run; train a new one with smaller learning rates",
    "keep_checkpoints": "a run keeps its newest and its best checkpoint",
    "seeds": "a run trains one seed; several: emberlink sweep METHOD seed=0,1,2",
    "learner.anchor": "learner.warm_start begins with the actors of another run",
    "learner.burn_in": "the state of the memory before a sequence is stored with it",
    "policy.decisions": "policy.memory=gru remembers earlier decisions",
    "policy.memory=stack": "policy.memory=gru remembers earlier decisions",
}
"""key, or key=value -> a sentence about what to use instead"""
