"""Samples on their way from gateways to the stores: spool, stream, hub and sinks."""
