"""Memories of networks, which carry information from one decision to the next; one per file."""
