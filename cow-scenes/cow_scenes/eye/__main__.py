"""`python -m cow_scenes.eye` is `cow-scenes eye` without what the other commands need."""

from .commands import app

app()
