"""The engines behind a common interface, their block means and results."""
