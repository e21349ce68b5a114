"""Perception: vision models. Each kind is one narrow Protocol; a server has at most one of each, or none."""
