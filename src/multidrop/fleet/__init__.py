"""Fleet: several gateways share the lines of a plant through NATS JetStream; one gateway polls each line.

The gateway that polls a line is called the line's master. It spools samples on its disk (Spool) and sends
them to the NATS stream `samples` (Forwarder). Hub stores the stream in Parquet files or PostgreSQL.
"""
