"""The NATS servers of a fleet: connections, buckets, setup and rights."""
