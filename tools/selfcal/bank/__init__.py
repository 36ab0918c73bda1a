"""The engines behind one interface, their block means and results."""
