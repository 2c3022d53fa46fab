"""Prints text, tables, warnings and the progress of trainings to terminals, pipes and files."""
