"""Defines the error for mistakes of the user."""


class UserError(ValueError):
    """Reports wrong input: a value, a key, a file or a folder that the user chose.

    The command line prints its message in one line. Any other exception is a defect of the program
    and keeps its traceback.
    """


def how_to_install(extra: str) -> str:
    """Returns the command that installs an extra of emberlink, for messages."""
    return f"pip install '.[{extra}]' in the folder of emberlink"
