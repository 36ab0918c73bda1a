"""The one error type users see."""


class UserError(Exception):
    """Something the user can put right. Its text is one line; the command prints it and ends with exit code 2."""
