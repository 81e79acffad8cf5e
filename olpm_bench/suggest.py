"""The remedy for a misspelt name, as the library of representations has it."""
from representations.suggest import closest

__all__ = ["closest"]
