"""The stages: each a function from records to a record. They know Protocols, never an implementation."""
