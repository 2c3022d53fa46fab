"""Runs the command line: `python -m emberlink`."""

from emberlink.trainers.cli.main import main

raise SystemExit(main())
