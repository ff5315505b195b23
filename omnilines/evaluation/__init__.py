"""Estimates compared with a known truth."""
