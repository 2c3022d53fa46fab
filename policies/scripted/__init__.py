"""Scripted policies: baselines that learned policies are compared with."""
