"""The compiled loops of posing; each has a plain reference in its test."""
