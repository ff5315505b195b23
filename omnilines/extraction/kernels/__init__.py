"""The compiled loops of extraction; each has a plain reference in its test."""
