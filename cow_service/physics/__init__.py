"""How things move: pure computation on records and arrays, no images read, no I/O."""
