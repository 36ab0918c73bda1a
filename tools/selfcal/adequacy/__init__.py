"""Evidence in a record against a law, and the answer of `identify`."""
