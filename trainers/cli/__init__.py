"""The command line: one file per command. `main.main` runs it; nothing else is public."""
