"""Leases: a gateway's right to poll lines for a limited time, and the rules by which this right ends."""
