"""Wan2.1 image-to-video, conditioned on tracks."""
