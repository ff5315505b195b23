"""Cameras that are mounted together, calibrated jointly."""
