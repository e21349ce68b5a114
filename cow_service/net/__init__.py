"""Outgoing HTTP to addresses that callers name."""
