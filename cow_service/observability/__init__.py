"""Logs, metrics, traces, and the ids that they carry."""
