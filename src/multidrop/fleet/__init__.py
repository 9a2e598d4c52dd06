"""Fleet: several gateways share the lines of a plant by NATS JetStream, and each line has one master."""
