"""Errors that a person reads: one sentence with the cause and the mend."""


class ZsdtError(Exception):
    """Base of every error that the program raises on purpose; its text is shown to the user as it is."""


class DataError(ZsdtError):
    """A file is missing, broken, or does not hold what its schema promises."""


class OptionError(ZsdtError):
    """An option has a value with which nothing sensible can be run."""


class RunRejected(ZsdtError):
    """A simulation left the range in which its equations mean anything.

    `cause` is a short word by which rejections are counted (for example ``"inverted"`` or ``"ledger"``).
    """

    def __init__(self, cause: str, message: str):
        super().__init__(message)
        self.cause = cause
