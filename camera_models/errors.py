"""The typed errors of the project. Each message says what was expected, what was found and what to do next."""


class OmnilinesError(Exception):
    """Base of every error that a user can cause; its text is one sentence fit to be printed as it stands."""


class InputError(OmnilinesError, ValueError):
    """A file, a value or an option is not what it has to be."""


class GeometryError(OmnilinesError, ValueError):
    """The data cannot determine what was asked for (a degenerate configuration, too few views)."""
