"""Collects transitions by stepping the environments with the exploring policy."""
