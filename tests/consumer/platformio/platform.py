"""A platform of PlatformIO: the compiler of this machine. The registry's `native` cannot be fetched by a test."""

from platformio.public import PlatformBase


class HostPlatform(PlatformBase):
    """Nothing but the base."""
