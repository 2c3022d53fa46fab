"""The command line: one file per command, run by `main.main`."""
