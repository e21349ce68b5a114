"""Readers: they look at the image and say what moves, and how."""
