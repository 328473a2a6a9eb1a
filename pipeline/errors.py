"""The one family of errors that a user is meant to read: a sentence with what is wrong, where, and what to do."""


class CrossrayError(Exception):
    """Shown to the user as one message, without a traceback; the command line exits with status 2."""
