"""What Inspect finds of this package by the entry point: `inspect eval cow_service/causalspatial`."""

from cow_service.evals.run import causalspatial, chosen_option, look_and_ask

__all__ = ["causalspatial", "chosen_option", "look_and_ask"]
