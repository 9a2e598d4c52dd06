"""Commands and stops for drives, which NATS delivers to the gateway that polls the drive."""
