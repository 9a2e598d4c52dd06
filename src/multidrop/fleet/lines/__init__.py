"""Leases and lines: a gateway with a lease may poll lines; ownership records say which lines it polls."""
