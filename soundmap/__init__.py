"""soundmap: maps of where the noise comes from, out of the logs of a mobile robot."""

__version__ = "0.1.0"
