"""Runs requests as durable jobs: what was accepted outlives the process, and what a stage came to is kept."""
