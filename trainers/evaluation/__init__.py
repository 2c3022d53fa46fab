"""Evaluates frozen policies and scripted baselines: measures, figures, eval.json, animations."""
