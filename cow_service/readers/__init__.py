"""Readers: who looks at the image and says what moves, and how."""
