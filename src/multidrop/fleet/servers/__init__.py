"""The NATS servers of a fleet: connections to them, buckets of records, setup, and rights of users."""
