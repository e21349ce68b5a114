"""The OpenAI-compatible operations under `/v1`."""
