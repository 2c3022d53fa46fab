"""Executors: they run the trainings of a sweep. Each is a file here and in configs/executor."""
