"""The reader that asks a multimodal LLM: prompts out, replies in, and what of a reply can be trusted."""
