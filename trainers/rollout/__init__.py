"""Collects transitions: steps the environments with the exploring policy."""
