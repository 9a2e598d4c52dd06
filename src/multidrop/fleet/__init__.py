"""Fleet: several gateways share the lines of a plant by NATS JetStream, and each line has one master.

Samples go this way: poller -> Spool -> Forwarder -> the stream `samples` -> Hub -> Parquet or PostgreSQL.
"""
