"""Classical vision: what can be measured in an image without a model."""
