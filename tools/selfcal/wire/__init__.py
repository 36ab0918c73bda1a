"""Telemetry: frames, DBC files, modules live."""
