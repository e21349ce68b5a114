"""Evaluation on Inspect: whether imagination helps a multimodal LLM, by how much, and at what cost.

`items` and `loaders/` read the data, `arms` and `tasks` ask, `observations` holds what came of each question,
`statistics` compares arms, and `report/` makes tables, plots and a page of it.
"""
