"""Samples on their way from the gateways to a store: spool, stream, hub and sinks."""
