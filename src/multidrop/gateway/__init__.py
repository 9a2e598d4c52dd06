"""The gateway: one process that polls the lines and serves the values to browsers and other programs."""
