"""Runs requests as durable jobs: what was accepted survives the process, and the results of stages are cached."""
