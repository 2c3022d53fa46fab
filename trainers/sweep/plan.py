"""Splits and joins jobs by seeds, so that stopped trainings of several seeds go on together."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.sweep.jobs import (
    FoundRun,
    Identity,
    Job,
    identity,
    is_finished,
    job_for,
    key_of,
)


def plan(jobs: Sequence[Job], runs: Mapping[Identity, FoundRun]) -> list[Job]:
    """Returns jobs for the same runs; all runs of a job are finished, stopped or new.

    A job with several seeds is split if its seeds differ in this respect. Stopped seeds that were
    trained in parallel are one job, since they are resumed together.

    Args:
        jobs: jobs of one seed or several.
        runs: runs in the output folder.
    """
    planned: list[Job] = []
    stacks: dict[tuple, Job] = {}
    for job in jobs:
        job.find_runs(runs)
        for configs in _parts(job):
            part = (
                job
                if len(configs) == len(job.configs)
                else job_for(configs, job.overrides, job.swept)
            )
            part.find_runs(runs)
            stack = _stack(part)
            if stack is not None and stack in stacks:
                stacks[stack].configs += part.configs
                stacks[stack].find_runs(runs)
                continue
            if stack is not None:
                stacks[stack] = part
            planned.append(part)
    return planned


def stacked(jobs: Sequence[Job], seeds: int) -> list[Job]:
    """Returns jobs that train up to `seeds` new seeds of the same configuration in parallel.

    Args:
        jobs: jobs, from `plan`.
        seeds: maximum number of seeds of a job.
    """
    if seeds == 1:
        return list(jobs)
    groups: dict[Any, list[Job]] = {}
    for job in jobs:
        first = job.configs[0]
        alone = not job.found and len(job.configs) == 1 and not first.seeds
        key = (job.output, identity(replace(first, seed=0)), first.device) if alone else id(job)
        groups.setdefault(key, []).append(job)
    merged = []
    for group in groups.values():
        for first in range(0, len(group), seeds):
            merged.append(_merged(group[first : first + seeds]))
    return merged


def _merged(jobs: Sequence[Job]) -> Job:
    """Returns one job for the seeds of several jobs."""
    if len(jobs) == 1:
        return jobs[0]
    seeds = tuple(job.configs[0].seed for job in jobs)
    others = [text for text in jobs[0].overrides if key_of(text) not in ("seed", "seeds")]
    overrides = [*others, f"seeds=[{','.join(map(str, seeds))}]"]
    configs = [replace(job.configs[0], seeds=seeds) for job in jobs]
    return Job(jobs[0].method, overrides, configs, jobs[0].swept)


def _parts(job: Job) -> list[list[RunConfig]]:
    """Returns the configurations of a job in groups: finished, stopped together, or new."""
    if len(job.configs) == 1:
        return [job.configs]
    groups: dict[str, list[RunConfig]] = {}
    for config in job.configs:
        run = job.found.get(config.seed)
        if run is None:
            name = "new"
        elif is_finished(run.folder, config):
            name = "finished"
        else:
            name = f"resume {run.stack or config.seed}"
        groups.setdefault(name, []).append(config)
    return [groups[name] for name in sorted(groups)]


def _stack(job: Job) -> tuple | None:
    """Returns a key that is equal for jobs that resume the same seeds; None for other jobs."""
    first = job.configs[0]
    run = job.found.get(first.seed)
    if run is None or len(run.stack) < 2 or job.finished:
        return None
    return run.stack, identity(replace(first, seed=run.stack[0]))
