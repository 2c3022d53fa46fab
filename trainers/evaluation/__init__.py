"""Evaluates frozen policies beside scripted ones: numbers, figures, eval.json."""

from .actor import load_actor
from .report import evaluate_run
from .results import Results

__all__ = ["Results", "evaluate_run", "load_actor"]
