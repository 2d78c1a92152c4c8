"""The one error that a user can mend."""


class UserError(ValueError):
    """Bad input. The message is one line that names the file, link or flag, what was expected, and the remedy."""
