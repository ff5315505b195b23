"""The compiled loops of detection; each has a plain reference in its test."""
