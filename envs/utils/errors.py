"""Defines the error for mistakes of the user."""


class UserError(ValueError):
    """Reports wrong input: a value, a key, a file or a folder that the user chose.

    The command line prints its message in one line. Any other exception is a defect of the program
    and keeps its traceback.
    """
