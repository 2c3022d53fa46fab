"""Compares runs over training seeds: rankings with intervals, the paper's claims, a report."""
