"""Questions about a fleet: several gateways that share lines."""
