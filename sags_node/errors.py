"""Errors a person can act on. The command line prints them as they are, without a traceback."""


class SagsError(Exception):
    """Something failed: says what is wrong, where, and how to mend it. Exit code 1."""

    exit_code = 1


class UsageError(SagsError):
    """The request itself is wrong (a key, a path, an option). Exit code 2."""

    exit_code = 2
