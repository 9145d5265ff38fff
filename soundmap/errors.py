"""Errors that a user can mend. Only the command line catches them; the core raises ValueError."""


class SoundmapError(Exception):
    """A run cannot go on. The message says what, where, found against expected, and what to do.

    ``exit_code`` is what the command line returns for it.
    """

    exit_code = 1


class LogError(SoundmapError):
    """The input cannot be read at all: no such file, not MCAP, not a rosbag2 folder."""

    exit_code = 3


class NothingUsableError(SoundmapError):
    """The log can be read but lacks what the command needs, or holds nothing sound of it."""

    exit_code = 4


class MapError(SoundmapError):
    """The geometric map cannot be read, or the run does not take place in it."""


class ConfigError(SoundmapError):
    """The configuration is wrong, or does not fit the log."""

    exit_code = 2


class OutputError(SoundmapError):
    """The results cannot be written."""


class DataLossError(SoundmapError):
    """Something was lost and the user asked for ``--strict``."""

    exit_code = 5
