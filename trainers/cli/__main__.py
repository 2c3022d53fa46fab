"""Runs the command line: `python -m emberlink.trainers.cli`."""

from emberlink.trainers.cli.main import main

raise SystemExit(main())
