"""What the readings are, before any fit."""
