"""The compiled loops of triangulation; each has a plain reference in its test."""
