"""What in a record speaks against a law, and the answer of `identify`."""
