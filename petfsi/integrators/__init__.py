"""Time integrators: a scheme is a file here and a line in ``registry.INTEGRATORS``."""
