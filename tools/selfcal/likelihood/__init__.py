"""Filters and fits of an axis, and of all axes together."""
