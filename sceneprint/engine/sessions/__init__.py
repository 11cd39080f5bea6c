"""Sessions of robots associated with each other."""
