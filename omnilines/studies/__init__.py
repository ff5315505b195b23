"""Experiments and validations: many runs of the pipelines against a truth, and what they are expected to show."""
