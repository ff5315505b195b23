"""Arcs of several photos -> tracks: `match.match_arcs`."""
