"""ct2lut: from a CT of a joint to the look-up table that animates it."""

__version__ = "0.1.0"
