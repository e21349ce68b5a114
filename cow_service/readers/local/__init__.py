"""A multimodal LLM inside this process: weights of transformers, replies held to a JSON schema."""
