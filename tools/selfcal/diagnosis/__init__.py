"""What the simulation gets wrong in a recording, why, and what mending it gains. Begin with `loop.py`."""
