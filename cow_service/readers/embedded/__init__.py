"""The reader that needs no weights."""
