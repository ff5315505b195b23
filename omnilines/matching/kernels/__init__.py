"""The compiled loops of matching; each has a plain reference in its test."""
