"""Compiled functions before they are needed: by processes on all cores, where each would else wait for the one before it."""

from omnilines.compiling.ahead import before_first_compiled, compile_ahead, seconds_for
from omnilines.compiling.entries import EVERYTHING, Entry, entries, not_compiled

__all__ = ["EVERYTHING", "Entry", "before_first_compiled", "compile_ahead", "entries", "not_compiled", "seconds_for"]
