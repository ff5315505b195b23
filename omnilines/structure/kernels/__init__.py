"""The compiled loops of structure; each has a plain reference in its test."""
