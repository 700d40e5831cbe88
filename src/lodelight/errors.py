"""One family of errors. A library function raises; only the command line prints and exits.

Every message says what is wrong, where, and what to do.
"""


class LodelightError(Exception):
    """Base of every error this package raises on purpose; the command line maps it to exit status 2."""


class SourceError(LodelightError):
    """A recording, image or trajectory that cannot be read as what it claims to be."""


class CalibrationError(LodelightError):
    """A rig that is incomplete, contradictory or not numbers."""


class ConfigError(LodelightError):
    """A setting that is unknown or out of its range."""


class MapError(LodelightError):
    """A map file that is missing, truncated, of another version, or not a map."""


class RunError(LodelightError):
    """The input was good and the work failed all the same; exit status 1."""
