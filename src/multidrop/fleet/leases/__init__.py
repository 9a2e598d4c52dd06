"""Leases: a lease allows a gateway to poll lines for a limited time."""
