"""COW: a service that lets a multimodal LLM look before it answers."""

__version__ = "0.2.0"
