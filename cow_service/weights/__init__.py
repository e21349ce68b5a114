"""Manifests of models, and their weights on disk."""
