"""Runs the command line: `python -m emberlink.trainers.cli`."""

from .main import main

raise SystemExit(main())
