"""Tests that a world is worth learning in, by means of scripted policies."""
