"""Sessions of gateways: leases on NATS, and the rules by which they end."""
