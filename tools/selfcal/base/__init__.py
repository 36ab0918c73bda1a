"""Helpers that every folder uses, and that use no other folder."""
