"""How things move: pure computation on records and arrays, no pixels read, no I/O."""
