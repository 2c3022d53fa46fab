"""The error for mistakes of a user."""


class UserError(ValueError):
    """Reports a wrong input: a value, a key, a file or a folder that the user chose.

    The commands print its message in one line, without a traceback. Any other exception is a
    mistake in the program and keeps its traceback.
    """
