"""Evaluation on Inspect: whether imagination helps a multimodal LLM, by how much, and at what cost.

`loaders/` reads the data as `items`, `run` asks them by way of `asking` and `imagination`, `runs` holds what came of
each question, `statistics` compares arms, and `report/` makes tables and plots of it.
"""
