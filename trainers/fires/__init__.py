"""Fires on the command line: draws them, writes them to files, reads them from files."""
