"""The compiled loops of adjustment; each has a plain reference in its test."""
