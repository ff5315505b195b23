"""Realistic cameras, photos and line scenes with known truth, drawn from a seed."""
