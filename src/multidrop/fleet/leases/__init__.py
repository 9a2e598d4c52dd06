"""Leases: a gateway's right to poll, and the rules by which it ends."""
