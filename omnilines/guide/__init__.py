"""Calibrating while shooting: what a camera sees, what is known of it by then, and how to hold the board next."""
