"""Evaluates frozen policies and scripted baselines: measures, figures, eval.json, animations."""

from emberlink.trainers.evaluation.actor import load_actor
from emberlink.trainers.evaluation.report import evaluate_run
from emberlink.trainers.evaluation.results import Results

__all__ = ["Results", "evaluate_run", "load_actor"]
