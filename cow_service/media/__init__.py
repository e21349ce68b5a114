"""Bytes of images and videos: decoding, encoding, drawing, keeping."""
