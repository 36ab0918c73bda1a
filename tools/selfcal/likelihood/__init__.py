"""Filters and fits of one axis."""
